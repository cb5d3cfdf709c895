"""`amrepair repair`: from a scan file to a checked program."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amrepair.cli.inspect import TemplateOption
from amrepair.cli.options import (
    JsonOption,
    MaterialOption,
    PrinterOption,
    ProcessOption,
    SeedOption,
    SensorOption,
    part_pose,
    sensors,
)
from amrepair.errors import InputError
from gcode.cli import console
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS

if TYPE_CHECKING:
    from gcode.profiles import PrintSetup
    from gcode.slicing.layers import LayerGrid

# A guess from the user's own pose is refined; the scan may lie this far from it.
FRAMES = ("build", "unknown")


def add_to(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        "repair",
        epilog=console.examples(
            "amrepair repair scan.ply --template part.safetensors -o repair.gcode "
            "--standing standing.npz --report report.html",
            "amrepair repair scan.ply --template part.stl -o repair.gcode "
            "--scan-frame unknown --part-pose 100,80,0,90",
            "amrepair repair scan.ply --template part.stl -o repair.gcode --printer ender_3 "
            "--material petg --job job.gcode",
        ),
    )(repair)


def repair(
    scan: Annotated[Path, typer.Argument(help="Scan of the damaged part, mm.")],
    template: TemplateOption,
    output: Annotated[Path, typer.Option("-o", "--output", help="Repair program to write.")],
    printer: PrinterOption = DEFAULT_PRINTER,
    material: MaterialOption = DEFAULT_MATERIAL,
    process: ProcessOption = DEFAULT_PROCESS,
    scan_frame: Annotated[
        str,
        typer.Option(
            help="build: the scan's coordinates are the bed's; unknown: they are the scanner's, "
            "and --part-pose says where the part stands."
        ),
    ] = "build",
    pose: Annotated[
        str | None,
        typer.Option(
            "--part-pose",
            help="X,Y,Z,RZ: place of the part's own origin on the bed, mm, and its turn, degrees.",
        ),
    ] = None,
    sensor_at: SensorOption = None,
    job: Annotated[
        Path | None, typer.Option(help="The job's G-code: repair layers lie on its layers.")
    ] = None,
    standing: Annotated[
        Path | None,
        typer.Option(
            help="Height map (.npz) to write: what stands there, for --as-built of gcode check "
            "and gcode send."
        ),
    ] = None,
    report: Annotated[Path | None, typer.Option(help="HTML report to write.")] = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Make the G-code that prints only what is missing on a finished part."""
    import numpy as np

    from amrepair.repair import Site, Stopwatch, plan_repair
    from amrepair.report import plan_is_enough, report_of_plan, summary_of_result, write_report
    from amrepair.report.collect import plan_result
    from amrepair.scans import read_scan
    from amrepair.template import open_template
    from gcode.profiles import load_setup

    if scan_frame not in FRAMES:
        raise InputError(f"--scan-frame is {scan_frame!r}; it is one of {', '.join(FRAMES)}")
    if scan_frame == "unknown" and pose is None:
        raise InputError(
            "--scan-frame unknown needs --part-pose X,Y,Z,RZ: an aligned shape does not say where "
            "the part stands on the bed"
        )
    if standing is not None and standing.suffix != ".npz":
        raise InputError(f"{standing}: what stands there is written as .npz; rename it")
    for path in filter(None, (output, report, standing)):
        console.writable(path)
    placed = part_pose(pose) if pose is not None else None
    setup = load_setup(printer, material, process)
    watch, bars = Stopwatch(), console.Bars()
    frame = "build" if scan_frame == "build" else "scanner"
    cloud = read_scan(scan, frame=frame, sensor_at=sensors(sensor_at))
    grid = _grid(job, setup)
    with bars.shown():
        with watch("template"):
            field = open_template(template, progress=bars)
        guess = placed.inverse() if placed is not None and frame == "build" else None
        plan = plan_repair(
            cloud,
            Site(field, setup, grid, placed if frame == "scanner" else None),
            title=f"repair of {scan.name}",
            guess=guess,
            rng=np.random.default_rng(seed),
            watch=watch,
            progress=bars,
        )
    program = plan.checked.program if plan.checked is not None else None
    if program is not None:
        text = program.text
        console.write_whole(output, lambda path: path.write_text(text, encoding="utf-8"))
    if standing is not None:
        console.write_whole(standing, plan.deficit.as_built.write)
    seconds = {stage: round(spent, 3) for stage, spent in watch.seconds.items()}
    result = plan_result(
        plan,
        gcode=str(output) if program is not None else None,
        seed=seed,
        seconds=seconds,
        setup=setup,
    )
    within = plan_is_enough(plan)
    if report is not None:
        data = report_of_plan(
            plan,
            result,
            title=f"Repair of {scan.name}",
            setup=setup,
            template=field,
            scan_name=scan.name,
        )
        console.write_whole(report, lambda path: write_report(data, path))
    if as_json:
        console.show_json(result)
    else:
        for line in summary_of_result(result, within_tolerance=within):
            console.out.print(line)
        if program is not None:
            console.out.print(f"Repair: {output}")
    if not within:
        raise typer.Exit(console.NOT_WITHIN_TOLERANCE)


def _grid(job: Path | None, setup: PrintSetup) -> LayerGrid:
    """Layers of the job, or of the process profile."""
    from gcode.moves import Program
    from gcode.reader import read_job
    from gcode.slicing.layers import LayerGrid

    if job is None:
        return LayerGrid.from_setup(setup)
    try:
        text = job.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"the job {job} cannot be read ({error.strerror})") from error
    read = read_job(
        Program(text, setup.printer.dialect),
        filament_diameter_mm=setup.printer.filament_diameter_mm,
        dialect=setup.printer.dialect,
    )
    return LayerGrid.from_tops(
        [layer.z_mm for layer in read.layers], layer_height_mm=setup.process.layer_height_mm
    )
