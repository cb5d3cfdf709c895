"""Profiles of a command that is given a job: those that are named, else the job's own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
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
NOBODY_NAMED = "the printer is the default: none was named"
"""What a program says for people where nobody chose its printer."""


@dataclass(frozen=True, slots=True)
class ChosenSetup:
    """The profiles of a command, and who chose the printer.

    Attributes
    ----------
    setup
        The profiles.
    own
        The job's own settings, where they were taken.
    ids
        IDs or paths of printer, material and process; None where a job's settings made them.
    printer_from
        `option`, `job`, or `default` where nobody named one.
    """

    setup: PrintSetup
    own: OwnSettings | SlicedFor | None
    ids: tuple[str, str, str] | None
    printer_from: str

    @property
    def printer_in_words(self) -> str:
        """The printer, and who chose it: `Ender 3 (ender_3), as --printer names it`."""
        who = {
            "option": ", as --printer names it",
            "job": f", as {self.own.job} has it" if self.own is not None else "",
            "default": ": the default, since no --printer is given",
        }
        printer = self.setup.printer
        return f"{printer.name} ({printer.id}){who[self.printer_from]}"

    @property
    def printer_json(self) -> dict[str, str]:
        """Keys `printer`, `printer_name` and `printer_from` of a command's result."""
        printer = self.setup.printer
        return {
            "printer": printer.id,
            "printer_name": printer.name,
            "printer_from": self.printer_from,
        }

    def about_printer(self, text: str) -> tuple[str, ...]:
        """Comments for a program made of a job: by them a later command knows the printer.

        The profiles' names; where the job's own settings made them, those of its lines that a
        program without the job's beginning would lose.
        """
        from gcode.profiles.importers.jobs import settings_ahead
        from gcode.profiles.own_settings import printer_line, profiles_line

        if self.ids is None:
            return tuple(settings_ahead(text))
        lines = [profiles_line(self.ids), printer_line(self.setup.printer)]
        if self.printer_from == "default":
            lines.append(NOBODY_NAMED)
        return tuple(f"; {line}" for line in lines)


def job_setup(
    text: str | None,
    name: Path | str,
    printer: str | None,
    material: str | None,
    process: str | None = None,
) -> tuple[PrintSetup, OwnSettings | SlicedFor | None]:
    """As `chosen_setup`: the profiles for a job, and its own settings where they were taken."""
    chosen = chosen_setup(text, name, printer, material, process)
    return chosen.setup, chosen.own


def chosen_setup(
    text: str | None,
    name: Path | str,
    printer: str | None,
    material: str | None,
    process: str | None = None,
) -> ChosenSetup:
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

    own, asked = _own(text, name, printer), printer
    if printer is None and own is None and text is not None:
        from gcode.profiles.own_settings import printer_of_words

        printer = printer_of_words(text)
        told = f"{name}: no --printer is given and no slicer's settings are in it"
        console.errors.print(f"{told}; {printer} is taken.")
    ids = (printer or DEFAULT_PRINTER, material or DEFAULT_MATERIAL, process or DEFAULT_PROCESS)
    if own is None:
        by = "default" if asked is None else "option"
        return ChosenSetup(load_setup(*ids), None, ids, by)
    setup = own.setup(material, process)
    console.errors.print(f"{own.in_words(setup)}.")
    return ChosenSetup(setup, own, own.named(material, process), "job")


def _own(text: str | None, name: Path | str, printer: str | None) -> OwnSettings | SlicedFor | None:
    """A job's own settings, where they are asked for."""
    from gcode.profiles.own_settings import own_settings

    return None if printer is not None or text is None else own_settings(text, str(name))


def setup_to_judge(
    text: str, name: Path | str, printer: str | None, material: str | None
) -> ChosenSetup:
    """Profiles to judge by; of a filament of unknown flow only the hotend's limit is known."""
    chosen = chosen_setup(text, name, printer, material)
    if material is not None or (chosen.own is not None and chosen.own.flow_is_told):
        return chosen
    return replace(chosen, setup=chosen.setup.melting_all())


def other_printer(text: str, name: Path | str, printer: PrinterProfile) -> str | None:
    """One sentence where a job itself tells of another printer; None where it does not."""
    from gcode.profiles.own_settings import made_for_another, own_settings

    own = own_settings(text, str(name))
    return (own.differs_from(printer) if own is not None else None) or made_for_another(
        text, str(name), printer
    )


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
