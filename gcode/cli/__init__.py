"""The command line of `gcode`: arguments and wiring; the same exit codes as `amrepair`.

Exit 0 done, 2 bad input or refused, 4 printer or link. `--json` prints one object on standard
output; messages and progress go to standard error.
"""

from gcode.process import interrupt_told, prepare

prepare()  # before numpy is loaded, which a command line does late

__all__ = ["main"]


def main() -> None:
    """Entry point."""
    with interrupt_told("gcode"):
        from gcode.cli.app import main as run

        run()
