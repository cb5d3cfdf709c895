"""Beads of variable width along the medial axis of what is too thin for two rings.

The axis is the part of the Voronoi diagram of boundary samples whose two nearest walls face each
other. Widths follow the distance to them; what is narrower than the least bead is said, not lost.

References
----------
T. Kuipers et al., "A framework for adaptive width control of dense contour-parallel toolpaths in
fused deposition modeling", Computer-Aided Design 128 (2020): why width must vary along the axis.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import manifold3d
import numpy as np
from jaxtyping import Float

from gcode.moves import Role
from gcode.slicing import medial_kernels as kernels
from gcode.slicing.beads import Bead
from gcode.slicing.options import FillOptions
from gcode.slicing.regions import flattened
from gcode.stretches import stretches_of

SAMPLE_MM = 0.12  # of a contour
ON_AXIS_MM = 1e-5
APART_MM = 0.15  # points of a bead
Chain = tuple[Float[np.ndarray, "_k 2"], Float[np.ndarray, " _k"]]  # points, distances to walls


@dataclass(frozen=True, slots=True)
class ThinFill:
    """Beads in a thin region, and the area that no bead can serve."""

    beads: tuple[Bead, ...]
    lost_mm2: float


def fill_thin(region: Any, bore_mm: float, options: FillOptions) -> ThinFill:
    """Beads along the medial axis of one connected thin region.

    Parameters
    ----------
    region
        A connected cross-section nowhere wider than about the widest bead from such a bore.
    """
    least_mm, most_mm = options.widths_mm(bore_mm)
    area_mm2 = float(region.area())
    chains = [piece for chain in _axis(region, options) for piece in _long_enough(*chain, least_mm)]
    if not chains:
        return _dot(region, area_mm2, bore_mm, options)
    beads = [_bead(points, radius, most_mm, options) for points, radius in chains]
    laid_mm2 = sum(bead.area_mm2 for bead in beads)
    # what narrower stretches hold cannot be told from rounding in the sum: measure it by the
    # bead's reach; a factor beyond a quarter means area without axis
    factor = area_mm2 / laid_mm2 if laid_mm2 > 0 else 1.0
    least, most = options.flow_span
    applied = min(max(factor, least), most)
    lost_mm2 = max(0.0, area_mm2 - laid_mm2 * applied)
    scaled = [_capped(bead.scaled(applied), most_mm) for bead in beads]
    return ThinFill(tuple(scaled), lost_mm2)


def _capped(bead: Bead, most_mm: float) -> Bead:
    return Bead(bead.xy_mm, np.minimum(bead.share_mm, most_mm), bead.role, bead.closed)


def _dot(region: Any, area_mm2: float, bore_mm: float, options: FillOptions) -> ThinFill:
    """One straight stroke through a region that is about as long as wide.

    A thread too thin for a bead has no axis, either: a stroke from end to end of one that is bent
    would lie beside it, and across the hole that a ring of it runs around.
    """
    least_mm, most_mm = options.widths_mm(bore_mm)
    points = np.asarray(max(region.to_polygons(), key=len), np.float64)
    centre = points.mean(axis=0)
    # This is the direction of the longest chord through the corners.
    _, _, axes = np.linalg.svd(points - centre, full_matrices=False)
    along = (points - centre) @ axes[0]
    across = (points - centre) @ axes[1]
    length_mm, breadth_mm = float(np.ptp(along)), float(np.ptp(across))
    if min(length_mm, breadth_mm) < least_mm or area_mm2 < least_mm * least_mm:
        return ThinFill((), area_mm2)
    middle = centre + axes[0] * 0.5 * (along.max() + along.min())
    middle = middle + axes[1] * 0.5 * (across.max() + across.min())
    run_mm = max(length_mm - 0.5 * breadth_mm, area_mm2 / most_mm)
    xy = middle + np.array([[-0.5], [0.5]]) * run_mm * axes[0]
    share_mm = area_mm2 / run_mm
    aside = 0.5 * share_mm * axes[1]
    corners = np.array([xy[0] - aside, xy[1] - aside, xy[1] + aside, xy[0] + aside])
    covered = manifold3d.CrossSection([corners], manifold3d.FillRule.NonZero)  # either way round
    if (covered ^ region).area() < options.dot_inside_ratio * area_mm2:
        return ThinFill((), area_mm2)
    return ThinFill((Bead(xy, np.array([share_mm]), Role.GAP_FILL, closed=False),), 0.0)


def _axis(region: Any, options: FillOptions) -> list[Chain]:
    """Chains of the medial axis: points and distances to the walls.

    From Delaunay triangles. Which samples make one is undecided where many lie on one circle, as
    between parallel walls: they are moved by far less than a contour is known.
    """
    points, starts = flattened(region)
    if len(points) < 3:
        return []
    nodes, radius, runs, starts_at = kernels.axis_of(
        points, starts, SAMPLE_MM, ON_AXIS_MM, options.facing_ratio
    )
    paths = [run.tolist() for run in np.split(runs, starts_at[1:-1]) if len(run)]
    return [(nodes[path], radius[path]) for path in _joined(paths, nodes) if len(path) > 1]


def _joined(paths: list[list[int]], nodes: Float[np.ndarray, "n 2"]) -> list[list[int]]:
    """Paths merged where they meet, the straightest pair first."""
    paths = [list(p) for p in paths]
    merged = True
    while merged and len(paths) > 1:
        merged = False
        at: dict[int, list[tuple[int, bool]]] = defaultdict(list)
        for i, path in enumerate(paths):
            if path[0] != path[-1]:
                at[path[0]].append((i, True))
                at[path[-1]].append((i, False))
        for members in at.values():
            best = None
            for a in range(len(members)):
                for b in range(a + 1, len(members)):
                    (i, i_head), (j, j_head) = members[a], members[b]
                    if i == j:
                        continue
                    u = _leaving(paths[i], nodes, i_head)
                    v = _leaving(paths[j], nodes, j_head)
                    score = float(u @ v)
                    if best is None or score < best[0]:
                        best = (score, i, i_head, j, j_head)
            if best is not None:
                _, i, i_head, j, j_head = best
                first = paths[i][::-1] if i_head else paths[i]
                second = paths[j] if j_head else paths[j][::-1]
                paths[i] = first + second[1:]
                del paths[j]
                merged = True
                break
    return paths


def _leaving(
    path: list[int], nodes: Float[np.ndarray, "n 2"], head: bool
) -> Float[np.ndarray, " 2"]:
    """Unit direction in which a path leaves its head or tail."""
    run = path if head else path[::-1]
    d = nodes[run[min(3, len(run) - 1)]] - nodes[run[0]]
    return d / max(float(np.hypot(*d)), 1e-12)


def _long_enough(
    points: Float[np.ndarray, "k 2"], radius: Float[np.ndarray, " k"], least_mm: float
) -> list[Chain]:
    """Stretches where the wall is at least `least_mm` thick.

    A wall that is thinner for less than such a length breaks no bead, and one that is thick enough
    for less holds none: a wall of just that thickness would be a row of dashes.
    """
    wide = 2 * radius >= least_mm * (1 - 1e-6)
    along_mm = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    for holds in (False, True):  # short gaps are closed before short stretches go
        for a, b in stretches_of(wide == holds):
            inside = a > 0 and b < len(wide)
            if along_mm[b - 1] - along_mm[a] < least_mm and (holds or inside):
                wide[a:b] = not holds
    return [(points[a:b], radius[a:b]) for a, b in stretches_of(wide) if b - a >= 2]


def _bead(
    points: Float[np.ndarray, "k 2"],
    radius: Float[np.ndarray, " k"],
    most_mm: float,
    options: FillOptions,
) -> Bead:
    """A smooth bead along a chain, its open ends drawn out to half a radius from the wall."""
    closed = len(points) > 3 and bool((np.abs(points[0] - points[-1]) < 1e-9).all())
    if not closed:
        inset = options.end_inset_ratio
        head = points[0] - points[min(2, len(points) - 1)]
        tail = points[-1] - points[-min(3, len(points))]
        head = points[0] + head / max(np.hypot(*head), 1e-12) * inset * radius[0]
        tail = points[-1] + tail / max(np.hypot(*tail), 1e-12) * inset * radius[-1]
        points = np.concatenate([[head], points, [tail]])
        radius = np.concatenate([radius[:1], radius, radius[-1:]])
    keep = kernels.apart_by(points, APART_MM)
    points, radius = points[keep], radius[keep]
    share = np.minimum(radius[:-1] + radius[1:], most_mm)
    return Bead(points, share, Role.GAP_FILL, closed)
