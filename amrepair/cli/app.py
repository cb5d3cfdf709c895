"""The application: one file for each group of commands."""

from __future__ import annotations

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

app = console.application(
    "amrepair",
    "Scan a print, find what is missing, print only that, scan again, resume.",
    amrepair,
)
template_app = typer.Typer(help="Fit a template; extract its mesh.", no_args_is_help=True)

console.add(app, simulation, inspect, repairing, printing, postprocessing, calibration, replaying)
console.add(app, benchmark, health, live, fleeting, agenting)
app.add_typer(template_app, name="template")
console.add(template_app, templates)
app.add_typer(batching.batch_app, name="batch")


def main() -> None:
    """Entry point."""
    console.run(app, "amrepair", (AmrepairError, GcodeError))
