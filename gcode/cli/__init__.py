"""The command line of `gcode`: arguments and wiring; the same exit codes as `amrepair`.

Exit 0 done, 2 bad input or refused, 4 printer or link. `--json` prints one object on standard
output; messages and progress go to standard error.
"""

import sys

from gcode.process import prepare

prepare()  # before numpy is loaded, which a command line does late

__all__ = ["main"]


def main() -> None:
    """Entry point."""
    try:
        from gcode.cli.app import main as run

        run()
    except KeyboardInterrupt:  # while the libraries were loading
        sys.stderr.write("gcode: interrupted\n")
        sys.exit(130)
