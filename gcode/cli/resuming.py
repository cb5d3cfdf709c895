"""The command `gcode resume-at`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gcode.cli import console
from gcode.cli.options import (
    FirstLayerOption,
    JsonOption,
    ProgramOutput,
    StandingHeightOption,
    program_text,
    refuse_standing,
)
from gcode.cli.owning import (
    JobMaterialOption,
    JobPrinterOption,
    chosen_setup,
    told_if_for_another,
)


@console.command(
    "resume-at",
    "gcode resume-at job.gcode --layer 41 --printer prusa_mk3s -o rest.gcode",
    "gcode resume-at job.gcode --z-mm 8.4 -o rest.gcode",
    "gcode resume-at job.gcode --layer 41 --without lid_copy_2 -o rest.gcode",
)
def resume_at_command(
    job: Annotated[Path, typer.Argument(help="The whole job's G-code, of any slicer.")],
    output: ProgramOutput,
    z_mm: StandingHeightOption = None,
    layer: FirstLayerOption = None,
    without: Annotated[
        str | None,
        typer.Option(help="An object of the job of which nothing more is printed."),
    ] = None,
    printer: JobPrinterOption = None,
    material: JobMaterialOption = None,
    standing: Annotated[
        Path | None,
        typer.Option(help="Height map (.npz) to write: what must stand there, for --as-built."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Make a checked job from a layer on: heated, primed, lowered onto the part, Z not homed."""
    with console.starting():
        from gcode.moves import Program
        from gcode.resumption import resume_at

    console.writable(output)
    refuse_standing(standing)
    text = program_text(job)
    chosen = chosen_setup(text, job, printer, material)
    setup = chosen.setup
    bars = console.Bars()
    with bars.shown(), told_if_for_another(text, job, setup.printer):
        made = resume_at(
            Program(text, setup.printer.dialect),
            setup,
            z_mm=z_mm,
            layer=layer,
            without=without,
            title=job.name,
            about_printer=chosen.about_printer(text),
            progress=bars,
        )
    program = made.checked.program
    console.write_text(output, program.text)
    if standing is not None:
        console.write_whole(standing, made.standing.write)
    if as_json:
        console.show_json(
            {
                "gcode": str(output),
                "layer": made.layer.index,
                "without": without,
                "z_mm": round(made.layer.z_mm, 4),
                "first_line": made.first_line,
                "standing_mm": round(made.standing.top_mm, 4),
                "hotend_c": made.hotend_c,
                "bed_c": made.bed_c,
                "primed": made.primed,
                "least_clearance_mm": made.checked.report.least_clearance_mm,
                "sha256": program.sha256,
            }
        )
        return
    console.out.print(
        f"{output}: {job.name}{f' without {without}' if without else ''} from layer "
        f"{made.layer.index} ({made.layer.z_mm:g} mm) on, line "
        f"{made.first_line + 1}; {made.standing.top_mm:g} mm must stand there, and Z must be true; "
        f"primed {made.primed}; checked."
    )
