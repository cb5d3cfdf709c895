"""Offline repairs of real parts under the outside judge: parts × cuts × seeds, a line of JSON each.

    AMREPAIR_DATA=… python benchmarks/bench_judge.py --next 20      # twenty cases not yet run
    python benchmarks/bench_judge.py --case prusa-x-carriage-back notch 3
    python benchmarks/bench_judge.py --table                         # what there is so far
    python benchmarks/bench_judge.py --deficit-alone --next 20 --table   # nothing is planned

From a part on the bed a piece of 200 to 5,000 mm³ is cut away where the seed says: a notch in a
rim, a corner, a pit, a worn edge, a gap in a thin wall; from above, so that whatever stood over it
is gone with it, but for the undercut. The scan is a bare cloud of what is left (0.2 mm, 0.04 mm
noise, no normals, no sensors) with its pose known; the template is fitted to the whole part.
`tests/judge`, which shares no code with the packages, lays the beads of the final text.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import manifold3d
import numpy as np
import trimesh
from scipy import ndimage

from amrepair.errors import AmrepairError
from amrepair.frames import Transform
from amrepair.repair import Site, plan_repair
from amrepair.scans import Scan
from amrepair.template import load_mesh, load_or_fit
from gcode.errors import GcodeError
from gcode.profiles import load_setup
from gcode.slicing.layers import LayerGrid
from gcode.surfaces import HeightField

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.judge import judge

OURS = Path(__file__).parents[1] / "examples" / "parts"
PARTS = (
    "prusa-x-carriage-back", "prusa-y-motor-holder", "prusa-z-axis-top", "prusa-extruder-idler",
    "prusa-y-belt-idler", "prusa-lcd-supports", "prusa-y-rod-holder", "prusa-rpi-zero-frame",
    "prusa-fan-shroud", "prusa-print-fan-support", "prusa-endstop-block", "frame-guide",
)  # fmt: skip
KINDS = ("notch", "corner", "pit", "worn", "gap", "undercut")
LEAST_MM3, MOST_MM3 = 200.0, 5000.0
NOISE_MM, SPACING_MM = 0.04, 0.2
MIDDLE_MM = (125.0, 105.0)
CELL_MM = 0.5
TRIES = 200
HEAD_MM, HIGHER_MM = 15.0, 3.0
SEEN_MM2 = 1.0  # of a cut's opening: no scanner looks into a closed hollow
FULL_MM3 = 20.0  # of what the judge's head reaches: less tells nothing of how much is filled
Solid = manifold3d.Manifold
Case = tuple[str, str, int]


@dataclass(frozen=True)
class Cut:
    """A part on the bed, what is left of it, and what was cut away."""

    whole: Any
    rest: Any
    piece: Any
    mesh: trimesh.Trimesh
    low_mm: np.ndarray  # of the mesh: its corner is put onto the bed by it


def mesh_of(solid: Any) -> trimesh.Trimesh:
    """A solid's surface."""
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(
        np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts).astype(int), process=False
    )


def part_file(name: str) -> Path:
    """Where a part lies."""
    found = [OURS / f"{name}.stl"]
    if data := os.environ.get("AMREPAIR_DATA"):
        found.append(Path(data) / "parts" / f"{name}.stl")
    for path in found:
        if path.is_file():
            return path
    raise SystemExit(f"{name} is none of our own parts; say where others are by AMREPAIR_DATA")


def placed(name: str) -> tuple[trimesh.Trimesh, np.ndarray]:
    """A part's mesh, and what puts its middle over the middle of the bed."""
    mesh = load_mesh(part_file(name))
    low, high = mesh.bounds
    return mesh, np.array([*(np.array(MIDDLE_MM) - 0.5 * (low + high)[:2]), -low[2]])


def solid_of(mesh: trimesh.Trimesh) -> Any:
    """A mesh as a solid."""
    vertices = np.array(mesh.vertices, np.float64, order="C")
    faces = np.array(mesh.faces, np.uint64, order="C")
    solid = Solid(manifold3d.Mesh64(vertices, faces))
    if solid.status() != manifold3d.Error.NoError:
        data = manifold3d.Mesh64(vertices, faces)
        data.merge()
        solid = Solid(data)
    return solid  # hollows are shells of their own, and stay


def tops_of(solid: Any) -> tuple[np.ndarray, np.ndarray]:
    """(ny, nx) tops of a solid by column, and the corner of the grid."""
    field = HeightField.from_manifold(solid, CELL_MM, margin_mm=2.0)
    return field.z_mm, field.origin_mm


def tools(kind: str, solid: Any, rng: np.random.Generator) -> Iterator[Any]:
    """Tools of a kind at places drawn from where the part offers it."""
    z, corner = tops_of(solid)
    # not where the head has no room: what stands around the place is hardly higher
    around = int(2 * HEAD_MM / CELL_MM)
    high = (z > 2.0) & (z > ndimage.maximum_filter(z, around) - HIGHER_MM)
    lowest = ndimage.minimum_filter(z, 5)
    rim = high & (z - lowest > 1.5)
    inner_mm = ndimage.distance_transform_edt(~(ndimage.maximum_filter(z, 3) - z > 1.0) & ~rim)
    inner_mm = inner_mm * CELL_MM
    wall_mm = ndimage.distance_transform_edt(high & (z - ndimage.minimum_filter(z, 3) < 1.5))
    wall = rim & (ndimage.maximum_filter(wall_mm, 5) * CELL_MM <= 1.5)
    for _ in range(TRIES):
        where = {"pit": high & (inner_mm > 1.5), "gap": wall}.get(kind, rim)
        if not where.any():
            return
        choice = rng.choice(np.argwhere(where))
        if kind == "corner":  # the rim's farthest in some direction
            turn = rng.uniform(0, 2 * np.pi)
            places = np.argwhere(rim)
            choice = places[int(np.argmax(places @ (np.cos(turn), np.sin(turn))))]
        iy, ix = (int(v) for v in choice)
        x, y = corner + (np.array([ix, iy]) + 0.5) * CELL_MM
        top = float(z[iy, ix])
        # outwards: down the blurred heights
        around = z[max(iy - 6, 0) : iy + 7, max(ix - 6, 0) : ix + 7]
        gy, gx = np.gradient(ndimage.gaussian_filter(around, 2.0))
        way = float(np.degrees(np.arctan2(-gy.mean(), -gx.mean())))
        long, wide, deep = rng.uniform(6, 16), rng.uniform(4, 10), rng.uniform(1.2, 4.5)
        if kind == "pit":
            size = rng.uniform(5, 14, 2)
            tool = (
                Solid.cube((*size, 40.0), True)
                if rng.random() < 0.5
                else Solid.cylinder(40.0, size[0] / 2, size[0] / 2, 48, True)
            ).translate((0.0, 0.0, 20.0 - deep))
            way = rng.uniform(0, 90)
        elif kind == "worn":
            slope = rng.uniform(12, 38)
            tool = Solid.cube((30.0, rng.uniform(8, 30), 20.0), True).translate((0.0, 0.0, 10.0))
            tool = tool.rotate((0.0, slope, 0.0)).translate((0.0, 0.0, -deep))
        elif kind == "gap":
            deep = rng.uniform(2, 8)
            tool = Solid.cube((8.0, rng.uniform(5, 30), 40.0), True)
            tool = tool.translate((0.0, 0.0, 20.0 - deep))
        elif kind == "undercut":
            tall = rng.uniform(2, 6)
            tool = Solid.cube((2 * wide, long, tall), True).translate((0.0, 0.0, -deep - tall / 2))
        else:
            tool = Solid.cube((2 * wide, long, 40.0), True).translate((0.0, 0.0, 20.0 - deep))
            tool = tool.rotate((0.0, 0.0, 45.0 if kind == "corner" else 0.0))
        tool = tool.rotate((0.0, 0.0, way)).translate((float(x), float(y), top))
        if kind != "undercut":
            tool = Solid.batch_hull([tool, tool.translate((0.0, 0.0, 60.0))])
        yield tool


def make_cut(name: str, kind: str, seed: int) -> Cut | None:
    """A case; None where the part offers no such cut."""
    mesh, shift = placed(name)
    whole = solid_of(mesh).translate(tuple(shift))
    bodies = len(whole.decompose())
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    for tool in tools(kind, whole, rng):
        piece = whole ^ tool
        if not LEAST_MM3 <= piece.volume() <= min(MOST_MM3, 0.5 * whole.volume()):
            continue
        rest = whole - tool
        opening_mm2 = 0.5 * (whole.surface_area() + piece.surface_area() - rest.surface_area())
        if opening_mm2 < SEEN_MM2:
            continue
        solid = sum(1 for body in rest.decompose() if body.volume() > 0.01)
        if solid <= bodies:  # nothing hangs in the air
            return Cut(whole, rest, piece, mesh, shift)
    return None


def scan_of(solid: Any, seed: int, *, on_bed: bool = False) -> Scan:
    """A bare cloud of a solid; without the foot that it stands on where it lay `on_bed`."""
    mesh = mesh_of(solid)
    points, faces = trimesh.sample.sample_surface(mesh, int(mesh.area / SPACING_MM**2), seed=seed)
    noise = np.random.default_rng(seed).normal(scale=NOISE_MM, size=points.shape)
    foot = (np.asarray(points)[:, 2] < 0.02) & (np.asarray(mesh.face_normals)[faces][:, 2] < -0.9)
    return Scan((np.asarray(points) + noise)[~(foot & on_bed)], NOISE_MM, "build")


def run(case: Case, setup: Any, *, on_bed: bool, deficit_alone: bool) -> dict[str, Any]:
    """A case's figures; the deficit's alone takes a tenth of the time."""
    name, kind, seed = case
    row: dict[str, Any] = {"part": name, "kind": kind, "seed": seed}
    cut = make_cut(name, kind, seed)
    if cut is None:
        return row | {"skipped": "the part offers no such cut"}
    row["truth_mm3"] = cut.piece.volume()
    template = load_or_fit(cut.mesh)
    at = Transform.from_rotation_translation(
        "build", "template", rotation=np.eye(3), translation_mm=cut.low_mm
    )
    site = Site(template, setup, LayerGrid.from_setup(setup), build_from_template=at)
    start_s = time.process_time()
    try:
        plan = plan_repair(
            scan_of(cut.rest, seed, on_bed=on_bed), site, title=kind, guess=at.inverse(),
            wanted=lambda _: not deficit_alone,
        )  # fmt: skip
    except (AmrepairError, GcodeError) as error:
        return row | {"error": f"{type(error).__name__}: {error}"}
    row |= {"seconds": time.process_time() - start_s, "deficit_mm3": plan.deficit.missing_mm3}
    if deficit_alone:
        return row
    text = plan.checked.program.text if plan.checked else ""
    box = np.asarray(cut.piece.bounding_box()).reshape(2, 3)
    verdict = judge(text, mesh_of(cut.rest), mesh_of(cut.whole), box)
    regions = plan.patch.regions if plan.patch else ()
    declared_mm3 = sum(r.volume_mm3 * r.reachable_ratio for r in regions)
    return row | {
        "reached": verdict.reachable_ratio,
        "reached_mm3": verdict.reachable_mm3,
        "open": verdict.open_ratio,
        "filled": verdict.filled_ratio,
        "filled_open": verdict.filled_open_ratio,
        "outside": verdict.outside_ratio,
        "in_air_mm3": verdict.in_air_mm3,
        "widest_mm": verdict.widest_mm,
        "contact_mm": verdict.deepest_contact_mm if text else None,
        "contact_line": verdict.contact_line,
        "declared": declared_mm3 / max(plan.deficit.missing_mm3, 1e-9),
    }


def declared_off(row: dict[str, Any]) -> float:
    """How far the declared reach is off what is held at least, and the head alone allows at most.

    Rows from before the judge told the latter have the former alone.
    """
    held, most = row["reached"], max(row["reached"], row.get("open", 0.0))
    return float(max(held - row["declared"], row["declared"] - most, 0.0))


def failings(row: dict[str, Any]) -> list[str]:
    """Which of the goals a case misses."""
    if "error" in row:
        return ["error"]
    deficit_off = abs(row["deficit_mm3"] / row["truth_mm3"] - 1.0) > 0.05
    if "filled" not in row:
        return ["deficit"] if deficit_off else []
    told = row["reached_mm3"] >= FULL_MM3
    rules = {
        "filled": told and row["filled"] < 0.95,
        "outside": row["outside"] > 0.05,
        "air": row["in_air_mm3"] > 0.1,
        "wide": row["widest_mm"] > 0.8 + 1e-9,
        "contact": (row["contact_mm"] or 0.0) > 0.2,
        "declared": declared_off(row) > 0.05,
        "deficit": deficit_off,
    }
    return [name for name, missed in rules.items() if missed]


def table(rows: Sequence[dict[str, Any]]) -> str:
    """By kind, in Markdown; then what fails, case by case."""
    rows = [row for row in rows if "skipped" not in row]
    lines = [
        "| kind | cuts | filled of what is reached: least, median, ≥ 0.95 | outside, most |"
        " contact, deepest | declared off, most | deficit | any goal missed |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind in [*KINDS, "all"]:
        mine = [row for row in rows if kind in (row["kind"], "all")]
        judged = [row for row in mine if "error" not in row]
        if not judged:
            continue
        ratio = [row["deficit_mm3"] / row["truth_mm3"] for row in judged]
        lines.append(
            f"| {kind} | {len(mine)} | {_laid([row for row in judged if 'filled' in row])} |"
            f" {min(ratio):.3f} to {max(ratio):.3f} |"
            f" {sum(bool(failings(row)) for row in mine)} |"
        )
    for row in rows:
        if missed := failings(row):
            lines.append(f"{row['part']} {row['kind']} {row['seed']}: {said(row)} {missed}")
    return "\n".join(lines)


def _laid(rows: Sequence[dict[str, Any]]) -> str:
    """Cells of what was laid; empty ones of cuts whose deficit alone was made."""
    if not rows:
        return " | | | "
    filled = [row["filled"] for row in rows if row["reached_mm3"] >= FULL_MM3] or [0.0]
    good = sum(v >= 0.95 for v in filled)
    return (
        f"{min(filled):.3f}, {statistics.median(filled):.3f}, {good} of {len(filled)} |"
        f" {max(row['outside'] for row in rows):.1%} |"
        f" {max(row['contact_mm'] or 0.0 for row in rows):.2f} |"
        f" {max(declared_off(row) for row in rows):.3f}"
    )


PAGE_HEADER = (
    "reached of the piece", "cuts", "0.95 filled", "filled, median", "mean", "least",
    "outside, most", "over 5%", "contact, mm", "declared off",
)  # fmt: skip


def page_rows(rows: Sequence[dict[str, Any]]) -> list[tuple[object, ...]]:
    """Cuts of which the judge's head reaches `FULL_MM3`, by the share of the piece that it is."""
    told: list[tuple[object, ...]] = []
    for least in (0.8, 0.5, 0.3):
        mine = [
            row for row in rows
            if "filled" in row and row["reached_mm3"] >= FULL_MM3 and row["reached"] >= least
        ]  # fmt: skip
        if not mine:
            continue
        filled = [row["filled"] for row in mine]
        told.append(
            (
                f"{least:g} and more",
                len(mine),
                sum(share >= 0.95 for share in filled),
                f"{statistics.median(filled):.3f}",
                f"{statistics.fmean(filled):.3f}",
                f"{min(filled):.3f}",
                f"{max(row['outside'] for row in mine):.1%}",
                sum(row["outside"] > 0.05 for row in mine),
                f"{max(row['contact_mm'] or 0.0 for row in mine):.2f}",
                sum(declared_off(row) > 0.05 for row in mine),
            )
        )
    return told


def said(row: dict[str, Any]) -> str:
    """A case in a line."""
    if "deficit_mm3" not in row:
        return str(row.get("error") or row.get("skipped"))
    if "filled" not in row:
        return f"{row['truth_mm3']:.0f} mm3 deficit {row['deficit_mm3'] / row['truth_mm3']:.3f}"
    return (
        f"{row['truth_mm3']:.0f} mm3 reached {row['reached']:.2f} filled {row['filled']:.3f}"
        f" open {row.get('open', 0.0):.2f} filled {row.get('filled_open', 0.0):.3f}"
        f" outside {row['outside']:.3f} contact {row['contact_mm'] or 0.0:.2f}"
        f" declared {row['declared']:.2f} deficit {row['deficit_mm3'] / row['truth_mm3']:.3f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=Path, default=Path("out/bench_judge.jsonl"))
    parser.add_argument("--parts", nargs="+", default=PARTS)
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--on-bed", action="store_true", help="the scan lacks the part's foot")
    parser.add_argument("--deficit-alone", action="store_true", help="nothing is planned")
    parser.add_argument("--next", type=int, default=0, help="run so many cases not yet run")
    parser.add_argument("--within-s", type=float, default=np.inf, help="begin none after this")
    parser.add_argument("--case", nargs=3, metavar=("PART", "KIND", "SEED"))
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--page", action="store_true", help="rows of docs/measurements.md")
    args = parser.parse_args()
    lines = args.results.read_text().splitlines() if args.results.is_file() else []
    rows = [json.loads(line) for line in lines]
    done = {(row["part"], row["kind"], row["seed"]) for row in rows}
    setup = load_setup()
    if args.case:
        todo = [(args.case[0], args.case[1], int(args.case[2]))]
    else:
        every = [(p, k, s) for s in args.seeds for p in args.parts for k in args.kinds]
        todo = [case for case in every if case not in done][: args.next]
    start_s = time.monotonic()
    for case in todo:
        if time.monotonic() - start_s > args.within_s:
            break
        row = run(case, setup, on_bed=args.on_bed, deficit_alone=args.deficit_alone)
        print(*case, said(row), "" if "skipped" in row else failings(row), flush=True)
        if not args.case:
            args.results.parent.mkdir(parents=True, exist_ok=True)
            with args.results.open("a") as file:
                file.write(json.dumps(row) + "\n")
            rows.append(row)
    if args.table:
        print(table(rows))
    if args.page:
        from measured_page import write_rows  # beside this script

        write_rows("bench_judge", PAGE_HEADER, page_rows(rows))


if __name__ == "__main__":
    main()
