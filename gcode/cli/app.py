"""The application: one file for each command, or group of commands, of `gcode`."""

from __future__ import annotations

from typing import Annotated

import typer

from gcode.cli import (
    checking,
    console,
    emulating,
    estimating,
    importing,
    listing,
    resuming,
    sending,
    slicing,
    stacking,
    touching,
)
from gcode.errors import GcodeError

app = typer.Typer(
    name="gcode",
    help="Slice solids, check and estimate programs, send them, emulate a printer.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
profiles_app = typer.Typer(help="Printer, material and process profiles.", no_args_is_help=True)


def _version(asked: bool) -> bool:
    import gcode

    if asked:
        console.out.print(f"gcode {gcode.__version__}")
        raise typer.Exit
    return asked


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Options before a command."""


slicing.add_to(app)
checking.add_to(app)
estimating.add_to(app)
resuming.add_to(app)
touching.add_to(app)
stacking.add_to(app)
sending.add_to(app)
emulating.add_to(app)
app.add_typer(profiles_app, name="profiles")
listing.add_to(profiles_app)
importing.add_to(profiles_app)


def main() -> None:
    """Entry point."""
    console.run(app, "gcode", (GcodeError,))
