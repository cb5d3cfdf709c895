"""`amrepair loop`: print a job and repair it on the way, with a real printer and scanner."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amrepair.cli.inspect import TemplateOption
from amrepair.cli.live import (
    VIEW_PORT,
    HostOption,
    PortOption,
    TokenOption,
    ViewOption,
    live_view,
)
from amrepair.cli.options import (
    JsonOption,
    MaterialOption,
    PrinterOption,
    ProcessOption,
    SeedOption,
)
from amrepair.errors import InputError
from amrepair.report.guarded import LOOPBACK
from gcode.cli import console
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS

if TYPE_CHECKING:
    from amrepair.frames import Transform
    from amrepair.loop import Stop
    from amrepair.repair import RepairPlan, Site
    from amrepair.scans import Scanner
    from amrepair.template.port import Template
    from gcode.profiles import PrintSetup
    from gcode.reader import Job

APPROVALS = ("ask", "auto")


def add_to(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        "loop",
        epilog=console.examples(
            "amrepair loop job.gcode --template part.safetensors --port /dev/ttyACM0 "
            "--scanner watch:scans --every 20",
            "amrepair loop job.gcode --template part.stl --port /dev/ttyACM0 "
            "--scanner watch:scans --view",
            "amrepair loop job.gcode --template part.stl --port /dev/ttyACM0 "
            "--scanner watch:scans --approve auto --json",
        ),
    )(loop)


def loop(
    job_file: Annotated[Path, typer.Argument(metavar="JOB", help="G-code of the whole job.")],
    template: TemplateOption,
    port: Annotated[
        str,
        typer.Option(help="Device path, octoprint+http://HOST:PORT or moonraker+http://HOST:PORT."),
    ],
    scanner: Annotated[str, typer.Option(help="watch:DIR: a folder that scans are dropped in.")],
    printer: PrinterOption = DEFAULT_PRINTER,
    material: MaterialOption = DEFAULT_MATERIAL,
    process: ProcessOption = DEFAULT_PROCESS,
    approve: Annotated[str, typer.Option(help="ask before every repair, or auto.")] = "ask",
    every: Annotated[
        int, typer.Option(min=0, help="Scan after every so many layers; 0: only at the end.")
    ] = 0,
    at_layer: Annotated[
        list[int] | None, typer.Option("--at-layer", help="Scan after this layer, too.")
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(help="JSON file with build_from_scanner, 4×4; identity where left out."),
    ] = None,
    scan_timeout_s: Annotated[float, typer.Option(min=1.0, help="Wait for a scan.")] = 120.0,
    out: Annotated[Path, typer.Option(help="Folder for result, scans, report.")] = Path("out/loop"),
    view: ViewOption = False,
    view_host: HostOption = LOOPBACK,
    view_port: PortOption = VIEW_PORT,
    token: TokenOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Print a job; at chosen layers and at the end scan, repair what is missing, go on."""
    import numpy as np

    from amrepair.loop import locate_part, plan_stops, run_loop
    from amrepair.repair import Stopwatch
    from amrepair.report import report_of_loop, summary_of_result, write_report
    from amrepair.report.collect import loop_result
    from amrepair.report.folder import RunFolder
    from amrepair.template import open_template
    from gcode.check import check
    from gcode.hosts import connect
    from gcode.hosts.journal import default_path
    from gcode.profiles import load_setup

    if approve not in APPROVALS:
        raise InputError(f"--approve is {approve!r}; it is one of {', '.join(APPROVALS)}")
    setup = load_setup(printer, material, process)
    watch, bars = Stopwatch(), console.Bars()
    eye = _scanner(scanner, calibration, scan_timeout_s)
    folder = RunFolder(out)
    job = _job(job_file, setup)
    checked = check(job.program, setup)
    layers = [*range(every - 1, len(job.layers) - 1, every)] if every else []
    stops = plan_stops(job, [*layers, *(at_layer or [])])
    with watch("template"):
        field = open_template(template, progress=bars)
    with watch("locate"):
        placed = locate_part(job, field, layer_height_mm=setup.process.layer_height_mm)
    machine = connect(
        port,
        dialect=setup.printer.dialect,
        baud=setup.printer.baud,
        wire_log=folder.file("wire.log"),
        journal=default_path(port),
    )
    ask = approve == "ask"
    with live_view(
        view, ask=ask, title=job_file.name, host=view_host, port=view_port, token=token
    ) as page:
        page.show_run(job, _placed_solid(field, placed))
        machine.connect()
        page.drives(machine.pause, machine.resume)
        try:
            with bars.shown():
                report = run_loop(
                    job,
                    checked,
                    machine,
                    eye,
                    lambda stop: _site(job, stop, field, placed, setup),
                    stops=stops,
                    approve=(page.approve if view else _ask) if ask else lambda plan: True,
                    record=page.recording(folder.record),
                    rng=np.random.default_rng(seed),
                    watch=watch,
                    progress=page.watching(bars),
                )
        finally:
            machine.close()
    seconds = {stage: round(spent, 3) for stage, spent in watch.seconds.items()}
    printed = [look for look in report.looks if look.printed]
    last = str(folder.file(f"repair-{printed[-1].number}.gcode")) if printed else None
    result = loop_result(
        report, repaired_ratio=None, gcode=last, seed=seed, seconds=seconds, setup=setup
    )
    folder.write_json("result.json", result)
    within = report.within_tolerance
    data = report_of_loop(
        report,
        result,
        title=f"Run: {job_file.name}",
        setup=setup,
        about={"job": job_file.name},
        expected=_placed_solid(field, placed),
    )
    write_report(data, folder.file("report.html"))
    if as_json:
        console.show_json(result)
    else:
        for line in summary_of_result(result, within_tolerance=within):
            console.out.print(line)
        console.out.print(f"Report: {folder.file('report.html')}")
    if not within:
        raise typer.Exit(console.NOT_WITHIN_TOLERANCE)


def _job(path: Path, setup: PrintSetup) -> Job:
    from gcode.moves import Program
    from gcode.reader import read_job

    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"the job {path} cannot be read ({error.strerror})") from error
    return read_job(
        Program(text, setup.printer.dialect),
        filament_diameter_mm=setup.printer.filament_diameter_mm,
        dialect=setup.printer.dialect,
    )


def _scanner(spec: str, calibration: Path | None, timeout_s: float) -> Scanner:
    import numpy as np

    from amrepair.frames import Transform
    from amrepair.scans import WatchedFolderScanner

    if not spec.startswith("watch:"):
        raise InputError(
            f"--scanner is {spec!r}; give watch:DIR (a simulated scanner belongs to "
            "'amrepair simulate')"
        )
    pose = None
    if calibration is not None:
        try:
            matrix = np.array(json.loads(calibration.read_text())["build_from_scanner"], float)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"the calibration {calibration} cannot be read ({error}); it is a JSON object with "
                "build_from_scanner, a 4×4 matrix"
            ) from error
        if matrix.shape != (4, 4):
            raise InputError(f"the calibration {calibration} holds {matrix.shape}, not 4×4")
        pose = Transform("build", "scanner", matrix)
    folder = Path(spec.removeprefix("watch:"))
    return WatchedFolderScanner(folder, build_from_scanner=pose, timeout_s=timeout_s)


def _placed_solid(template: Template, placed: Transform) -> Any:
    """The part as it should be, where it stands."""
    solid: Any = template.solid()
    return solid.transform(placed.matrix[:3])


def _site(job: Job, stop: Stop, template: Template, placed: Transform, setup: PrintSetup) -> Site:
    """The finished part by its template; a layer by the beads that the job planned."""
    import numpy as np

    from amrepair.repair import Site
    from amrepair.template import PlannedSdf
    from gcode.slicing.layers import LayerGrid

    grid = LayerGrid.from_tops(
        [layer.z_mm for layer in job.layers], layer_height_mm=setup.process.layer_height_mm
    )
    if stop.layer_index is None:
        return Site(template, setup, grid, placed)
    z_mm = float(placed.inverse().apply(np.array([[0.0, 0.0, stop.z_mm]]))[0, 2])
    beads = job.beads
    done = (beads.line < stop.line) & (beads.layer >= 0)
    template_from_build = placed.inverse()
    planned = PlannedSdf.from_beads(
        template_from_build.apply(beads.start_mm[done]),
        template_from_build.apply(beads.end_mm[done]),
        beads.section_mm2[done],
        beads.height_mm[done],
    )
    return Site(template.below_z(z_mm), setup, grid, placed, stop.z_mm, planned=planned)


def _ask(plan: RepairPlan) -> bool:
    """Show what would be printed, and wait for a word."""
    cost = plan.estimate
    console.errors.print(
        f"{len(plan.to_fill)} regions, {plan.deficit.missing_mm3:.1f} mm³ missing; a repair takes "
        f"{cost.print_time_s if cost else 0:.0f} s and {cost.filament_mm if cost else 0:.0f} mm of "
        f"filament; the nozzle cannot reach {plan.unreachable_mm3:.1f} mm³."
    )
    return typer.confirm("Print it?", default=False, err=True)
