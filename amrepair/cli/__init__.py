"""The command line: arguments and wiring. Exit 0 done, 2 bad input, 3 not within tolerance, 4 link.

Nothing is computed here; messages and progress go to standard error, results to standard output.
"""

from amrepair.cli.app import main

__all__ = ["main"]
