"""Each defect type at a signal of twice the noise: what the loop takes it for.

    python benchmarks/bench_kinds.py [--part block|ring] [--seeds 20] [--only TYPE]

A block of 24 × 20 mm, or a round one with a bore, sliced solid by our own slicer and looked at
after layer 14 of 20. Every defect is an as-built surface made by formula (neither the world nor
the deposit model has a hand in it), sampled every 0.25 mm, with noise of half the defect's height
along the normal. Prints the confusion matrix as Markdown: rows what it was, columns the type that
most of the volume found was given; `none` where nothing was found.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import manifold3d as m3
import numpy as np
import trimesh

from amrepair.errors import AmrepairError, PartMovedError
from amrepair.frames import Transform
from amrepair.loop import Stop, plan_stops
from amrepair.loop.kinds import typed
from amrepair.loop.shapes import last_beads
from amrepair.loop.sites import sites
from amrepair.repair import Site, plan_repair
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from gcode.profiles import PrintSetup, load_setup
from gcode.reader import Job, read_job
from gcode.slicing.job import plan_part
from gcode.writer import write

LAYER, LAYER_MM, SPACING_MM = 14, 0.2, 0.25
SIZE = np.array([24.0, 20.0])
CORNER = np.array([100.0, 90.0])
# The ring, about the middle of the block.
MIDDLE, RADIUS_MM = CORNER + SIZE / 2, 14.0
BORE_OFF, BORE_MM = np.array([-10.5, 0.0]), 2.0
TOP_MM = (LAYER + 1) * LAYER_MM
Rise = Callable[[np.ndarray], np.ndarray]


@dataclass
class Built:
    """As built: how much higher the top is at XY (build frame), where walls and all lie."""

    signal_mm: float
    rise: Rise = lambda xy: np.zeros(len(xy))
    wall_shift: Callable[[np.ndarray], np.ndarray] = lambda z: np.zeros((len(z), 2))
    lift: Rise = lambda xy: np.zeros(len(xy))
    move: Transform | None = None


def _ellipse(rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    centre = CORNER + SIZE / 2 + rng.uniform(-4, 4, 2)
    half = np.array([rng.uniform(3, 5)] * 2) * [1.0, rng.uniform(0.75, 1.0)]
    angle = rng.uniform(0, np.pi)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return lambda xy: (((xy - centre) @ turn.T / half) ** 2).sum(axis=1)


def _lines(job: Job, line: int, rng: np.random.Generator) -> Rise:
    """Some neighbouring lines, skipped over a length, in two layers."""
    beads = job.beads
    pick = (beads.line < line) & (beads.layer == LAYER)
    step = (beads.end_mm - beads.start_mm)[pick, :2]
    long = np.linalg.norm(step, axis=1) > 10.0
    start, step = beads.start_mm[pick, :2][long], step[long]
    middle = start + 0.5 * step
    inner = (np.abs(middle - CORNER - SIZE / 2) < SIZE / 2 - 4).all(axis=1)
    one = int(rng.choice(np.flatnonzero(inner)))
    along = step[one] / np.linalg.norm(step[one])
    across = np.array([-along[1], along[0]])
    half_long, half_wide = rng.uniform(4, 5), 0.225 * rng.integers(3, 6)

    def rise(xy: np.ndarray) -> np.ndarray:
        local = xy - middle[one]
        inside = (np.abs(local @ along) < half_long) & (np.abs(local @ across) < half_wide)
        return -2 * LAYER_MM * inside

    return rise


def _clog(job: Job, line: int, rng: np.random.Generator) -> Rise:
    """Half the flow from some bead of the last layer but one on."""
    from scipy.spatial import cKDTree

    last = last_beads(job, line)
    begin = int(len(last) * rng.uniform(0.2, 0.75))
    tree = cKDTree(last[:, :2])
    return lambda xy: np.where(tree.query(xy)[1] >= begin, -0.2, 0.0)


def _blob(rng: np.random.Generator) -> Built:
    inside, height = _ellipse(rng), rng.uniform(0.6, 1.0)
    return Built(height, lambda xy: height * np.sqrt(np.maximum(1 - 2.0 * inside(xy), 0.0)))


def _string(rng: np.random.Generator) -> Built:
    a = CORNER + SIZE / 2 + rng.uniform(-3, 3, 2)
    angle = rng.uniform(0, np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    half, height = rng.uniform(5, 8), 0.5

    def rise(xy: np.ndarray) -> np.ndarray:
        local = xy - a
        inside = np.maximum(1 - (local @ across / 0.4) ** 2, 0.0)
        return height * np.sqrt(inside) * (np.abs(local @ along) < half)

    return Built(height, rise)


def _shift(rng: np.random.Generator) -> Built:
    angle, size = rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 0.8)
    by, at = size * np.array([np.cos(angle), np.sin(angle)]), rng.uniform(0.8, 2.2)
    return Built(size, wall_shift=lambda z: np.where((z > at)[:, None], by, 0.0))


def _warp(rng: np.random.Generator) -> Built:
    height = rng.uniform(0.4, 0.8)
    radius = np.hypot(*(SIZE / 2))

    def lift(xy: np.ndarray) -> np.ndarray:
        return height * (np.linalg.norm(xy - CORNER - SIZE / 2, axis=1) / radius) ** 2

    return Built(height, lift=lift)


def _detached(rng: np.random.Generator) -> Built:
    angle, turn = rng.uniform(0, 2 * np.pi), rng.uniform(-0.1, 0.1)
    centre = np.array([*(CORNER + SIZE / 2), 0.0])
    rotation = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]]
    )
    by = rng.uniform(1.5, 4.0) * np.array([np.cos(angle), np.sin(angle), 0.0])
    move = Transform.from_rotation_translation(
        "build", "build", rotation=rotation, translation_mm=by + centre - rotation @ centre
    )
    return Built(0.4, move=move)


def made(kind: str, job: Job, line: int, rng: np.random.Generator) -> Built:
    """A defect of a type, drawn."""
    if kind == "void":
        inside, deep = _ellipse(rng), LAYER_MM * rng.integers(1, 5)
        return Built(float(deep), lambda xy: -deep * (inside(xy) < 1.0))
    if kind == "missing_beads":
        return Built(2 * LAYER_MM, _lines(job, line, rng))
    if kind in ("under_extrusion", "over_extrusion"):
        size = rng.uniform(0.2, 0.3) * (1 if kind == "over_extrusion" else -1)
        return Built(abs(size), lambda xy: np.full(len(xy), size))
    if kind == "clog":
        return Built(LAYER_MM, _clog(job, line, rng))
    simple = {"blob": _blob, "string": _string, "layer_shift": _shift, "warp": _warp,
              "detached": _detached}  # fmt: skip
    return simple[kind](rng)


KINDS = ("void", "missing_beads", "under_extrusion", "over_extrusion", "blob", "string",
         "layer_shift", "warp", "detached", "clog")  # fmt: skip


@dataclass(frozen=True, slots=True)
class Part:
    """A part of one section: its solid in its own frame, what of the bed it covers, its walls.

    `wall` draws so many places on the walls, build frame, at heights up to the top, and normals.
    """

    solid: m3.Manifold
    covers: Callable[[np.ndarray], np.ndarray]
    wall: Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]


def _walls_of_block(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    low, high = CORNER, CORNER + SIZE
    parts, normals = [], []
    for axis in (0, 1):
        for side in (0, 1):
            count = int(SIZE[1 - axis] * TOP_MM / SPACING_MM**2)
            wall = np.zeros((count, 3))
            wall[:, axis] = (low, high)[side][axis]
            wall[:, 1 - axis] = rng.uniform(low[1 - axis], high[1 - axis], count)
            wall[:, 2] = rng.uniform(0.05, TOP_MM, count)
            parts.append(wall)
            normals.append(np.tile(np.eye(3)[axis] * (2 * side - 1), (count, 1)))
    return np.concatenate(parts), np.concatenate(normals)


def _walls_of_ring(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    parts, normals = [], []
    for radius, way, middle in ((RADIUS_MM, 1.0, MIDDLE), (BORE_MM, -1.0, MIDDLE + BORE_OFF)):
        count = int(2 * np.pi * radius * TOP_MM / SPACING_MM**2)
        angle = rng.uniform(0, 2 * np.pi, count)
        out = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
        wall = np.append(middle, 0.0) + radius * out
        wall[:, 2] = rng.uniform(0.05, TOP_MM, count)
        parts.append(wall)
        normals.append(way * out)
    return np.concatenate(parts), np.concatenate(normals)


def _in_block(xy: np.ndarray) -> np.ndarray:
    return np.asarray(((xy > CORNER) & (xy < CORNER + SIZE)).all(axis=1))


def _in_ring(xy: np.ndarray) -> np.ndarray:
    in_bore = np.linalg.norm(xy - MIDDLE - BORE_OFF, axis=1) < BORE_MM
    return np.asarray((np.linalg.norm(xy - MIDDLE, axis=1) < RADIUS_MM) & ~in_bore)


def part_called(name: str) -> Part:
    """The block, or the ring; the corner of its box is the origin of its own frame."""
    if name == "block":
        return Part(m3.Manifold.cube((*SIZE, 4.0)), _in_block, _walls_of_block)
    middle = MIDDLE - CORNER
    round_ = m3.Manifold.cylinder(4.0, RADIUS_MM, circular_segments=256).translate((*middle, 0.0))
    bore = m3.Manifold.cylinder(6.0, BORE_MM, circular_segments=96)
    off = (*(middle + BORE_OFF), -1.0)
    return Part(round_ - bore.translate(off), _in_ring, _walls_of_ring)


def scan_of(built: Built, sigma_mm: float, rng: np.random.Generator, part: Part) -> Scan:
    """Top, walls and some bed, as a scanner over it would have them."""
    box = np.reshape(part.solid.bounding_box(), (2, 3))[:, :2] + CORNER
    low, high = box
    grid = np.stack(
        np.meshgrid(*(np.arange(a, b, SPACING_MM) for a, b in zip(low, high, strict=True))), -1
    )
    xy = grid.reshape(-1, 2) + rng.uniform(0, SPACING_MM, (grid.size // 2, 2))
    xy = xy[part.covers(xy)]
    top_shift = built.wall_shift(np.array([TOP_MM]))[0]
    top = np.column_stack([xy + top_shift, TOP_MM + built.rise(xy) + built.lift(xy)])
    wall, across = part.wall(rng)
    lift = built.lift(wall[:, :2])
    wall[:, :2] += built.wall_shift(wall[:, 2])
    wall[:, 2] += lift
    points = np.concatenate([top, wall])
    normal = np.concatenate([np.tile([0.0, 0.0, 1.0], (len(top), 1)), across])
    if built.move is not None:
        points, normal = built.move.apply(points), built.move.rotate(normal)
    bed = rng.uniform(low - 6, high + 6, (4000, 2))
    ways = 0.5 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    beside = ~np.any([part.covers(bed + way) for way in ways], axis=0)
    points = np.concatenate([points, np.column_stack([bed[beside], np.zeros(beside.sum())])])
    normal = np.concatenate([normal, np.tile([0.0, 0.0, 1.0], (int(beside.sum()), 1))])
    noise = rng.normal(scale=sigma_mm, size=(len(points), 1))
    return Scan(points + noise * normal, sigma_mm, "scanner", normal)


def scene(part: Part, setup: PrintSetup) -> tuple[Job, Stop, Transform, Site]:
    """The part's job, the stop after the layer, where it stands and what is expected there."""
    placed = Transform.from_rotation_translation(
        "build", "template", rotation=np.eye(3), translation_mm=np.array([*CORNER, 0.0])
    )
    toolpath = plan_part(part.solid.translate((*CORNER, 0.0)), setup).toolpath
    program = write(toolpath, setup, title="kinds")
    job = read_job(program, dialect=program.dialect)
    mesh = part.solid.to_mesh64()
    template = MeshSdf.from_mesh(
        trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))
    )
    stop = plan_stops(job, [LAYER], final=False)[0]
    return job, stop, placed, sites(job, template, placed, setup, by_beads=False)(stop)


PAGE_HEADER = ("part", "kinds", "looks at each", "right", "least right of a kind")


def page_row(part: str, table: dict[str, Counter[str]], seeds: int) -> tuple[object, ...]:
    """What share of all looks, and of the kind with the fewest, was given its own kind."""
    shares = [found[kind] / seeds for kind, found in table.items()]
    return part, len(shares), seeds, f"{np.mean(shares):.0%}", f"{min(shares):.0%}"


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--part", choices=("block", "ring"), default="block")
    options.add_argument("--seeds", type=int, default=20)
    options.add_argument("--only", choices=KINDS)
    options.add_argument("--page", action="store_true", help="a row of docs/measurements.md")
    said = options.parse_args()
    setup, part = load_setup(), part_called(said.part)
    job, stop, placed, site = scene(part, setup)
    pose = Transform.identity("build", "scanner")
    table: dict[str, Counter[str]] = {}
    sure: dict[str, list[float]] = {}
    for kind in KINDS if said.only is None else (said.only,):
        table[kind], sure[kind] = Counter(), []
        for seed in range(said.seeds):
            rng = np.random.default_rng([seed, KINDS.index(kind)])
            built = made(kind, job, stop.line, rng)
            scan = scan_of(built, min(0.5 * built.signal_mm, 0.2), rng, part)
            try:
                plan = plan_repair(
                    scan, site, title="", guess=placed.inverse() @ pose, strict=False,
                    wanted=lambda region: False, rng=np.random.default_rng(seed),
                )  # fmt: skip
                plan = typed(plan, job, site, stop.line, pose)
            except PartMovedError:  # farther than a look's alignment goes, and said so
                table[kind]["detached"] += 1
                continue
            except AmrepairError as error:
                table[kind][f"refused: {type(error).__name__}"] += 1
                continue
            volume: Counter[str] = Counter()
            for region in plan.deficit.regions:
                volume[str(region.type)] += region.volume_mm3 + 1e-3
            found, most = max(volume.items(), key=lambda item: item[1], default=("none", 0.0))
            table[kind][found if most > 1e-4 else "none"] += 1
            sure[kind] += [r.confidence for r in plan.deficit.regions if str(r.type) == kind]
    columns = [*KINDS, *sorted({c for row in table.values() for c in row} - set(KINDS))]
    print("| was \\ found | " + " | ".join(columns) + " | right |")
    print("|---|" + "---|" * (len(columns) + 1))
    for kind, row in table.items():
        cells = [str(row[c]) if row[c] else "" for c in columns]
        print(f"| {kind} | " + " | ".join(cells) + f" | {row[kind] / said.seeds:.0%} |")
    for kind, values in sure.items():
        if values:
            print(f"confidence of {kind}: median {np.median(values):.2f}")
    if said.page and said.only is None:
        from measured_page import write_rows  # beside this script

        write_rows("bench_kinds", PAGE_HEADER, [page_row(said.part, table, said.seeds)])


if __name__ == "__main__":
    main()
