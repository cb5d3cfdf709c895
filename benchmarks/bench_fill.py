"""How much of what the head can reach a patch fills: cuts × printers, under the outside judge.

    AMREPAIR_DATA=… python benchmarks/bench_fill.py                  # all cases, a table
    python benchmarks/bench_fill.py --cases notch pit --printers voron_2_4 --cell-mm 0.1
    python benchmarks/bench_fill.py --cases slot --printers prusa_mk3s --off-grid

The deficit is the true one (a boolean of two solids) and so is the field of what stands there: what
is lost here is lost in planning, not in a scan. `tests/judge`, which shares no code with the
packages, says what its own head reaches and what the text's beads fill.

Walls of the blocks lie along the columns of that field, and end with them. `--off-grid` turns and
moves each case to five places where they do not: turned, narrow slots are filled less, and the cone
keeps farther off. The judge knows tip and walls by columns of its own, and contact to half of one
each: what it tells as 0.06 mm on the grid, and 0.10 beside it, is 0.075 in both. So contact of the
cone is told also where it truly is. What the judge's head reaches is more than its own beads fill:
it may press 0.1 mm into what stands there, where the planner presses `PRESS_MM`, and counts a voxel
below a whole layer. So the most is told that any planner could lay, which begins beads at each
height at which the head, pressed no deeper than ours, gets in. Depth is measured upright: beside a
wall that its hexagon overlaps by 0.02 mm it is all the wall.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import manifold3d
import numpy as np
from scipy import ndimage

from amrepair.loop.sites import lines_of_job
from gcode.check import find_refusals
from gcode.profiles import PrintSetup, load_setup
from gcode.reader import job_for
from gcode.slicing.job import plan_part
from gcode.slicing.job_lines import JobLines
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch import slice_patch
from gcode.slicing.reach import PRESS_MM
from gcode.surfaces import HeightField
from gcode.writer import write

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.bench_judge import make_cut, mesh_of
from tests.judge import HEADS, cone_contact_mm, judge
from tests.judge.head import HeadSlice, Reaching, least_tip, reachable
from tests.judge.judge import FINE_MM, HANGING_MM, MOST_GAP_MM, _Scene

Solid = manifold3d.Manifold
CELL_MM = 0.1  # as a repair's field of what stands there has it
BESIDE_MM = 8.0  # as in a repair
SIZE_MM = (44.0, 34.0, 12.0)
AT_MM = (95.0, 85.0, 0.0)
PRINTERS = ("prusa_mk3s", "ender_3", "voron_2_4", "creality_k1")
# moved in X and Y, mm, and turned about the block's middle, degrees
OFF_GRID = (
    (0.03, 0.02, 0.0), (0.05, 0.05, 0.0), (0.02, 0.06, 8.0), (0.04, 0.01, 17.0), (0.01, 0.07, 33.0),
)  # fmt: skip
# of real parts, by the seeds of bench_judge
REAL = (("prusa-x-carriage-back", "notch", 3), ("frame-guide", "corner", 1))


def _box(size: tuple[float, float, float], at: tuple[float, float, float]) -> Any:
    return Solid.cube(size).translate(at)


def _tilted(deg: float, deep_mm: float) -> Any:
    tool = Solid.cube((80.0, 80.0, 30.0), True).translate((0.0, 0.0, 15.0))
    return tool.rotate((0.0, deg, 0.0)).translate((40.0, 17.0, 12.0 - deep_mm))


TOOLS = {
    "notch": _box((14.0, 12.0, 20.0), (15.0, -1.0, 8.0)),
    "notch, turned": _box((14.0, 12.0, 20.0), (0.0, 0.0, 0.0))
    .rotate((0.0, 0.0, 20.0)).translate((17.0, -4.0, 8.6)),
    "pit": _box((13.0, 11.0, 20.0), (15.0, 11.0, 9.0)),
    "round pit": Solid.cylinder(20.0, 6.5, 6.5, 96).translate((22.0, 17.0, 8.53)),
    "corner": _box((16.0, 14.0, 20.0), (34.0, -4.0, 8.0)),
    "corner, aslant": Solid.cube((20.0, 20.0, 40.0), True)
    .rotate((0.0, 0.0, 45.0)).translate((44.0, 0.0, 28.5)),
    "worn top": _tilted(12.0, 2.0),
    "worn top, steep": _tilted(30.0, 2.5),
    "slot": _box((2.5, 16.0, 20.0), (20.0, 9.0, 9.0)),
    "deep notch": _box((20.0, 14.0, 20.0), (12.0, -1.0, 7.0)),
    "slot, wider": _box((4.0, 16.0, 20.0), (20.0, 9.0, 9.5)),
    "shallow slot": _box((1.6, 16.0, 20.0), (20.0, 9.0, 11.0)),
}  # fmt: skip
# parts with nothing under the middle of what is cut away, and the cut
BORE = Solid.cylinder(34.0, 5.0, 5.0, 96).rotate((-90.0, 0.0, 0.0)).translate((22.0, 0.0, 6.5))
OVER_AIR = {
    "roof of a bore": (
        _box(SIZE_MM, (0.0, 0.0, 0.0)) - BORE, _box((14.0, 34.0, 9.0), (15.0, 0.0, 10.2)),
    ),
    "lintel": (
        _box((44.0, 5.0, 14.0), (0.0, 14.0, 0.0)) - _box((14.0, 5.0, 7.0), (15.0, 14.0, 3.0)),
        _box((30.0, 5.0, 9.0), (7.0, 14.0, 10.0)),
    ),
    "plate on two legs": (
        _box((26.0, 16.0, 12.0), (9.0, 9.0, 0.0)) - _box((18.0, 16.0, 10.0), (13.0, 9.0, 0.0)),
        _box((26.0, 16.0, 9.0), (9.0, 9.0, 10.0)),
    ),
    "hole in a lid": (
        _box((30.0, 30.0, 10.0), (7.0, 2.0, 0.0)) - _box((26.0, 26.0, 7.6), (9.0, 4.0, 1.0)),
        Solid.cylinder(9.0, 5.0, 5.0, 96).translate((22.0, 17.0, 5.0)),
    ),
    "lid": (
        _box((20.0, 20.0, 10.0), (12.0, 7.0, 0.0)) - _box((12.0, 12.0, 7.6), (16.0, 11.0, 1.0)),
        _box((18.0, 18.0, 9.0), (13.0, 8.0, 8.6)),
    ),
    "span of 34 mm": (
        _box((42.0, 16.0, 12.0), (1.0, 9.0, 0.0)) - _box((34.0, 16.0, 10.0), (5.0, 9.0, 0.0)),
        _box((42.0, 16.0, 9.0), (1.0, 9.0, 10.0)),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """What was wanted, what is left of it, and what is gone."""

    whole: Any
    rest: Any
    piece: Any

    def placed(self, x_mm: float, y_mm: float, turned_deg: float) -> Case:
        """The same elsewhere on the bed, turned about the block's middle."""
        x0_mm, y0_mm = (AT_MM[k] + 0.5 * SIZE_MM[k] for k in (0, 1))
        to = (x0_mm + x_mm, y0_mm + y_mm, 0.0)
        return Case(
            *(
                solid.translate((-x0_mm, -y0_mm, 0.0)).rotate((0.0, 0.0, turned_deg)).translate(to)
                for solid in (self.whole, self.rest, self.piece)
            )
        )


def case_of(name: str) -> Case | None:
    """A block with a cut, or a cut of a real part, named part:kind:seed."""
    if ":" in name:
        part, kind, seed = name.split(":")
        cut = make_cut(part, kind, int(seed))
        return None if cut is None else Case(cut.whole, cut.rest, cut.piece)
    solid, tool = OVER_AIR[name] if name in OVER_AIR else (Solid.cube(SIZE_MM), TOOLS[name])
    block, tool = solid.translate(AT_MM), tool.translate(AT_MM)
    return Case(block, block - tool, block ^ tool)


def most_laid(
    rest: Any, whole: Any, box_mm: np.ndarray, head: tuple[HeadSlice, ...], nozzle_mm: float
) -> float:
    """Of what the head alone allows, the share that the judge's beads could fill at all."""
    scene = _Scene.of(rest, whole, box_mm)
    missing, low_z_mm = scene.aim & ~scene.before, float(scene.box.low_mm[2])
    least_mm = least_tip(scene.tops_mm, scene.window, FINE_MM[0], head)
    by = Reaching(
        least_mm, FINE_MM[0], low_z_mm, FINE_MM[2], bead_mm=0.45, layer_mm=HANGING_MM,
        allowed_mm=0.1,
    )  # fmt: skip
    reach = reachable(missing, scene.before, by, tip_layers=1.0, held=False)
    wide = round(nozzle_mm / FINE_MM[0])
    i, j = np.mgrid[-wide : wide + 1, -wide : wide + 1]
    lowest_mm = ndimage.minimum_filter(least_mm - PRESS_MM, footprint=np.hypot(i, j) <= wide)
    tip = np.ceil((lowest_mm - low_z_mm) / FINE_MM[2] - 1e-6)
    height = missing.shape[2]
    top = np.where(scene.before.any(2), height - scene.before[:, :, ::-1].argmax(2), 0)
    hangs = (tip - top) * FINE_MM[2] > MOST_GAP_MM
    from_voxel = np.where(hangs, tip - round(HANGING_MM / FINE_MM[2]), top)
    return float((reach & (np.arange(height) >= from_voxel[:, :, None])).sum() / reach.sum())


def lines_of(part: Any, setup: PrintSetup) -> JobLines:
    """What our own slicer lays for a part."""
    program = write(plan_part(part, setup).toolpath, setup, title="bench")
    job = job_for(program, setup.printer)
    return lines_of_job(job, job.beads.layer >= 0, setup)


def run(
    name: str,
    setup: PrintSetup,
    cell_mm: float,
    *,
    along_job: bool,
    place: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> dict[str, Any] | None:
    """A case's figures; `along_job`, the patch may follow the lines that the job laid there."""
    case = case_of(name)
    if case is None:
        return None
    if any(place):
        case = case.placed(*place)
        name += " at {:g}, {:g}, {:g} deg".format(*place)
    as_built = HeightField.from_manifold(case.rest, cell_mm, margin_mm=BESIDE_MM)
    lines = lines_of(case.whole, setup) if along_job else None
    start_s = time.process_time()
    plan = slice_patch(
        case.piece, setup, as_built=as_built, grid=LayerGrid.from_setup(setup), standalone=True,
        lines=lines,
    )  # fmt: skip
    spent_s = time.process_time() - start_s
    program = write(plan.toolpath, setup, title="bench", resume=None, restore=False)
    refused = find_refusals(
        program, setup, as_built=as_built, patch=lines.bridges if lines else True
    )
    rest, whole = mesh_of(case.rest), mesh_of(case.whole)
    box_mm = np.asarray(case.piece.bounding_box()).reshape(2, 3)
    head = HEADS[setup.printer.id]
    verdict = judge(
        program.text,
        rest,
        whole,
        box_mm,
        head=head,
        nozzle_mm=setup.printer.nozzle_diameter_mm,
    )
    causes: dict[str, float] = {}
    for left in (*plan.unreachable, *plan.unprintable):
        causes[left.reason] = causes.get(left.reason, 0.0) + left.volume_mm3
    return {
        "case": name,
        "printer": setup.printer.id,
        "missing_mm3": case.piece.volume(),
        "reached": verdict.reachable_ratio,
        "open": verdict.open_ratio,
        "filled": verdict.filled_ratio,
        "filled_high": verdict.filled_high_ratio,
        "filled_open": verdict.filled_open_ratio,
        "most_open": most_laid(rest, whole, box_mm, head, setup.printer.nozzle_diameter_mm),
        "filled_mm3": verdict.filled_mm3,
        "outside": verdict.outside_ratio,
        "in_air_mm3": verdict.in_air_mm3,
        "widest_mm": verdict.widest_mm,
        "contact_mm": verdict.deepest_contact_mm if plan.beads_mm3 else 0.0,
        "cone_mm": cone_contact_mm(program.text, rest, box_mm, head) if plan.beads_mm3 else 0.0,
        "declared": plan.reachable_mm3 / case.piece.volume(),
        "beads_mm3": plan.beads_mm3,
        "refused": len(refused),
        "seconds": spent_s,
        "left_mm3": causes,
    }


def line_of(row: dict[str, Any]) -> str:
    """A case as a row of the table."""
    left = "; ".join(f"{v:.0f}: {k}" for k, v in row["left_mm3"].items() if v >= 0.5)
    return (
        f"| {row['case']} | {row['printer']} | {row['missing_mm3']:.0f} | {row['reached']:.2f},"
        f" {row['open']:.2f} | {row['declared']:.2f} | {row['filled']:.3f},"
        f" {row['filled_high']:.3f}, {row['filled_open']:.3f} of {row['most_open']:.3f} |"
        f" {row['outside']:.3f},"
        f" {row['in_air_mm3']:.1f} | {row['contact_mm']:.2f}, {row['cone_mm']:.3f} |"
        f" {row['refused']} | {row['seconds']:.2f} | {left} |"
    )


PAGE_HEADER = ("cut", "head reaches", "declared", "filled of that", "outside, %")


def page_row(row: dict[str, Any]) -> tuple[object, ...]:
    """Shares of the piece; what is filled, and what lies outside, of what the head reaches."""
    shares = (f"{row['open']:.2f}", f"{row['declared']:.2f}", f"{row['filled_open']:.3f}")
    return (row["case"], *shares, f"{100 * row['outside']:.1f}")


HEADER = (
    "| cut | printer | missing, mm³ | judge's head reaches: where something holds, at all |"
    " declared | filled of what is held, half a layer up, a whole one; of all, of which"
    " beads could fill | outside, and in"
    " the air, mm³ | contact, mm, by columns and of the cone where it is | refused | processor, s |"
    " left out, mm³, and why |\n|---|---|---|---|---|---|---|---|---|---|---|"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    every = [*TOOLS, *OVER_AIR, *(":".join(map(str, real)) for real in REAL)]
    parser.add_argument("--cases", nargs="+", default=every)
    parser.add_argument("--printers", nargs="+", default=PRINTERS, choices=PRINTERS)
    parser.add_argument("--cell-mm", type=float, default=CELL_MM)
    parser.add_argument("--along-job", action="store_true", help="on lines of the part's own job")
    parser.add_argument("--off-grid", action="store_true", help="at five other places, and means")
    parser.add_argument("--results", type=Path, help="a line of JSON each, besides the table")
    parser.add_argument("--page", action="store_true", help="of the first printer's blocks")
    args = parser.parse_args()
    print(HEADER)
    told: list[tuple[object, ...]] = []
    for name in args.cases:
        for printer in args.printers:
            setup = load_setup(printer=printer)
            rows = []
            for place in OFF_GRID if args.off_grid else ((0.0, 0.0, 0.0),):
                row = run(name, setup, args.cell_mm, along_job=args.along_job, place=place)
                rows += [row] if row is not None else []
            for row in rows:
                print(line_of(row), flush=True)
                if printer == args.printers[0] and name in TOOLS and not args.off_grid:
                    told.append(page_row(row))
                if args.results:
                    with args.results.open("a") as file:
                        file.write(json.dumps(row) + "\n")
            if args.off_grid and rows:
                filled = [row["filled_open"] for row in rows]
                by_columns, truly = (max(row[k] for row in rows) for k in ("contact_mm", "cone_mm"))
                print(
                    f"{name}, {printer}: {np.mean(filled):.3f} filled,"
                    f" contact {by_columns:.2f}, of the cone {truly:.3f} mm"
                )
    if args.page and not args.off_grid:
        from measured_page import write_rows  # beside this script

        write_rows("bench_fill", PAGE_HEADER, told)


if __name__ == "__main__":
    main()
