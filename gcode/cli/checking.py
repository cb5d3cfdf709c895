"""The command `gcode check`."""

from __future__ import annotations

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


def add_to(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        "check",
        epilog=console.examples(
            "gcode check job.gcode",
            "gcode check job.gcode --printer ender_3",
            "gcode check job.gcode --printer creality_k1_max --material petg",
            "gcode check repair.gcode --as-built standing.stl --json",
        ),
    )(check)


def check(
    file: FileArgument,
    printer: JobPrinterOption = None,
    material: OwnMaterialOption = None,
    as_built: AsBuiltOption = None,
    leave_heaters: LeaveHeatersOption = False,
    as_json: JsonOption = False,
) -> None:
    """Judge a program: limits, temperatures, sections, and the tool head against --as-built.

    Programs of our own keep every figure of the profiles. In a job of yours only what can hurt is
    refused; flow, speed, acceleration and bead size beyond the profile's figures are told.
    """
    with console.starting():
        from gcode.check import judge, policy_of
        from gcode.moves import Program

    text = program_text(file)
    setup = setup_to_judge(text, file, printer, material)
    program = Program(text, setup.printer.dialect)
    field = standing_on_bed(as_built) if as_built is not None else None
    bars = console.Bars()
    with bars.shown():
        verdict = judge(
            program, setup, as_built=field, policy=policy_of(program),
            leave_heaters=leave_heaters, progress=bars,
        )  # fmt: skip
    refusals = verdict.refusals
    other = other_printer(text, file, setup.printer) if printer is not None else None
    if as_json:
        console.show_json(
            {
                "ok": not refusals,
                "printer": setup.printer.id,
                "sha256": program.sha256,
                "other_printer": other,
                "refusals": [refusal_json(refusal) for refusal in refusals],
                **warnings_json(verdict.report, "warnings"),
            }
        )
    elif refusals and other is not None:
        console.errors.print(f"{other}.", markup=False)
    elif refusals:
        for refusal in refusals[:20]:
            console.errors.print(str(refusal), markup=False)
        if len(refusals) > 20:
            console.errors.print(f"and {len(refusals) - 20} more")
    else:
        tell_warnings(file, verdict.report)
        if other is not None:
            console.errors.print(f"{file}: warning: {other}.", markup=False)
        console.out.print(
            f"{file}: nothing {'else ' if verdict.report.warnings else ''}speaks against it on "
            f"{setup.printer.name}."
        )
    if refusals:
        raise typer.Exit(2)
