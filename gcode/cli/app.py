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


console.add(app, slicing, checking, estimating, resuming, touching, stacking, sending, emulating)
app.add_typer(profiles_app, name="profiles")
console.add(profiles_app, listing, importing)


def main() -> None:
    """Entry point."""
    console.run(app, "gcode", (GcodeError,))
