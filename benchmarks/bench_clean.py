"""False alarms: clean prints with noise in flow and scan must not be repaired.

    python benchmarks/bench_clean.py --slice part.stl [--cura-definitions DIR]
    AMREPAIR_DATA=… python benchmarks/bench_clean.py --every 5 --layers 100 --minutes 10
    python benchmarks/bench_clean.py --own bracket:standard_0.20 --every 10

Every job is printed into the simulated world of `world.toml` (wandering flow, shrinkage, curl,
noise, dropouts, outliers), scanned after every `--every` layers, and judged by its own planned
beads, as the loop judges layers with sparse infill; a look that wants a repair, or halts the job,
is a false alarm.
Jobs are the files of `--jobs`, those that `--slice` made of a part, and `PART:PROCESS` sliced by
us. Lines of JSON in `--results`, one per job and call; a job goes on after the layers that it has
there, and a call ends after `--minutes`.

`--slice` makes 15 % infill in four patterns with PrusaSlicer and, where the folder with its
`fdmprinter.def.json` is told, with CuraEngine.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np

from amrepair.frames import Transform
from amrepair.loop.findings import findings
from amrepair.loop.kinds import typed
from amrepair.policy.table import Action, judge
from amrepair.regions.planned_beads import PlannedBeads
from amrepair.repair import Site, plan_repair
from amrepair.scans import ScanRequest
from amrepair.simulate.flow import noisy_flow
from amrepair.simulate.parameters import DEFAULT_SCANNER, WorldParameters, load_world
from amrepair.simulate.scanner import SimulatedScanner
from amrepair.simulate.world import World
from amrepair.template import PlannedSdf, load_mesh
from gcode.firmware.motion import MotionBatch
from gcode.moves import Program
from gcode.profiles import PrintSetup, load_setup
from gcode.reader import Job, read_job
from gcode.slicing.job import plan_part
from gcode.slicing.layers import LayerGrid
from gcode.solids import as_manifold
from gcode.writer import write

OURS = Path(__file__).parents[1] / "examples" / "parts"
# Not the PrusaSlicer cube of the same folder: its layer at z = 0.45 was cut out of the file, and
# looks that want those 45 mm³ back are right.
FILES = ("cura_slicer", "orca_slicer", "plant-sign", "screw")
PRUSA_PATTERNS = ("rectilinear", "grid", "gyroid", "honeycomb")
# Cura's lines lie as many line widths apart as its own formulas say for 15 % (fdmprinter.def.json).
CURA_PATTERNS = {"lines": 2.667, "grid": 5.333, "triangles": 8.0, "gyroid": 2.667}
# A clean print that is stopped, or looked at twice, is as false an alarm as one that is repaired.
HALTS = (Action.STOP, Action.PAUSE, Action.LOOK_AGAIN)
MOST_CURL_MM = 0.05  # a quarter of a layer; by the world's parabola ends of 130 mm rise by 0.34
HERE = Transform.identity("build", "template")
FILAMENT_MM2 = float(np.pi / 4 * 1.75**2)


def slice_jobs(part: Path, folder: Path, definitions: Path | None) -> list[str]:
    """Jobs with 15 % infill of whatever slicers this machine has; their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    common = ["--layer-height", "0.2", "--first-layer-height", "0.2", "--filament-diameter", "1.75"]
    if shutil.which("prusa-slicer"):
        for pattern in PRUSA_PATTERNS:
            path = folder / f"prusa-{pattern}.gcode"
            subprocess.run(
                [
                    *("prusa-slicer", "-g", *common, "--nozzle-diameter", "0.4"),
                    *("--perimeters", "2", "--fill-density", "15%", "--fill-pattern", pattern),
                    *("--center", "60,60", "-o", str(path), str(part)),
                ],
                check=True,
                capture_output=True,
            )
            made.append(str(path))
    if definitions is not None and shutil.which("CuraEngine"):
        for pattern, apart_mm in CURA_PATTERNS.items():
            path = folder / f"cura-{pattern}.gcode"
            told = {
                "infill_pattern": pattern, "infill_sparse_density": 15,
                "infill_line_distance": apart_mm, "infill_sparse_thickness": 0.2,
                "layer_height": 0.2, "layer_height_0": 0.2, "machine_width": 120,
                "machine_depth": 120, "machine_center_is_zero": "false", "top_layers": 4,
                "bottom_layers": 4, "wall_line_count": 2,
            }  # fmt: skip
            options = [word for key, value in told.items() for word in ("-s", f"{key}={value}")]
            subprocess.run(
                [
                    *("CuraEngine", "slice", "-j", str(definitions / "fdmprinter.def.json")),
                    *(*options, "-e0", "-s", "material_diameter=1.75"),
                    *("-l", str(part), "-o", str(path)),
                ],
                check=True,
                capture_output=True,
            )
            made.append(str(path))
    return made


def job_of(name: str, setup: PrintSetup) -> Job:
    """A job of a real slicer, or `PART:PROCESS` sliced by us."""
    if ":" in name:
        part, process = name.split(":")
        own = load_setup(process=process)
        mesh = load_mesh(OURS / f"{part}.stl")
        low, high = mesh.bounds
        mesh.apply_translation(
            [125 - (low[0] + high[0]) / 2, 105 - (low[1] + high[1]) / 2, -low[2]]
        )
        solid = as_manifold(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        program = write(plan_part(solid, own).toolpath, own, title=part)
    else:
        path = Path(name)
        if path.suffix != ".gcode":
            path = Path(os.environ["AMREPAIR_DATA"]) / "gcode" / f"{name}.gcode"
        program = Program(path.read_text(errors="replace"), "marlin")
    return read_job(program, filament_diameter_mm=1.75, dialect=program.dialect)


def motion_of(job: Job, first: int, last: int) -> MotionBatch:
    """Beads of layers [first, last], and a move away."""
    beads = job.beads
    mine = (beads.layer >= first) & (beads.layer <= last)
    start, end = beads.start_mm[mine], beads.end_mm[mine]
    length_mm = np.linalg.norm(end - start, axis=1)
    away = np.array([[0.0, 0.0, float(end[-1, 2]) + 20.0]])
    filament = np.append(length_mm * beads.section_mm2[mine] / FILAMENT_MM2, 0.0)
    n = len(filament)
    return MotionBatch(
        np.concatenate([start, away]),
        np.concatenate([end, away]),
        filament,
        np.full(n, 50.0),
        np.arange(n) * 1.0,
    )


def site_of(job: Job, layer: int, setup: PrintSetup) -> Site:
    """The planned beads after a layer, in the build frame."""
    beads = job.beads
    done = (beads.layer >= 0) & (beads.layer <= layer)
    start, end = beads.start_mm[done], beads.end_mm[done]
    section, height = beads.section_mm2[done], beads.height_mm[done]
    planned = PlannedSdf.from_beads(start, end, section, height)
    lines = PlannedBeads.recent(start, end, section, height)
    tops = [one.z_mm for one in job.layers]
    grid = LayerGrid.from_tops(tops, layer_height_mm=setup.process.layer_height_mm)
    return Site(planned, setup, grid, HERE, tops[layer], planned=planned, beads=lines)


def run_job(
    name: str,
    *,
    every: int,
    most: int,
    after: int,
    seed: int,
    told: WorldParameters,
    scanner_name: str,
    until_s: float,
) -> dict[str, Any]:
    """Print up to `most` layers beyond layer `after`, with a look after every few."""
    began = time.perf_counter()
    setup = load_setup()
    job = job_of(name, setup)
    beads = job.beads
    part = beads.layer >= 0
    low, high = beads.start_mm[part].min(axis=0), beads.start_mm[part].max(axis=0)
    rng = np.random.default_rng([seed, len(name)])
    centre = (float(low[0] + high[0]) / 2, float(low[1] + high[1]) / 2)
    # a print whose ends have come off the bed is not a clean one
    far_mm = 0.5 * float(np.hypot(*(high - low)[:2]))
    curl = min(told.thermal.curl_per_mm, MOST_CURL_MM / far_mm**2)
    world = World(
        (float(max(high[0] + 20, 60)), float(max(high[1] + 20, 60))),
        cell_mm=told.columns_mm,
        bead=told.bead,
        thermal=told.thermal.model_copy(update={"curl_per_mm": curl}),
        middle_mm=centre,
    )
    scanner = SimulatedScanner.seeded(
        world, told, scanner_name, centre_mm=centre, high_mm=float(high[2]), rng=rng
    )
    last = min(len(job.layers) - 1, after + most)
    flow_rng = np.random.default_rng([seed, len(name), 1])
    alarms, looks, done = [], 0, -1
    for layer in range(every - 1, last + 1, every):
        if looks and time.monotonic() > until_s:
            break
        world.deposit(noisy_flow(motion_of(job, done + 1, layer), flow_rng, told.flow))
        done = layer
        if layer <= after:
            continue
        site = site_of(job, layer, setup)
        scan = scanner.scan(ScanRequest(f"layer-{layer:03d}", layer, job.layers[layer].z_mm))
        plan = plan_repair(
            scan,
            site,
            title="clean",
            guess=HERE.inverse() @ scanner.build_from_scanner,
            strict=False,
        )
        looks += 1
        if plan.to_fill:
            alarms.append([layer, round(sum(r.volume_mm3 for r in plan.to_fill), 2)])
        line = job.layers[layer].end_line
        plan = typed(plan, job, site, line, scanner.build_from_scanner)
        found = findings(plan, job, setup, layer_index=layer, line=line)
        halting = [v for v in map(judge, found) if v.action in HALTS]
        alarms += [[layer, f"{v.action}: {v.finding.type}, {v.row}"] for v in halting]
    return {
        "job": name,
        "layers": [after + 1, done],
        "of": len(job.layers),
        "scanner": scanner_name,
        "world": told.sha256[:12],
        "looks": looks,
        "alarms": alarms,
        "seconds": round(time.perf_counter() - began, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", nargs="*", default=list(FILES))
    parser.add_argument("--own", nargs="*", default=[], metavar="PART:PROCESS")
    parser.add_argument("--every", type=int, default=5)
    parser.add_argument("--layers", type=int, default=100, help="of each job in this call")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--world", type=Path, help="TOML with what differs from the shipped world")
    parser.add_argument("--scanner", default=DEFAULT_SCANNER)
    parser.add_argument("--minutes", type=float, default=10.0, help="of this call, at most")
    parser.add_argument("--slice", type=Path, metavar="STL", help="make jobs of it, and no more")
    parser.add_argument("--cura-definitions", type=Path, metavar="DIR")
    parser.add_argument("--folder", type=Path, default=Path("out/clean-jobs"))
    parser.add_argument("--results", type=Path, default=Path("out/clean.jsonl"))
    args = parser.parse_args()
    if args.slice is not None:
        print("\n".join(slice_jobs(args.slice, args.folder, args.cura_definitions)))
        return
    told, until_s = load_world(args.world), time.monotonic() + 60 * args.minutes
    args.results.parent.mkdir(parents=True, exist_ok=True)
    text = args.results.read_text() if args.results.is_file() else ""
    rows = [json.loads(line) for line in text.splitlines()]
    for name in [*args.jobs, *args.own]:
        after = max((row["layers"][1] for row in rows if row["job"] == name), default=-1)
        if time.monotonic() > until_s:
            break
        if any(row["job"] == name and row["layers"][1] + args.every >= row["of"] for row in rows):
            continue  # to its end already
        row = run_job(
            name,
            every=args.every,
            most=args.layers,
            after=after,
            seed=args.seed,
            told=told,
            scanner_name=args.scanner,
            until_s=until_s,
        )
        rows.append(row)
        with args.results.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(json.dumps(row), flush=True)
    layers = sum(row["layers"][1] - row["layers"][0] + 1 for row in rows)
    looks = sum(row["looks"] for row in rows)
    print(f"{layers} layers, {looks} looks, {sum(len(row['alarms']) for row in rows)} alarms")


if __name__ == "__main__":
    main()
