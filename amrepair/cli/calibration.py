"""`amrepair calibrate`: print a target, scan it, write where the scanner hangs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from amrepair.cli.options import (
    JsonOption,
    MaterialOption,
    PrinterOption,
    ProcessOption,
    SeedOption,
)
from amrepair.errors import InputError
from amrepair.loop.calibrate import (
    MAX_RESIDUAL_MM,
    calibrate,
    target_solid,
    write_calibration,
)
from amrepair.scans import Scan, ScanRequest, WatchedFolderScanner, read_scan
from amrepair.template import MeshSdf, PlannedSdf
from amrepair.template.port import Template
from gcode.check import CheckedProgram, check
from gcode.cli import console
from gcode.hosts import connect
from gcode.hosts.journal import default_path, is_device
from gcode.moves import Program
from gcode.profiles import (
    DEFAULT_MATERIAL,
    DEFAULT_PRINTER,
    DEFAULT_PROCESS,
    PrintSetup,
    load_setup,
)
from gcode.reader import read_job
from gcode.slicing.job import plan_part
from gcode.slicing.layers import mesh_of
from gcode.writer import write


def add_to(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        "calibrate",
        epilog=console.examples(
            "amrepair calibrate --port /dev/ttyACM0 --scanner watch:scans -o calibration.json",
            "amrepair calibrate --target-gcode target.gcode",
            "amrepair calibrate --scan target.ply -o calibration.json",
            "amrepair calibrate --scan layer.ply --job job.gcode --layer 0 --json",
        ),
    )(calibrate_command)


def calibrate_command(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="File to write, for 'loop --calibration'.")
    ] = Path("calibration.json"),
    printer: PrinterOption = DEFAULT_PRINTER,
    material: MaterialOption = DEFAULT_MATERIAL,
    process: ProcessOption = DEFAULT_PROCESS,
    port: Annotated[
        str | None, typer.Option(help="Print the target there: device path, or a server's.")
    ] = None,
    scanner: Annotated[
        str | None, typer.Option(help="watch:DIR: where the scan of the target will be dropped.")
    ] = None,
    scan: Annotated[
        Path | None, typer.Option(help="Scan of a target, or layer, that stands there already.")
    ] = None,
    job: Annotated[
        Path | None, typer.Option(help="The job whose layers stand there, instead of the target.")
    ] = None,
    layer: Annotated[
        int, typer.Option(min=0, help="Last layer that stands there, counted from 0.")
    ] = 0,
    target_gcode: Annotated[
        Path | None, typer.Option(help="Only write the target's G-code, to print it elsewhere.")
    ] = None,
    max_residual_mm: Annotated[
        float, typer.Option(min=0.001, max=1.0, help="Refuse a calibration that is worse.")
    ] = MAX_RESIDUAL_MM,
    scan_timeout_s: Annotated[float, typer.Option(min=1.0, help="Wait for a scan.")] = 120.0,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Find where the scanner hangs over the bed, from a printed target or a job's first layers."""
    setup = load_setup(printer, material, process)
    bars = console.Bars()
    if target_gcode is not None:
        console.writable(target_gcode)
        text = _target(setup).program.text
        console.write_whole(target_gcode, lambda path: path.write_text(text, encoding="utf-8"))
        if as_json:
            console.show_json({"gcode": str(target_gcode)})
        else:
            console.out.print(f"{target_gcode}: print it, scan it, then --scan FILE.")
        return
    console.writable(output)
    with bars.shown():
        standing = _standing(setup, job, layer)
        cloud = _scan(setup, port, scanner, scan, scan_timeout_s, bars)
        found = calibrate(
            cloud, standing, max_residual_mm=max_residual_mm, rng=np.random.default_rng(seed)
        )
    about = {"printer": setup.printer.id, "scan": cloud.source}
    write_calibration(output, found, about)
    if as_json:
        console.show_json({**found.to_json(), **about, "calibration": str(output), "seed": seed})
        return
    console.out.print(
        f"{output}: the target lies {found.residual_mm:.3f} mm off where it should be (limit "
        f"{max_residual_mm:g}), the bed {found.bed_mm:.3f} mm off a plane; the next best turn fits "
        f"{found.runner_up:.1f} times worse."
    )


def _standing(setup: PrintSetup, job: Path | None, layer: int) -> Template:
    """What stands on the bed, build frame."""
    if job is None:
        import trimesh

        vertices, faces = mesh_of(target_solid(setup.printer))
        return MeshSdf.from_mesh(trimesh.Trimesh(vertices, faces, process=False))
    try:
        text = job.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"the job {job} cannot be read ({error.strerror})") from error
    made = read_job(
        Program(text, setup.printer.dialect),
        filament_diameter_mm=setup.printer.filament_diameter_mm,
        dialect=setup.printer.dialect,
    )
    if layer >= len(made.layers):
        raise InputError(f"--layer is {layer}; the job has layers 0 to {len(made.layers) - 1}")
    beads = made.beads
    done = (beads.layer >= 0) & (beads.layer <= layer)
    return PlannedSdf.from_beads(
        beads.start_mm[done], beads.end_mm[done], beads.section_mm2[done], beads.height_mm[done]
    )


def _target(setup: PrintSetup) -> CheckedProgram:
    """The target's program."""
    plan = plan_part(target_solid(setup.printer), setup)
    return check(write(plan.toolpath, setup, title="calibration target"), setup)


def _scan(
    setup: PrintSetup,
    port: str | None,
    scanner: str | None,
    scan: Path | None,
    timeout_s: float,
    bars: Any,
) -> Scan:
    """The file, or what the scanner drops after the target was printed."""
    if scan is not None:
        if port is not None or scanner is not None:
            raise InputError("--scan is a scan that there is; leave --port and --scanner out")
        return read_scan(scan, frame="scanner")
    if port is None or scanner is None or not scanner.startswith("watch:"):
        raise InputError(
            "give --port and --scanner watch:DIR to print and scan the target, or --scan FILE"
        )
    eye = WatchedFolderScanner(Path(scanner.removeprefix("watch:")), timeout_s=timeout_s)
    checked = _target(setup)
    machine = connect(
        port,
        dialect=setup.printer.dialect,
        baud=setup.printer.baud,
        journal=default_path(port) if is_device(port) else None,
    )
    machine.connect()
    try:
        machine.print(checked, progress=bars)
        machine.finish_moves()
        return eye.scan(ScanRequest("target", None, float(setup.process.layer_height_mm)))
    finally:
        machine.close()
