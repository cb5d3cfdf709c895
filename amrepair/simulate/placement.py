"""Where a defect goes on a part: seeded, and smaller where the part leaves no room.

Works on sections of the solid in the build frame. It neither prints nor repairs.
"""

from __future__ import annotations

import manifold3d as m3
import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Values, Vector
from amrepair.errors import InputError
from amrepair.simulate.options import DEFAULT_PLACEMENT
from amrepair.simulate.placed import Defect, PlacedDefect, Printed
from gcode.meshes import box_of_solid
from gcode.reader.job import Beads

_EVERYWHERE_MM = 1e9


def _layer_ranges(defect: Defect, tops_mm: Values, rng: np.random.Generator) -> list[range]:
    """Candidate layer ranges in random order; the one asked for where there is one."""
    count = min(int(defect.values["layers"]), max(1, len(tops_mm) - 2))
    asked = int(defect.values["layer"])
    if asked >= len(tops_mm):
        raise InputError(
            f"the defect {defect} asks for layer {asked}, but the job has {len(tops_mm)} layers"
        )
    if asked >= 0:
        return [range(max(0, asked - count + 1), asked + 1)]
    first_last = min(count + 1, len(tops_mm) - 1)  # the first two layers hold the part: not there
    lasts = rng.permutation(np.arange(first_last, max(first_last + 1, len(tops_mm) - 1)))
    return [
        range(int(last) - count + 1, int(last) + 1) for last in lasts[: DEFAULT_PLACEMENT.tries]
    ]


def _z_range(layers: range, tops_mm: Values) -> tuple[float, float]:
    """Nozzle heights (above, up to) that belong to the layers and to no other."""
    below = tops_mm[layers[0] - 1] if layers[0] > 0 else 0.0
    low = 0.5 * (below + tops_mm[layers[0]])
    last = layers[-1]
    above = tops_mm[last + 1] if last + 1 < len(tops_mm) else tops_mm[last] + 0.2
    return float(low), float(0.5 * (tops_mm[last] + above))


def _solid_through(part: m3.Manifold, layers: range, tops_mm: Values) -> m3.CrossSection:
    """Where the part is solid from the layer under the range to its last layer."""
    bottoms = np.concatenate([[0.0], tops_mm[:-1]])
    middles = 0.5 * (bottoms + tops_mm)
    room = part.slice(float(middles[max(0, layers[0] - 1)]))
    for layer in layers:
        room = room ^ part.slice(float(middles[layer]))
    return room


def random_point(area: m3.CrossSection, rng: np.random.Generator) -> Float[np.ndarray, " 2"] | None:
    """(2,) a point uniform over a cross-section, build frame; None where it is empty."""
    triangles = _triangles(area)
    if len(triangles) == 0:
        return None
    u, v = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    weight = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    if weight.sum() <= 0:
        return None
    pick = int(rng.choice(len(triangles), p=weight / weight.sum()))
    a, b = rng.random(2)
    if a + b > 1:
        a, b = 1 - a, 1 - b
    return triangles[pick, 0] + a * u[pick] + b * v[pick]


def _triangles(area: m3.CrossSection) -> Float[np.ndarray, "n 3 2"]:
    polygons = [np.asarray(polygon, dtype=np.float64) for polygon in area.to_polygons()]
    if not polygons:
        return np.zeros((0, 3, 2))
    corners = np.concatenate(polygons)
    return corners[np.asarray(m3.triangulate(polygons))].reshape(-1, 3, 2)


def nowhere(
    defect: Defect, printed: Printed, rng: np.random.Generator, scale: float
) -> PlacedDefect:
    """No defect at all."""
    return PlacedDefect(defect.kind, (), np.zeros((0, 9)), None, None, np.zeros((2, 3)))


def void(
    defect: Defect, printed: Printed, rng: np.random.Generator, scale: float
) -> PlacedDefect | None:
    """An ellipse in the middle of the part where nothing is extruded."""
    part, tops_mm = printed.part, printed.tops_mm
    diameter_mm = defect.values["diameter"] * scale
    long_mm, short_mm = 0.5 * diameter_mm, 0.5 * diameter_mm * rng.uniform(0.7, 1.0)
    wall_mm = defect.values["wall"] * min(1.0, scale * 1.25)
    for layers in _layer_ranges(defect, tops_mm, rng):
        room = _solid_through(part, layers, tops_mm)
        room = room.offset(-(wall_mm + long_mm), m3.JoinType.Round, circular_segments=32)
        if room.area() < DEFAULT_PLACEMENT.least_room_mm2:
            continue
        centre = random_point(room, rng)
        if centre is None:
            continue
        angle = rng.uniform(0, np.pi)
        low, high = _z_range(layers, tops_mm)
        region = [*centre, np.cos(angle), np.sin(angle), long_mm, short_mm, low, high, 0.0]
        bottom = tops_mm[layers[0] - 1] if layers[0] > 0 else 0.0
        box = np.array([[*(centre - long_mm), bottom], [*(centre + long_mm), tops_mm[layers[-1]]]])
        return PlacedDefect(defect.kind, tuple(layers), np.array([region]), None, None, box)
    return None


def under_extrusion(
    defect: Defect, printed: Printed, rng: np.random.Generator, scale: float
) -> PlacedDefect | None:
    """Layers, or a circle in them, with less flow."""
    part, tops_mm = printed.part, printed.tops_mm
    flow = defect.values["flow"]
    diameter_mm = defect.values["diameter"] * scale
    ranges = _layer_ranges(defect, tops_mm, rng)
    # Where a face ends within the range, its thin film is within any tolerance: others go first.
    for layers in sorted(ranges, key=lambda r: not _even(part, r, tops_mm)):
        room = _solid_through(part, layers, tops_mm)
        if room.area() < 1.0:
            continue
        low, high = _z_range(layers, tops_mm)
        centre, half_mm = np.zeros(2), _EVERYWHERE_MM
        bounds = np.array(room.bounds()).reshape(2, 2)
        if diameter_mm > 0:
            half_mm = 0.5 * diameter_mm
            found = random_point(room.offset(-half_mm, m3.JoinType.Round), rng)
            if found is None:
                continue
            centre = found
            bounds = np.stack([centre - half_mm, centre + half_mm])
        bottom = tops_mm[layers[0] - 1] if layers[0] > 0 else 0.0
        box = np.array([[*bounds[0], bottom], [*bounds[1], tops_mm[layers[-1]]]])
        region = [*centre, 1.0, 0.0, half_mm, half_mm, low, high, flow]
        return PlacedDefect(defect.kind, tuple(layers), np.array([region]), None, None, box)
    return None


def missing_beads(
    defect: Defect, printed: Printed, rng: np.random.Generator, scale: float
) -> PlacedDefect | None:
    """Stretches of the job's own lines around one place that are not extruded."""
    part, tops_mm, beads = printed.part, printed.tops_mm, printed.beads
    if beads is None:
        raise InputError(f"the defect {defect} skips beads, but there is no job to skip them in")
    count = max(1, round(defect.values["beads"] * scale))
    for layers in _layer_ranges(defect, tops_mm, rng):
        centre = random_point(_solid_through(part, layers, tops_mm), rng)
        if centre is None:
            continue
        low, high = _z_range(layers, tops_mm)
        z = beads.end_mm[:, 2]
        regions = []
        for layer in layers:
            mine = np.flatnonzero((beads.layer == layer) & (z > low) & (z <= high))
            found = _stretches(beads, mine, centre, count, 0.5 * defect.values["length"] * scale)
            thick_mm = tops_mm[layer] - (tops_mm[layer - 1] if layer else 0.0)
            z_low, z_high = tops_mm[layer] - 0.5 * thick_mm, tops_mm[layer] + 0.25 * thick_mm
            regions += [[*row, DEFAULT_PLACEMENT.line_mm, z_low, z_high, 0.0] for row in found]
        if len(regions) < count * len(layers):
            continue
        rows = np.array(regions)
        reach = rows[:, 4:5] * np.abs(rows[:, 2:4]) + 0.5
        bottom = tops_mm[layers[0] - 1] if layers[0] > 0 else 0.0
        box = np.array(
            [
                [*(rows[:, :2] - reach).min(axis=0), bottom],
                [*(rows[:, :2] + reach).max(axis=0), tops_mm[layers[-1]]],
            ]
        )
        return PlacedDefect(defect.kind, tuple(layers), rows, None, None, box)
    return None


def _stretches(
    beads: Beads,
    mine: Int[np.ndarray, " k"],
    centre: Float[np.ndarray, " 2"],
    count: int,
    half_mm: float,
) -> list[list[float]]:
    """x, y, cos, sin, half-length of the parts of the nearest long lines that lie by `centre`."""
    start, end = beads.start_mm[mine, :2], beads.end_mm[mine, :2]
    length = np.linalg.norm(end - start, axis=1)
    long_ = length >= DEFAULT_PLACEMENT.least_line_mm
    start, end, length = start[long_], end[long_], length[long_]
    along = (end - start) / length[:, None]
    at = np.clip(((centre - start) * along).sum(axis=1), 0.0, length)
    away = np.linalg.norm(start + at[:, None] * along - centre, axis=1)
    found = []
    for k in np.argsort(away, kind="stable")[:count]:
        a, b = max(0.0, at[k] - half_mm), min(float(length[k]), at[k] + half_mm)
        middle = start[k] + 0.5 * (a + b) * along[k]
        found.append([*middle.tolist(), *along[k].tolist(), 0.5 * (b - a)])
    return found


def _even(part: m3.Manifold, layers: range, tops_mm: Values) -> bool:
    """Whether the part's section stays the same over the layers."""
    room = _solid_through(part, layers, tops_mm).area()
    bottoms = np.concatenate([[0.0], tops_mm[:-1]])
    areas = [part.slice(float(0.5 * (bottoms[k] + tops_mm[k]))).area() for k in layers]
    return bool(room >= DEFAULT_PLACEMENT.even_ratio * max(areas))


def _bite(
    centre_mm: Vector,
    radius_mm: float,
    depth_mm: float,
    roughness_mm: float,
    rng: np.random.Generator,
) -> m3.Manifold:
    """A shell-shaped fracture: the rough cap of a ball, `depth_mm` deep, open above.

    `centre_mm` lies on the rim's plane; the ball's own centre is above it where the bite is
    shallower than a half ball.
    """
    ball_mm = 0.5 * (radius_mm**2 + depth_mm**2) / depth_mm
    ball = m3.Manifold.sphere(ball_mm, 96).to_mesh64()
    corners = np.asarray(ball.vert_properties)[:, :3]
    waves = rng.normal(size=(24, 3)) * (3.0 / radius_mm)
    phases = rng.uniform(0, 2 * np.pi, 24)
    noise = np.sqrt(2 / 24) * np.cos(corners @ waves.T + phases).sum(axis=1)
    limit_mm = min(roughness_mm, 0.15 * radius_mm)
    corners = corners * (1 + limit_mm * noise / ball_mm)[:, None]
    rough = m3.Manifold(
        m3.Mesh64(np.ascontiguousarray(corners), np.array(ball.tri_verts, dtype=np.uint64))
    )
    cap = rough.translate((0.0, 0.0, ball_mm - depth_mm)).trim_by_plane((0.0, 0.0, -1.0), 0.0)
    column = m3.Manifold.cylinder(4 * radius_mm, radius_mm, radius_mm, 96)
    return (cap + column.translate((0.0, 0.0, -1e-3))).translate(tuple(centre_mm))


def chip(
    defect: Defect, printed: Printed, rng: np.random.Generator, scale: float
) -> PlacedDefect | None:
    """A bite off an edge of the top: its middle lies on the outline near the top."""
    part = printed.part
    radius_mm = 0.5 * defect.values["size"] * scale
    height_mm = float(part.bounding_box()[5])
    deep_mm = min(defect.values["depth"] * scale, radius_mm, 0.4 * height_mm)
    section = part.slice(height_mm - 0.5 * deep_mm)
    outlines = [np.asarray(polygon, dtype=np.float64) for polygon in section.to_polygons()]
    if not outlines or section.area() < 1.0:
        return None
    lengths = [np.linalg.norm(np.roll(o, -1, axis=0) - o, axis=1) for o in outlines]
    starts = np.concatenate(outlines)
    ends = np.concatenate([np.roll(o, -1, axis=0) for o in outlines])
    weight = np.concatenate(lengths)
    whole = len(part.decompose())  # parts of several bodies, or with closed cavities
    for _ in range(DEFAULT_PLACEMENT.tries):
        pick = int(rng.choice(len(starts), p=weight / weight.sum()))
        on_edge = starts[pick] + rng.random() * (ends[pick] - starts[pick])
        centre = np.array([*on_edge, height_mm])
        bite = _bite(centre, radius_mm, deep_mm, defect.values["roughness"], rng)
        broken = part ^ bite
        volume_mm3 = broken.volume()
        whole_mm3 = np.pi / 6 * deep_mm * (3 * radius_mm**2 + deep_mm**2)
        if volume_mm3 < 0.1 * whole_mm3 or volume_mm3 < 3.0:
            continue
        pieces = (part - bite).decompose()
        # A piece that falls off with the bite would lie loose on the bed: that is no chip.
        if sum(abs(piece.volume()) > DEFAULT_PLACEMENT.least_piece_mm3 for piece in pieces) > whole:
            continue
        box = box_of_solid(broken)
        grow_mm = np.array([0.5, 0.5, 0.5])  # the print stands a little off the CAD
        box = np.stack([box[0] - grow_mm, box[1] + grow_mm])
        return PlacedDefect(defect.kind, (), np.zeros((0, 9)), bite, None, box)
    return None


def blob(
    defect: Defect, printed: Printed, rng: np.random.Generator, scale: float
) -> PlacedDefect | None:
    """A dome on the top of the part."""
    part, top_mm = printed.part, float(printed.tops_mm[-1])
    radius_mm = 0.5 * defect.values["size"] * scale
    height_mm = defect.values["height"] * scale
    room = part.slice(top_mm - 0.1).offset(-0.3 * radius_mm, m3.JoinType.Round)
    centre = random_point(room, rng)
    if centre is None:
        return None
    dome = m3.Manifold.sphere(1.0, 48).scale((radius_mm, radius_mm, height_mm))
    dome = dome.trim_by_plane((0.0, 0.0, 1.0), -0.05).translate((*centre, top_mm))
    box = box_of_solid(dome)
    return PlacedDefect(defect.kind, (), np.zeros((0, 9)), None, dome, box)
