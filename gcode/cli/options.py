"""Options and inputs that commands share, ours and `amrepair`'s."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gcode.cli import console
from gcode.errors import InputError

PrinterOption = Annotated[
    str,
    typer.Option(
        help="Printer profile: an ID or a TOML file.",
        autocompletion=console.profile_ids("printers"),
    ),
]
MaterialOption = Annotated[
    str,
    typer.Option(
        help="Material profile: an ID or a TOML file.",
        autocompletion=console.profile_ids("materials"),
    ),
]
ProcessOption = Annotated[
    str,
    typer.Option(
        help="Process profile: an ID or a TOML file.",
        autocompletion=console.profile_ids("processes"),
    ),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="One JSON object on standard output, nothing else there.")
]


def program_text(path: Path) -> str:
    """The text of a program's file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from error
