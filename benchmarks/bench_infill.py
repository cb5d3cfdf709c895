"""Voids through walls, sparse infill and skins of PrusaSlicer's jobs, mended in the closed loop.

    python benchmarks/bench_infill.py --page                        # all cases, the page's table
    python benchmarks/bench_infill.py --parts block --cuts wall --ways gyroid --late

A part is cut by the installed PrusaSlicer with 15 % infill of a pattern, two perimeters and three
solid layers above and below, and printed into the simulated world (wandering flow, shrinkage, curl,
a noisy scanner). For four layers nothing is extruded inside a circle: in open cells alone, through
the wall and the cells beside it, from cells up into the top's skin, or from the bottom's skin up
into cells. The loop looks after each layer of it, or with `--late` once after the last of them.
Truth is the world against one printed by the same motion without the void. *Again* is what the same
world says of the job's own lines laid once more inside the circle, by a nozzle that nothing is in
the way of: two clean prints of a wall one bead wide do not lie in the same columns, either. Of what
is found late the outside judge's head (`tests/judge`) says how much it reaches at all, and how much
of that is filled.

Blocks are what was looked at while the planner was written; the other parts were held back.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gcode.process import prepare

prepare()  # as the command lines do

import manifold3d as m3
import measured_page
import numpy as np
from bench_clean import FILAMENT_MM2, motion_of
from bench_clean_jobs import COMMON, PARTS, mesh_of
from bench_closed_loop import CorePrinter, figures

from amrepair.frames import Transform
from amrepair.loop import LoopOptions, LoopReport, locate_part, plan_stops, run_loop
from amrepair.loop.sites import sites
from amrepair.policy import PolicyOptions
from amrepair.scans import Scan, ScanRequest
from amrepair.simulate.columns import IntervalMap
from amrepair.simulate.flow import noisy_flow
from amrepair.simulate.parameters import load_world
from amrepair.simulate.placed import PlacedDefect
from amrepair.simulate.run import set_stage
from amrepair.simulate.stage import Stage
from amrepair.template import MeshSdf
from gcode.check import CheckedProgram, check
from gcode.firmware import MotionBatch
from gcode.moves import Program
from gcode.profiles import PrintSetup, load_setup
from gcode.reader import Job, job_for

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.judge.head import HEADS, Reaching, least_tip, reachable

LAYER_MM, SKINS, LAYERS = 0.2, 3, 4
AROUND_MM = 3.0
LEAST_MM3 = 2.0  # less of a void holds no line across it
WAYS = ("grid", "gyroid", "line")  # as PrusaSlicer calls its patterns
POLICY = PolicyOptions(most_passes=2)
HELD_BACK = ("bracket", "button", "clip")
VOXEL_MM = 0.05  # in Z; across, the world's own columns
REACHED = ("reachable_ratio", "filled_of_reachable")


@dataclass(frozen=True)
class Cut:
    """A circle in which nothing is extruded: where, how wide, and in which layers.

    Attributes
    ----------
    at
        Of the part's box, from its low corner, 0 to 1; 0 or 1 is on the wall.
    last
        The last of its layers, of a job of so many.
    """

    at: tuple[float, float]
    diameter_mm: float
    last: Callable[[int], int]


CUTS = {
    "cells": Cut((0.5, 0.5), 9.0, lambda layers: layers // 2),
    "wall": Cut((0.45, 0.0), 9.0, lambda layers: layers // 2),
    "top skin": Cut((0.4, 0.1), 9.0, lambda layers: layers - 2),
    "bottom skin": Cut((0.55, 0.9), 9.0, lambda layers: SKINS + 1),
}


def block() -> m3.Manifold:
    """A plain block, 32 × 24 × 5 mm."""
    return m3.Manifold.cube((32.0, 24.0, 5.0))


@dataclass(frozen=True)
class Printed:
    """A job of PrusaSlicer's with what goes wrong in it, as `set_stage` and `CorePrinter` ask."""

    setup: PrintSetup
    part: m3.Manifold
    job: Job
    checked: CheckedProgram
    defects: tuple[PlacedDefect, ...]
    seed: int


def sliced(part: m3.Manifold, way: str, setup: PrintSetup) -> CheckedProgram:
    """The part's job by PrusaSlicer, its middle in the bed's middle.

    Raises
    ------
    SystemExit
        If PrusaSlicer is not installed.
    """
    slicer = shutil.which("prusa-slicer")
    if slicer is None:
        raise SystemExit("prusa-slicer is not on the path; install it")
    x_mm, y_mm = (0.5 * size for size in setup.printer.bed_size_mm[:2])
    with tempfile.TemporaryDirectory() as folder:
        stl, text = Path(folder) / "part.stl", Path(folder) / "part.gcode"
        mesh_of(part).export(stl)
        subprocess.run(
            [slicer, "-g", *COMMON, "--center", f"{x_mm:g},{y_mm:g}", "--perimeters", "2",
             "--top-solid-layers", str(SKINS), "--bottom-solid-layers", str(SKINS),
             "--fill-density", "15%", "--fill-pattern", way, "-o", str(text), str(stl)],
            check=True,
            capture_output=True,
        )  # fmt: skip
        return check(Program(text.read_text(), setup.printer.dialect), setup)


def void(cut: Cut, part: m3.Manifold, job: Job) -> PlacedDefect:
    """Where nothing is extruded."""
    low, high = np.asarray(part.bounding_box()).reshape(2, 3)
    last = cut.last(len(job.layers))
    layers = tuple(range(last - LAYERS + 1, last + 1))
    tops_mm = [layer.z_mm for layer in job.layers]
    middle = low[:2] + np.array(cut.at) * (high - low)[:2]
    half_mm = 0.5 * cut.diameter_mm
    from_mm, to_mm = tops_mm[layers[0]] - 0.5 * LAYER_MM, tops_mm[last] + 0.5 * LAYER_MM
    region = [*middle, 1.0, 0.0, half_mm, half_mm, from_mm, to_mm, 0.0]
    box = np.array([[*(middle - half_mm), tops_mm[layers[0]] - LAYER_MM],
                    [*(middle + half_mm), tops_mm[last]]])  # fmt: skip
    return PlacedDefect("void", layers, np.array([region]), None, None, box)


def run(name: str, way: str, cut: str, *, late: bool, seed: int) -> dict[str, Any] | None:
    """Print, break and mend; what became of it. None where the job lays nothing in the circle."""
    began = time.perf_counter()
    printed, report, looked = mended(name, way, cut, late=late, seed=seed)
    stage = looked.stage
    if stage.truth[0].missing_mm3 < LEAST_MM3:
        return None
    return (
        {"part": name, "way": way, "cut": cut, "late": late, "seed": seed}
        | figures(report, stage.truth[0], printed.defects[0].layers)
        | {"again_ratio": round(again(printed, late=late), 4)}
        | (dict(zip(REACHED, of_reachable(looked, printed), strict=True)) if late else {})
        | {"seconds": round(time.perf_counter() - began, 1)}
    )


def mended(
    name: str, way: str, cut: str, *, late: bool, seed: int
) -> tuple[Printed, LoopReport, Looked]:
    """The job up to where its void is repaired."""
    setup = load_setup()
    whole = block() if name == "block" else PARTS[name]()
    checked = sliced(whole, way, setup)
    job = job_for(checked.program, setup.printer)
    template = MeshSdf.from_mesh(mesh_of(whole))
    placed = locate_part(job, template, layer_height_mm=LAYER_MM)
    part = whole.transform(placed.matrix[:3])
    defect = void(CUTS[cut], part, job)
    printed = Printed(setup, part, job, checked, (defect,), seed)
    stops = plan_stops(job, defect.layers[-1:] if late else defect.layers, final=False)
    printer = CorePrinter(printed, stops[-1])  # type: ignore[arg-type]
    stage = set_stage(printed, printer.take_motion)  # type: ignore[arg-type]
    looked = Looked(stage)
    report = run_loop(
        job, checked, printer, looked, sites(job, template, placed, setup),
        stops=stops, options=LoopOptions(policy=POLICY, seed=seed),
    )  # fmt: skip
    return printed, report, looked


class Looked:
    """A stage that remembers what stood there at its first look, before any repair."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.before: IntervalMap | None = None

    @property
    def build_from_scanner(self) -> Transform:
        """The stage's."""
        return self.stage.build_from_scanner

    def scan(self, request: ScanRequest) -> Scan:
        """As the stage has it."""
        scan = self.stage.scan(request)
        if self.before is None:
            self.before = self.stage.world.snapshot()
        return scan


def of_reachable(looked: Looked, printed: Printed) -> tuple[float, float]:
    """Of what one stop found missing: the share that the head reaches, and of that what is filled.

    By the outside judge's own head and its own rule (`tests/judge`), on the world's columns.
    """
    standing, world, box_mm = looked.before, looked.stage.world, printed.defects[0].box_mm
    assert standing is not None
    sound = looked.stage.reference.snapshot(standing.window)
    missing, after = sound.minus(standing).clipped(box_mm), world.snapshot(standing.window)
    low_mm = float(box_mm[0, 2])
    heights = np.arange(low_mm + 0.5 * VOXEL_MM, float(box_mm[1, 2]), VOXEL_MM)
    tops_mm = np.ascontiguousarray(standing.top_mm().T)
    window = (slice(0, tops_mm.shape[0]), slice(0, tops_mm.shape[1]))
    head = HEADS[printed.setup.printer.id]
    least_mm = least_tip(tops_mm, window, world.cell_mm, head)
    by = Reaching(
        least_mm, world.cell_mm, low_mm, VOXEL_MM, bead_mm=0.45, layer_mm=LAYER_MM,
        allowed_mm=0.1,
    )  # fmt: skip
    gone, stands, laid = (solid_at(each, heights) for each in (missing, standing, after))
    reach = reachable(gone, stands, by, tip_layers=1.0, held=False)
    return float(reach.sum() / gone.sum()), float((laid & reach).sum() / reach.sum())


def solid_at(columns: IntervalMap, heights_mm: np.ndarray) -> np.ndarray:
    """(nx, ny, nz) whether columns are solid at heights."""
    found = np.zeros((len(columns.offsets) - 1, len(heights_mm)), dtype=bool)
    column = np.repeat(np.arange(len(found)), np.diff(columns.offsets))
    for (a, b), k in zip(columns.spans_mm, column, strict=True):
        found[k, np.searchsorted(heights_mm, a) : np.searchsorted(heights_mm, b)] = True
    ny, nx = columns.window.shape
    return np.ascontiguousarray(found.reshape(ny, nx, -1).transpose(1, 0, 2))


def empty_stage(printed: Printed) -> Stage:
    """A world in which nothing is printed, with its scanner; its printer tells nothing."""
    nothing = MotionBatch.from_bytes(b"")
    return set_stage(printed, lambda: nothing)  # type: ignore[arg-type]


def again(printed: Printed, *, late: bool) -> float:
    """Share filled where the job's own lines are laid once more, whatever stands in the way."""
    job, defect, told = printed.job, printed.defects[0], load_world()
    broken, sound = empty_stage(printed).world, empty_stage(printed).world
    rng = np.random.default_rng([printed.seed, 4])
    low, high = defect.box_mm[:, :2] + np.array([[-AROUND_MM], [AROUND_MM]])
    window = sound.columns.box_window(tuple(low), tuple(high))
    missing, done = [], -1
    for layer in defect.layers[-1:] if late else defect.layers:
        motion = noisy_flow(motion_of(job, done + 1, layer), rng, told.flow)
        sound.deposit(motion)
        broken.deposit(motion, [defect])
        done = layer
        lost = sound.snapshot(window).minus(broken.snapshot(window)).clipped(defect.box_mm)
        for earlier in missing:
            lost = lost.minus(earlier)
        missing.append(lost)
        for one in defect.layers if late else (layer,):
            lines = noisy_flow(inside(job, one, defect.flow_regions[0]), rng, told.flow)
            broken.deposit(lines, onto_cold=True)
    stands = broken.snapshot(window)
    filled_mm3 = sum(each.common(stands).volume_mm3 for each in missing)
    return filled_mm3 / sum(each.volume_mm3 for each in missing)


def inside(job: Job, layer: int, circle: np.ndarray) -> MotionBatch:
    """A layer's lines as far as they lie in a circle, and a move away."""
    beads = job.beads
    mine = beads.layer == layer
    start, over = beads.start_mm[mine], (beads.end_mm - beads.start_mm)[mine]
    from_middle = start[:, :2] - circle[:2]
    a = np.maximum((over[:, :2] ** 2).sum(axis=1), 1e-12)
    b = (from_middle * over[:, :2]).sum(axis=1)
    root = np.sqrt(np.clip(b**2 - a * ((from_middle**2).sum(axis=1) - circle[4] ** 2), 0.0, None))
    low, high = (np.clip((sign * root - b) / a, 0.0, 1.0)[:, None] for sign in (-1.0, 1.0))
    some = (high > low)[:, 0]
    first, last = (start[some] + (share * over)[some] for share in (low, high))
    pushed = (high - low)[some, 0] * np.sqrt(a[some]) * beads.section_mm2[mine][some]
    n = len(first) + 1
    return MotionBatch(
        np.concatenate([first, last[-1:]]),
        np.concatenate([last, last[-1:] + np.array([0.0, 0.0, 20.0])]),
        np.append(pushed / FILAMENT_MM2, 0.0), np.full(n, 50.0), np.arange(n) * 1.0,
    )  # fmt: skip


PAGE_HEADER = (
    "infill", "cases", "filled, mean", "least", "of what the head reaches", "least", "again, mean",
    "added, most",
)  # fmt: skip


def page_rows(rows: list[dict[str, Any]]) -> list[tuple[object, ...]]:
    """By pattern; the parts that were held back; and what was found late."""
    at_once = [row for row in rows if not row["late"]]
    groups = {
        way: [row for row in at_once if row["way"] == way and row["part"] not in HELD_BACK]
        for way in WAYS
    }
    groups["held back"] = [row for row in at_once if row["part"] in HELD_BACK]
    groups["found late"] = [row for row in rows if row["late"]]
    told: list[tuple[object, ...]] = []
    for name, group in groups.items():
        if not group:
            continue
        filled, again = ([row[key] for row in group] for key in ("filled_ratio", "again_ratio"))
        reached = [row[REACHED[1]] for row in group if REACHED[1] in row]
        figures = [statistics.fmean(filled), min(filled)]
        figures += [statistics.fmean(reached), min(reached)] if reached else [math.nan, math.nan]
        figures += [statistics.fmean(again), max(row["added_ratio"] for row in group)]
        told.append((name, len(group), *(f"{v:.3f}".replace("nan", "–") for v in figures)))
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", default=["block"], choices=["block", *PARTS])
    parser.add_argument("--ways", nargs="+", default=WAYS)
    parser.add_argument("--cuts", nargs="+", default=list(CUTS), choices=list(CUTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--late", action="store_true", help="one look, after the last layer of it")
    parser.add_argument("--results", type=Path, default=Path("out/infill.jsonl"))
    measured_page.add_page_option(parser)
    args = parser.parse_args()
    args.results.parent.mkdir(parents=True, exist_ok=True)
    for name in args.parts:
        for seed in args.seeds:
            for way in args.ways:
                for cut in args.cuts:
                    row = run(name, way, cut, late=args.late, seed=seed)
                    if row is None:
                        print(f"{name}, {way}, {cut}: the job lays nothing there", flush=True)
                        continue
                    print(json.dumps(row), flush=True)
                    with args.results.open("a") as file:
                        file.write(json.dumps(row) + "\n")
    keyed = [json.loads(line) for line in args.results.read_text().splitlines()]
    latest = {tuple(r[k] for k in ("part", "way", "cut", "late", "seed")): r for r in keyed}
    told = page_rows(list(latest.values()))
    print(measured_page.table(PAGE_HEADER, told))
    if args.page:
        measured_page.write_rows("bench_infill", PAGE_HEADER, told)


if __name__ == "__main__":
    main()
