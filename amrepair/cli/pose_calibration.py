"""What `amrepair calibrate` does once its words are read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from amrepair.cli.scanners import Bed, open_scanner
from amrepair.errors import InputError, LoopError
from amrepair.frames import Transform
from amrepair.loop.calibrate import CalibrateOptions, calibrate, target_solid, write_calibration
from amrepair.loop.safe_exit import leave_safe
from amrepair.scans import Scan, ScanRequest, read_scan
from amrepair.template import MeshSdf, PlannedSdf
from amrepair.template.port import Template
from gcode.check import CheckedProgram, check
from gcode.cli import console
from gcode.cli.options import job_of
from gcode.hosts import connect
from gcode.hosts.journal import default_path
from gcode.hosts.port import Printer
from gcode.meshes import mesh_of
from gcode.profiles import PrintSetup, load_setup
from gcode.slicing.job import plan_part
from gcode.writer import write


@dataclass(frozen=True, slots=True)
class Source:
    """Where the scan comes from, and what stands there."""

    port: str | None
    scanner: str | None
    scan: Path | None
    job: Path | None
    layer: int
    timeout_s: float
    scan_unit: str | None


def write_target(path: Path, ids: tuple[str, str, str], *, as_json: bool) -> None:
    """Only the target's G-code."""
    setup = load_setup(*ids)
    console.writable(path)
    text = _target(setup).program.text
    console.write_text(path, text)
    if as_json:
        console.show_json({"gcode": str(path)})
    else:
        console.out.print(f"{path}: print it, scan it, then --scan FILE.")


def run(
    output: Path,
    ids: tuple[str, str, str],
    source: Source,
    *,
    max_residual_mm: float | None,
    seed: int,
    as_json: bool,
) -> None:
    """Find the scanner and write the file."""
    setup = load_setup(*ids)
    options = CalibrateOptions()
    if max_residual_mm is not None:
        options = replace(options, max_residual_mm=max_residual_mm)
    bars = console.Bars()
    console.writable(output)
    with bars.shown():
        standing = _standing(setup, source.job, source.layer)
        cloud = _scan(setup, source, bars)
        found = calibrate(cloud, standing, options=options, rng=np.random.default_rng(seed))
    about = {"printer": setup.printer.id, "scan": cloud.source}
    if source.scan_unit is not None:
        about["scan_unit"] = source.scan_unit.lower()
    write_calibration(output, found, about)
    if as_json:
        console.show_json({**found.to_json(), **about, "calibration": str(output), "seed": seed})
        return
    console.out.print(
        f"{output}: the target lies {found.residual_mm:.3f} mm off where it should be (limit "
        f"{options.max_residual_mm:g}), the bed {found.bed_mm:.3f} mm off a plane; "
        f"the next best turn fits {found.runner_up:.1f} times worse."
    )


def _standing(setup: PrintSetup, job: Path | None, layer: int) -> Template:
    """What stands on the bed, build frame."""
    if job is None:
        import trimesh

        vertices, faces = mesh_of(target_solid(setup.printer))
        return MeshSdf.from_mesh(trimesh.Trimesh(vertices, faces, process=False))
    made = job_of(job, setup)
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


def _scan(setup: PrintSetup, source: Source, bars: console.Bars) -> Scan:
    """The file, or what the scanner drops after the target was printed."""
    port, scanner, scan = source.port, source.scanner, source.scan
    if scan is not None:
        if port is not None or scanner is not None:
            raise InputError("--scan is a scan that there is; leave --port and --scanner out")
        return read_scan(scan, frame="scanner", unit=source.scan_unit)
    if port is None or scanner is None:
        raise InputError("give --port and --scanner to print and scan the target, or --scan FILE")
    nowhere = Transform.identity("build", "scanner")  # where it hangs is what is sought
    eye = open_scanner(scanner, Bed(nowhere, source.timeout_s, setup, scan_unit=source.scan_unit))
    checked = _target(setup)
    machine = connect(
        port,
        dialect=setup.printer.dialect,
        baud=setup.printer.baud,
        journal=default_path(port),
    )
    with bars.stage("connect"):
        machine.connect()
    try:
        _print_target(machine, checked, bars)
        return eye.scan(ScanRequest("target", None, float(setup.process.layer_height_mm)))
    finally:
        machine.close()


def _print_target(machine: Printer, checked: CheckedProgram, bars: console.Bars) -> None:
    """Print it to its end, or leave the printer safe."""
    try:
        with console.interrupts_as_such():
            report = machine.print(checked, progress=bars)
            machine.finish_moves()
        if not report.ok:
            raise LoopError("the target was stopped at the printer; print it anew")
    except BaseException:
        leave_safe(machine)
        raise
