"""The application: one file for each command, or group of commands, of `gcode`."""

from __future__ import annotations

import typer

import gcode
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

app = console.application(
    "gcode", "Slice solids, check and estimate programs, send them, emulate a printer.", gcode
)
profiles_app = typer.Typer(help="Printer, material and process profiles.", no_args_is_help=True)

console.add(app, slicing, checking, estimating, resuming, touching, stacking, sending, emulating)
app.add_typer(profiles_app, name="profiles")
console.add(profiles_app, listing, importing)


def main() -> None:
    """Entry point."""
    console.run(app, "gcode", (GcodeError,))
