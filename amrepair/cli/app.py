"""The application: one file for each group of commands."""

from __future__ import annotations

from typing import Annotated

import typer

import amrepair
from amrepair.cli import (
    agenting,
    batching,
    benchmark,
    calibration,
    fleeting,
    health,
    inspect,
    live,
    postprocessing,
    printing,
    repairing,
    replaying,
    simulation,
    templates,
)
from amrepair.errors import AmrepairError
from gcode.cli import console
from gcode.errors import GcodeError

app = typer.Typer(
    name="amrepair",
    help="Scan a print, find what is missing, print only that, scan again, resume.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _version(asked: bool) -> bool:
    if asked:
        console.out.print(f"amrepair {amrepair.__version__}")
        raise typer.Exit
    return asked


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Options before a command."""


simulation.add_to(app)
templates.add_to(app)
inspect.add_to(app)
repairing.add_to(app)
printing.add_to(app)
postprocessing.add_to(app)
calibration.add_to(app)
replaying.add_to(app)
batching.add_to(app)
benchmark.add_to(app)
health.add_to(app)
live.add_to(app)
fleeting.add_to(app)
agenting.add_to(app)


def main() -> None:
    """Entry point."""
    console.run(app, "amrepair", (AmrepairError, GcodeError))
