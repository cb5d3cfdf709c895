"""Profiles of a command that is given a job: those that are named, else the job's own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gcode.cli import console
from gcode.errors import CheckRefusedError
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS

if TYPE_CHECKING:
    from gcode.profiles import PrinterProfile, PrintSetup
    from gcode.profiles.own_settings import OwnSettings, SlicedFor

JobPrinterOption = Annotated[
    str | None,
    typer.Option(
        help="Printer profile: an ID or a TOML file. Left out: the settings that the job's slicer "
        f"wrote into it, else {DEFAULT_PRINTER}.",
        autocompletion=console.profile_ids("printers"),
    ),
]
JobMaterialOption = Annotated[
    str | None,
    typer.Option(
        help="Material profile: an ID or a TOML file. Left out: that of the job's own settings "
        f"where the printer is theirs, too, else {DEFAULT_MATERIAL}.",
        autocompletion=console.profile_ids("materials"),
    ),
]


def job_setup(
    text: str | None,
    name: Path | str,
    printer: str | None,
    material: str | None,
    process: str | None = None,
) -> tuple[PrintSetup, OwnSettings | SlicedFor | None]:
    """The profiles for a job, with its own settings where they were taken: told in one line.

    Parameters
    ----------
    text
        The job's G-code; None where there is none.

    Raises
    ------
    ProfileError, InputError
        If a profile, or the job's settings, cannot be read.
    """
    from gcode.profiles import load_setup

    own = _own(text, name, printer)
    if printer is None and own is None and text is not None:
        from gcode.profiles.own_settings import printer_of_words

        printer = printer_of_words(text)
        told = f"{name}: no --printer is given and no slicer's settings are in it"
        console.errors.print(f"{told}; {printer} is taken.")
    ids = (printer or DEFAULT_PRINTER, material or DEFAULT_MATERIAL, process or DEFAULT_PROCESS)
    if own is None:
        return load_setup(*ids), None
    setup = own.setup(material, process)
    console.errors.print(f"{own.in_words(setup)}.")
    return setup, own


def _own(text: str | None, name: Path | str, printer: str | None) -> OwnSettings | SlicedFor | None:
    """A job's own settings, where they are asked for."""
    from gcode.profiles.own_settings import own_settings

    return None if printer is not None or text is None else own_settings(text, str(name))


def setup_to_judge(
    text: str, name: Path | str, printer: str | None, material: str | None
) -> PrintSetup:
    """Profiles to judge by; of a filament of unknown flow only the hotend's limit is known."""
    setup, own = job_setup(text, name, printer, material)
    if material is not None:
        return setup
    return setup if own is not None and own.flow_is_told else setup.melting_all()


def other_printer(text: str, name: Path | str, printer: PrinterProfile) -> str | None:
    """One sentence where a job's own settings tell of another printer; None where they do not."""
    from gcode.profiles.own_settings import own_settings

    own = own_settings(text, str(name))
    return own.differs_from(printer) if own is not None else None


@contextmanager
def told_if_for_another(text: str, name: Path | str, printer: PrinterProfile) -> Iterator[None]:
    """Within it, a refusal by the checker is one sentence where the job is for another printer."""
    try:
        yield
    except CheckRefusedError as error:
        said = other_printer(text, name, printer)
        if said is None:
            raise
        raise CheckRefusedError(f"{said}.", error.refusals) from error
