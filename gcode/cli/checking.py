"""The command `gcode check`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gcode.cli import console
from gcode.cli.judging import (
    LeaveHeatersOption,
    refusal_json,
    tell_warnings,
    warnings_json,
)
from gcode.cli.options import (
    AsBuiltOption,
    FileArgument,
    JsonOption,
    OwnMaterialOption,
    program_text,
    standing_on_bed,
)
from gcode.cli.owning import JobPrinterOption, other_printer, setup_to_judge
from gcode.errors import InputError, ReadError

if TYPE_CHECKING:
    from gcode.check.checker import Verdict
    from gcode.check.contact import Contact
    from gcode.moves import Program
    from gcode.profiles import PrintSetup


@console.command(
    "check",
    "gcode check job.gcode",
    "gcode check job.gcode --printer ender_3",
    "gcode check job.gcode --printer creality_k1_max --material petg",
    "gcode check repair.gcode --as-built standing.stl --json",
)
def check(
    file: FileArgument,
    printer: JobPrinterOption = None,
    material: OwnMaterialOption = None,
    as_built: AsBuiltOption = None,
    picture: Annotated[
        Path | None,
        typer.Option(help="Picture (.svg) to write of the first contact with --as-built."),
    ] = None,
    leave_heaters: LeaveHeatersOption = False,
    as_json: JsonOption = False,
) -> None:
    """Judge a program: limits, temperatures, sections, and the tool head against --as-built.

    Programs of our own keep every figure of the profiles. In a job of yours only what can hurt is
    refused; flow, speed, acceleration and bead size beyond the profile's figures are told.
    """
    with console.starting():
        from gcode.check import judge, policy_of
        from gcode.check.contact import draw
        from gcode.check.findings import by_kind
        from gcode.moves import Program

    if picture is not None:
        if as_built is None:
            raise InputError("--picture draws a contact with what stands there: give --as-built.")
        if picture.suffix.lower() != ".svg":
            raise InputError(f"--picture {picture}: the drawing is an .svg; name it so.")
        console.writable(picture)
    text = program_text(file)
    chosen = setup_to_judge(text, file, printer, material)
    setup = chosen.setup
    program = Program(text, setup.printer.dialect)
    field = None if as_built is None else standing_on_bed(as_built, setup.printer)
    bars = console.Bars()
    with bars.shown():
        verdict = judge(
            program, setup, as_built=field, policy=policy_of(program),
            leave_heaters=leave_heaters, progress=bars,
        )  # fmt: skip
    refusals = verdict.refusals
    other = other_printer(text, file, setup.printer) if chosen.own is None or refusals else None
    contact = _contact_in_words(verdict, program, setup)
    drawn = picture is not None and verdict.contact is not None and verdict.moves is not None
    if picture is not None and field is not None and verdict.contact and verdict.moves:
        shown, moves, machine = verdict.contact, verdict.moves, setup.printer
        console.write_whole(picture, lambda path: draw(shown, moves, machine, field, path))
    if as_json:
        console.show_json(
            {
                "contact": contact_json(verdict.contact, contact),
                "picture": str(picture) if drawn else None,
                "ok": not refusals,
                **chosen.printer_json,
                "sha256": program.sha256,
                "other_printer": other,
                "refusals": [refusal_json(refusal) for refusal in refusals],
                **warnings_json(verdict.report, "warnings"),
            }
        )
    elif refusals and other is not None:
        console.errors.print(f"{other}.")
    elif refusals:
        if contact is not None:
            console.errors.print(f"First contact: {contact}.")
        elif field is not None:
            console.errors.print("The head touches nothing of what stands there.")
        for refused in by_kind(refusals):
            console.errors.print(str(refused))
        console.errors.print(f"Judged for the {chosen.printer_in_words}.")
    else:
        tell_warnings(file, verdict.report)
        if other is not None:
            console.errors.print(f"{file}: warning: {other}.")
        console.out.print(
            f"{file}: nothing {'else ' if verdict.report.warnings else ''}speaks against it on the "
            f"{chosen.printer_in_words}."
        )
    if refusals:
        raise typer.Exit(2)


def _contact_in_words(verdict: Verdict, program: Program, setup: PrintSetup) -> str | None:
    """The first contact with its layer; None where there is none."""
    from gcode.reader import job_for

    if verdict.contact is None:
        return None
    try:
        layers = job_for(program, setup.printer).layers
    except ReadError:
        layers = ()
    line = verdict.contact.line - 1
    within = [layer for layer in layers if layer.first_line <= line < layer.end_line]
    where = f"layer {within[0].index} ({within[0].z_mm:g} mm), " if within else ""
    return f"{where}{verdict.contact}"


def contact_json(contact: Contact | None, words: str | None) -> dict[str, Any] | None:
    """A contact as JSON."""
    if contact is None:
        return None
    return {"line": contact.line, "place_mm": list(contact.place_mm), "words": words}
