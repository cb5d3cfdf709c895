"""What the loop costs: from a layer's scan to decision and checked G-code, and a clean layer.

    python benchmarks/bench_loop.py [PART] [--process repair_0.20] [--points 500000] [--looks 12]

A part's layers are laid into the simulated world, and scanned twice after each of some layers: as
printed, and with a pit in it. Then `run_loop` itself prints the job (into a file) with those scans
at its stops, record and all. Measured from outside, on the wall's clock:

- *repair*: from the scan's return to the moment the loop hands the checked repair to the printer;
- *clean*: from the last line of the job before a stop to the first after it, less the scan: what a
  clean layer costs.

Prints medians, 95th percentiles and the loop's own seconds by stage.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gcode.process import prepare

prepare()  # as the command lines do

import manifold3d as m3
import numpy as np

from amrepair.frames import Transform
from amrepair.loop import Look, LoopOptions, Records, Stop, Tape, plan_stops, run_loop
from amrepair.loop.sites import sites
from amrepair.policy import PolicyOptions
from amrepair.repair import Stopwatch
from amrepair.report.folder import RunFolder
from amrepair.scans import Scan, ScanRequest
from amrepair.simulate.run import PreparedRun, prepare_run
from amrepair.simulate.scanner import (
    ScannerModel,
    SimulatedScanner,
    default_sensors_mm,
    seeded_pose,
)
from amrepair.simulate.world import World
from amrepair.template import load_mesh, load_or_fit
from gcode.firmware.motion import MotionBatch
from gcode.hosts.file import FilePrinter
from gcode.hosts.port import PrintableProgram, PrintReport
from gcode.profiles import load_setup
from gcode.progress import Progress, silent

PART = Path(__file__).parents[1] / "examples" / "parts" / "bracket.stl"
PIT_MM, PIT_LAYERS = 8.0, 3
FIRST_LAYER = 30
# A part of the job takes a printer at least so long: what the loop prepares meanwhile is free.
LAYERS_S, BRIEF_LINES = 1.0, 200


class Clocked(FilePrinter):
    """A file that notes when each program reached it, and when it was done."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.calls: list[tuple[str, float, float]] = []

    def print(
        self,
        checked: PrintableProgram,
        *,
        lines: range | None = None,
        progress: Progress = silent,
    ) -> PrintReport:
        began = time.perf_counter()
        if lines is not None and len(lines) > BRIEF_LINES:
            time.sleep(LAYERS_S)
        report = super().print(checked, lines=lines, progress=progress)
        self.calls.append((checked.program.sha256, began, time.perf_counter()))
        return report


@dataclass
class Prepared:
    """Scans by stop's label: what was seen first, and after a repair."""

    scans: dict[str, list[Scan]]
    pose: Transform
    given: dict[str, tuple[float, float]] = field(default_factory=dict)
    looks: dict[str, int] = field(default_factory=dict)

    @property
    def build_from_scanner(self) -> Transform:
        return self.pose

    def scan(self, request: ScanRequest) -> Scan:
        began = time.perf_counter()
        nth = self.looks.get(request.label, 0)
        self.looks[request.label] = nth + 1
        scan = self.scans[request.label][min(nth, 1)]
        self.given.setdefault(request.label, (began, time.perf_counter()))
        return scan


def motion_of(run: PreparedRun, first: int, last: int) -> MotionBatch:
    """Beads of layers [first, last] as the printer would lay them, and a move away."""
    beads = run.job.beads
    mine = (beads.layer >= first) & (beads.layer <= last)
    start, end = beads.start_mm[mine], beads.end_mm[mine]
    area_mm2 = np.pi / 4 * run.setup.printer.filament_diameter_mm**2
    away = np.array([[0.0, 0.0, float(end[-1, 2]) + 20.0]])
    filament = np.linalg.norm(end - start, axis=1) * beads.section_mm2[mine] / area_mm2
    n = len(filament) + 1
    return MotionBatch(
        np.concatenate([start, away]),
        np.concatenate([end, away]),
        np.append(filament, 0.0),
        np.full(n, 50.0),
        np.arange(n) * 1.0,
    )


def pit_of(run: PreparedRun, stop: Stop, rng: np.random.Generator) -> m3.Manifold:
    """A round pit in a layer's top, where there is room for it."""
    beads = run.job.beads
    mine = beads.layer == stop.layer_index
    middle = 0.5 * (beads.start_mm + beads.end_mm)[mine]
    radius = PIT_MM / 2
    inside = run.template.distance(run.build_from_template.inverse().apply(middle))
    deepest = middle[np.argsort(inside)[: max(1, len(inside) // 10)]]
    centre = deepest[rng.integers(len(deepest))]
    depth = PIT_LAYERS * run.setup.process.layer_height_mm
    pit = m3.Manifold.cylinder(depth + 1.0, radius, radius, 48)
    return pit.translate((centre[0], centre[1], stop.z_mm - depth))


def scans_of(
    run: PreparedRun, stops: Sequence[Stop], points: int, seed: int
) -> tuple[dict[str, Scan], dict[str, Scan], Transform]:
    """Broken and clean scans of each stop, and the scanner's calibrated pose."""
    rng = np.random.default_rng(seed)
    printer = run.setup.printer
    box = run.part.bounding_box()
    centre = (0.5 * (box[0] + box[3]), 0.5 * (box[1] + box[4]))
    world = World(
        printer.bed_size_mm,
        nozzle_diameter_mm=printer.nozzle_diameter_mm,
        filament_diameter_mm=printer.filament_diameter_mm,
    )
    pose = seeded_pose(rng, centre_mm=centre)
    sensors = default_sensors_mm(centre)
    broken: dict[str, Scan] = {}
    clean: dict[str, Scan] = {}
    done, spacing = -1, 0.25
    for stop in stops:
        layer = stop.layer_index
        assert layer is not None
        world.deposit(motion_of(run, done + 1, layer))
        done = layer
        hurt = world.copy()
        hurt.remove(pit_of(run, stop, rng))
        request = ScanRequest(stop.label, layer, stop.z_mm)
        for scene, kept in ((hurt, broken), (world, clean)):
            while True:
                eye = SimulatedScanner(
                    scene, pose=pose, sensors_mm=sensors, rng=rng,
                    model=ScannerModel(spacing_mm=spacing),
                )  # fmt: skip
                scan = eye.scan(request)
                if len(scan) >= points:
                    break
                spacing *= 0.98 * float(np.sqrt(len(scan) / points))
            pick = np.sort(rng.permutation(len(scan))[:points])
            kept[stop.label] = scan.subset(pick)
    return broken, clean, pose.build_from_scanner_calibrated


def measure(
    run: PreparedRun, stops: Sequence[Stop], eye: Prepared, folder: Path, *, repair: bool
) -> tuple[list[float], dict[str, list[float]]]:
    """Seconds at each stop, and the loop's own by stage."""
    printer = Clocked(folder / "sent.gcode")
    printer.connect()
    watch, kept = Stopwatch(), RunFolder(folder)
    stages: dict[str, list[float]] = {}
    before: dict[str, float] = {}

    def record(look: Look) -> None:
        for name, total in watch.seconds.items():
            stages.setdefault(name, []).append(total - before.get(name, 0.0))
            before[name] = total
        kept.record(look)

    report = run_loop(
        run.job, run.checked, printer, eye,
        sites(run.job, run.template, run.build_from_template, run.setup, by_beads=run.by_beads),
        stops=stops, options=LoopOptions(policy=PolicyOptions(most_passes=1)),
        records=Records(record, kept.keep_scan, Tape(folder), watch=watch),
    )  # fmt: skip
    printer.close()
    spent = []
    job = run.checked.program.sha256
    for look in report.first_looks:
        if look.printed != repair:
            raise SystemExit(f"{look.stop.label}: {look.decision.action} ({look.decision.reason})")
        asked, given = eye.given[look.stop.label]
        if repair:
            spent.append(next(t for _, t, _ in printer.calls if t > given) - given)
        else:
            rested = max(end for sha, _, end in printer.calls if sha == job and end < asked)
            gone_on = min(begin for sha, begin, _ in printer.calls if sha == job and begin > given)
            spent.append(gone_on - rested - (given - asked))
    return spent, stages


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", nargs="?", type=Path, default=PART)
    parser.add_argument("--process", default="repair_0.20")
    parser.add_argument("--points", type=int, default=500_000)
    parser.add_argument("--looks", type=int, default=12, help="of each kind, and one to warm up")
    parser.add_argument("--every", type=int, default=2, help="layers from look to look")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    setup = load_setup(process=args.process)
    run = prepare_run(load_or_fit(load_mesh(args.part)), setup, [], title="job", seed=args.seed)
    layers = range(FIRST_LAYER, FIRST_LAYER + args.every * (args.looks + 1), args.every)
    stops = plan_stops(run.job, list(layers), final=False)
    broken, clean, pose = scans_of(run, stops, args.points, args.seed)
    for repair, first in ((True, broken), (False, clean)):
        scans = {label: [scan, clean[label]] for label, scan in first.items()}
        with tempfile.TemporaryDirectory() as folder:
            spent, stages = measure(run, stops, Prepared(scans, pose), Path(folder), repair=repair)
        spent = spent[1:]
        print(
            json.dumps(
                {
                    "what": "repair" if repair else "clean",
                    "part": args.part.stem,
                    "process": args.process,
                    "points": args.points,
                    "looks": len(spent),
                    "median_s": round(statistics.median(spent), 3),
                    "p95_s": round(float(np.percentile(spent, 95)), 3),
                    "most_s": round(max(spent), 3),
                    "stages_median_s": {
                        name: round(statistics.median(values[1:] or values), 3)
                        for name, values in stages.items()
                    },
                }
            ),
            flush=True,
        )


if __name__ == "__main__":
    main()
