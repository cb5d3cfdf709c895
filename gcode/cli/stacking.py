"""The command `gcode print-onto`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gcode.cli import console
from gcode.cli.judging import tell_warnings, warnings_json
from gcode.cli.options import JsonOption, ProgramOutput, program_text, standing_on_bed
from gcode.cli.owning import (
    JobMaterialOption,
    JobPrinterOption,
    chosen_setup,
    told_if_for_another,
)


@console.command(
    "print-onto",
    "gcode print-onto standing.stl lid.gcode -o lid-on-box.gcode",
    "gcode print-onto scan.ply lid.gcode -o lid-on-box.gcode --printer ender_3",
)
def print_onto_command(
    part: Annotated[
        Path,
        typer.Argument(
            help="What stands on the bed, in its frame: a mesh, a point cloud, a height map."
        ),
    ],
    job: Annotated[
        Path, typer.Argument(help="The job, placed in X and Y where it is to stand on the part.")
    ],
    output: ProgramOutput,
    printer: JobPrinterOption = None,
    material: JobMaterialOption = None,
    as_json: JsonOption = False,
) -> None:
    """Raise a job onto a part that stands there: Z not homed, checked against the part."""
    with console.starting():
        from gcode.moves import Program
        from gcode.resumption import print_onto

    console.writable(output)
    text = program_text(job)
    chosen = chosen_setup(text, job, printer, material)
    setup = chosen.setup
    field = standing_on_bed(part, setup.printer)
    bars = console.Bars()
    with bars.shown(), told_if_for_another(text, job, setup.printer):
        made = print_onto(
            Program(text, setup.printer.dialect),
            setup,
            field,
            title=job.name,
            about_printer=chosen.about_printer(text),
            progress=bars,
        )
    program = made.checked.program
    console.write_text(output, program.text)
    tell_warnings(job, made.checked.report)
    if as_json:
        console.show_json(
            {
                "gcode": str(output),
                "raised_mm": made.raised_mm,
                "uneven_mm": made.uneven_mm,
                "hotend_c": made.hotend_c,
                "bed_c": made.bed_c,
                "primed": made.primed,
                "least_clearance_mm": made.checked.report.least_clearance_mm,
                "sha256": program.sha256,
                **warnings_json(made.checked.report, "warnings"),
            }
        )
        return
    console.out.print(
        f"{output}: {job.name} raised by {made.raised_mm:g} mm onto {part.name}, which is uneven "
        f"by {made.uneven_mm:g} mm under it; Z must be true, and is not homed; primed "
        f"{made.primed}; checked. Send it with --as-built {part}."
    )
