"""The command line of `gcode`: arguments and wiring; the same exit codes as `amrepair`.

Exit 0 done, 2 bad input or refused, 4 printer or link. `--json` prints one object on standard
output; messages and progress go to standard error.
"""

import os

from gcode.cli.app import main

# Products of some thousand rows by three columns take less time than BLAS's threads need to wake;
# and those, spinning for more work, hold a core that compiled loops would run on. Read when numpy
# is loaded, which a command line does late.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__all__ = ["main"]
