"""The command line: arguments and wiring. Exit 0 done, 2 bad input, 3 not within tolerance, 4 link.

Nothing is computed here; messages and progress go to standard error, results to standard output.
"""

from __future__ import annotations

import sys

from gcode.process import interrupt_told, prepare

prepare()  # before numpy is loaded

__all__ = ["main"]


def main() -> None:
    """Entry point; where a library is missing, it says which and how to fix it."""
    try:
        with interrupt_told("amrepair"):
            from amrepair.cli.app import main as run

            run()
    except ImportError as error:
        sys.stderr.write(f"amrepair: a library that it needs cannot be loaded: {error}\n")
        _say_what_is_wrong()
        sys.exit(2)


def _say_what_is_wrong() -> None:
    """The doctor's findings, without any of the libraries that may be what is missing."""
    from amrepair.doctor import State, examine

    for finding in examine():
        if finding.state is not State.OK:
            sys.stderr.write(f"{finding.name}: {finding.found}\n    {finding.mend}\n")
