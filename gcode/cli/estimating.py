"""The command `gcode estimate`."""

from __future__ import annotations

from gcode.cli import console
from gcode.cli.options import FileArgument, JsonOption, program_text
from gcode.cli.owning import JobPrinterOption, job_setup


@console.command(
    "estimate", "gcode estimate job.gcode", "gcode estimate job.gcode --printer voron_2_4 --json"
)
def estimate(
    file: FileArgument,
    printer: JobPrinterOption = None,
    as_json: JsonOption = False,
) -> None:
    """Tell how long a program takes and what it uses; heating left out."""
    with console.starting():
        from gcode.estimate import estimate as estimate_program
        from gcode.moves import Program

    text = program_text(file)
    machine = job_setup(text, file, printer, None)[0].printer
    bars = console.Bars()
    with bars.shown():
        found = estimate_program(Program(text, machine.dialect), machine, progress=bars)
    result = {
        "print_time_s": round(found.print_time_s, 1),
        "filament_mm": round(found.filament_mm, 2),
        "filament_mm3": round(found.filament_mm3, 2),
        "layers": found.layers,
        "bounds_mm": [round(v, 3) for v in found.bounds_mm],
    }
    if as_json:
        console.show_json(result)
        return
    console.out.print(
        f"{found.print_time_s / 60:.1f} min, {found.filament_mm / 1000:.3f} m of filament "
        f"({found.filament_mm3 / 1000:.2f} cm³), {found.layers} layers."
    )
