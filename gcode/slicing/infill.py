"""Fills a region with strokes: solid or sparse rectilinear, grid, concentric.

It decides where lines run, not in which order; `order` does. A solid fill is weighed so that its
strokes carry exactly the region's area.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from gcode.moves import Role
from gcode.slicing import infill_kernels as kernels
from gcode.slicing.beads import Bead, loop_bead
from gcode.slicing.medial import fill_thin
from gcode.slicing.options import FillOptions
from gcode.slicing.regions import flattened, offset, peel, pieces

SOLID_ANGLES_RAD = (math.pi / 4, -math.pi / 4)


def solid_fill(
    region: Any,
    *,
    spacing_mm: float,
    angle_rad: float,
    role: Role,
    bore_mm: float,
    options: FillOptions,
    pattern: Literal["rectilinear", "concentric"] = "rectilinear",
    overlap_ratio: float = 0.0,
) -> tuple[list[Bead], float]:
    """Beads that fill `region`, and the area that none of them could serve.

    What is narrower than about two lines is filled along its medial axis. Lines end half a
    spacing inside the region, or nearer to its rim by up to `overlap_ratio` spacings, as much as
    brings the plastic that their round ends lack to where it lacks: more flow along the whole line
    would pile it up in the middle.
    """
    area_mm2 = region.area()
    if area_mm2 <= 0:
        return [], 0.0
    if pattern == "concentric":
        return _concentric(region, spacing_mm, role, bore_mm, options)
    wide = offset(offset(region, -spacing_mm), spacing_mm)
    narrow = region - wide
    beads, lost_mm2 = _thin(narrow, bore_mm, options)
    laid = _lines_up_to_the_rim(wide, spacing_mm, angle_rad, role, overlap_ratio, options)
    if not laid and wide.area() > 0:
        more, lost = _thin(wide, bore_mm, options)
        return beads + more, lost_mm2 + lost
    weigh_mm2 = wide.area() + lost_mm2  # crumbs along the narrow seams go to their neighbours
    total_mm2 = sum(bead.area_mm2 for bead in laid)
    factor = weigh_mm2 / total_mm2 if total_mm2 else 1.0
    least, most = options.flow_span
    applied = min(max(factor, least), most)
    left_mm2 = max(0.0, weigh_mm2 - total_mm2 * applied)
    return beads + [bead.scaled(applied) for bead in laid], left_mm2


def _lines_up_to_the_rim(
    region: Any,
    spacing_mm: float,
    angle_rad: float,
    role: Role,
    overlap_ratio: float,
    options: FillOptions,
) -> list[Bead]:
    """Lines that end so near to the rim that they carry the region's area, if they may."""

    def ending(inset_mm: float) -> tuple[list[Bead], float]:
        beads = rectilinear(
            offset(region, -inset_mm),
            spacing_mm=spacing_mm,
            angle_rad=angle_rad,
            role=role,
            connect_mm=options.connect_spacings * spacing_mm,
        )
        return beads, float(sum(bead.area_mm2 for bead in beads))

    half_mm, nearer_mm = 0.5 * spacing_mm, overlap_ratio * spacing_mm
    laid, laid_mm2 = ending(half_mm)
    lacking_mm2 = region.area() - laid_mm2
    if not laid or nearer_mm <= 0 or lacking_mm2 <= 0:
        return laid
    nearest, most_mm2 = ending(half_mm - nearer_mm)
    if most_mm2 - laid_mm2 <= lacking_mm2:
        return nearest
    return ending(half_mm - nearer_mm * lacking_mm2 / (most_mm2 - laid_mm2))[0]


def sparse_fill(
    region: Any, *, spacing_mm: float, ratio: float, layer: int, pattern: str
) -> list[Bead]:
    """Lines or rings that cover `ratio` of `region`; grid crosses itself in each layer."""
    if region.is_empty() or ratio <= 0:
        return []
    if pattern == "concentric":
        return _sparse_rings(region, spacing_mm, spacing_mm / ratio)
    inner = offset(region, -0.5 * spacing_mm)
    angles: tuple[float, ...]
    if pattern == "grid":
        angles, apart_mm = SOLID_ANGLES_RAD, 2 * spacing_mm / ratio
    else:
        angles, apart_mm = (SOLID_ANGLES_RAD[layer % 2],), spacing_mm / ratio
    beads: list[Bead] = []
    for angle in angles:
        beads += rectilinear(
            inner,
            spacing_mm=apart_mm,
            angle_rad=angle,
            role=Role.SPARSE_INFILL,
            share_mm=spacing_mm,
            connect_mm=0.0,
        )
    return beads


def _sparse_rings(region: Any, spacing_mm: float, apart_mm: float) -> list[Bead]:
    beads: list[Bead] = []
    ring = offset(region, -0.5 * apart_mm)
    while not ring.is_empty():
        beads += _loops(ring, spacing_mm, Role.SPARSE_INFILL)
        ring = offset(ring, -apart_mm)
    return beads


def rectilinear(
    region: Any,
    *,
    spacing_mm: float,
    angle_rad: float,
    role: Role,
    connect_mm: float,
    share_mm: float | None = None,
) -> list[Bead]:
    """Parallel lines across a region, chained where their ends are within `connect_mm`."""
    points, starts = flattened(region)
    if len(points) < 3:
        return []
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    turn = np.array([[c, -s], [s, c]])  # row vectors: world → scan frame
    turned = np.ascontiguousarray(points @ turn)
    share = spacing_mm if share_mm is None else share_mm
    line, low, high, first = kernels.scan_lines(turned, starts, spacing_mm, 0.0)
    if len(line) == 0:
        return []
    order, code = kernels.chain_chords(low, high, first, connect_mm)
    y = line[order] * spacing_mm
    backward = (code & 1).astype(bool)
    x0 = np.where(backward, high[order], low[order])
    x1 = np.where(backward, low[order], high[order])
    ends = np.stack([np.stack([x0, y], 1), np.stack([x1, y], 1)], axis=1).reshape(-1, 2)
    ends = ends @ turn.T
    cuts = [*(2 * np.flatnonzero(code & 2)).tolist(), len(ends)]
    return [
        Bead(ends[a:b], np.full(b - a - 1, share), role, closed=False)
        for a, b in pairwise(cuts)
        if b - a >= 2
    ]


def _concentric(
    region: Any, spacing_mm: float, role: Role, bore_mm: float, options: FillOptions
) -> tuple[list[Bead], float]:
    """Rings all the way in, medial beads where they meet."""
    beads: list[Bead] = []
    lost_mm2 = 0.0
    box = region.bounds()
    count = math.ceil(max(box[2] - box[0], box[3] - box[1]) / spacing_mm) + 1
    peeled = peel(region, spacing_mm, count)
    for ring in peeled.rings:
        beads += ring_beads(ring.centre, ring.area_mm2, spacing_mm, role, options)
    for part in peeled.thin:
        more, lost = _thin(part, bore_mm, options)
        beads += more
        lost_mm2 += lost
    return beads, lost_mm2


def ring_beads(
    centre: Any, area_mm2: float, spacing_mm: float, role: Role, options: FillOptions
) -> list[Bead]:
    """Closed beads along a ring's centre, weighed to the ring's area."""
    loops = _loops(centre, spacing_mm, role)
    laid_mm2 = sum(bead.area_mm2 for bead in loops)
    if laid_mm2 <= 0:
        return []
    least, most = options.flow_span
    factor = min(max(area_mm2 / laid_mm2, least), most)
    return [bead.scaled(factor) for bead in loops]


def _thin(region: Any, bore_mm: float, options: FillOptions) -> tuple[list[Bead], float]:
    """Medial beads of every piece; crumbs count as lost."""
    beads: list[Bead] = []
    least_mm, _ = options.widths_mm(bore_mm)
    found_mm2 = 0.0
    lost_mm2 = 0.0
    for part in pieces(region, least_mm2=0.25 * least_mm * least_mm):
        thin = fill_thin(part, bore_mm, options)
        beads += thin.beads
        lost_mm2 += thin.lost_mm2
        found_mm2 += part.area()
    return beads, lost_mm2 + max(0.0, region.area() - found_mm2)


def _loops(centre: Any, share_mm: float, role: Role) -> list[Bead]:
    return [loop_bead(np.asarray(c), share_mm, role) for c in centre.to_polygons() if len(c) > 2]
