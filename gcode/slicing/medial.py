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
from itertools import accumulate, pairwise
from typing import Any

import manifold3d
import numpy as np
from jaxtyping import Float, Int

from gcode.moves import Role
from gcode.slicing import medial_kernels as kernels
from gcode.slicing.beads import Bead
from gcode.slicing.options import FillOptions
from gcode.slicing.regions import flattened

SAMPLE_MM = 0.12  # of a contour
ON_AXIS_MM = 1e-5
APART_MM = 0.15  # points of a bead
Axis = tuple[
    Float[np.ndarray, "t 2"],
    Float[np.ndarray, " t"],
    Int[np.ndarray, " k"],
    Int[np.ndarray, " r1"],
]


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
    points, starts = flattened(region)
    if len(points) < 3:
        return _dot(points, starts, region, bore_mm, options)
    xy, share, first, closed, laid_mm2 = kernels.beads_along(
        *_axis(points, starts, options), least_mm, most_mm, options.end_inset_ratio, APART_MM
    )
    if not len(closed):
        return _dot(points, starts, region, bore_mm, options)
    # what narrower stretches hold cannot be told from rounding in the sum: measure it by the
    # bead's reach; a factor beyond a quarter means area without axis
    factor = area_mm2 / laid_mm2 if laid_mm2 > 0 else 1.0
    least, most = options.flow_span
    applied = min(max(factor, least), most)
    lost_mm2 = max(0.0, area_mm2 - laid_mm2 * applied)
    share = np.minimum(share * applied, most_mm)
    return ThinFill(
        tuple(
            Bead(xy[a:b], share[a : b - 1], Role.GAP_FILL, around)
            for (a, b), around in zip(pairwise(first.tolist()), closed.tolist(), strict=True)
        ),
        lost_mm2,
    )


def _dot(
    points: Float[np.ndarray, "n 2"],
    starts: Int[np.ndarray, " m"],
    region: Any,
    bore_mm: float,
    options: FillOptions,
) -> ThinFill:
    """One straight stroke through a region that is about as long as wide.

    A thread too thin for a bead has no axis, either: a stroke from end to end of one that is bent
    would lie beside it, and across the hole that a ring of it runs around.
    """
    least_mm, most_mm = options.widths_mm(bore_mm)
    area_mm2 = float(region.area())
    if area_mm2 < least_mm * least_mm:
        return ThinFill((), area_mm2)
    longest = int(np.argmax(np.diff(starts)))
    points = points[starts[longest] : starts[longest + 1]]
    centre = points.mean(axis=0)
    # This is the direction of the longest chord through the corners.
    _, _, axes = np.linalg.svd(points - centre, full_matrices=False)
    along = (points - centre) @ axes[0]
    across = (points - centre) @ axes[1]
    length_mm, breadth_mm = float(np.ptp(along)), float(np.ptp(across))
    if min(length_mm, breadth_mm) < least_mm:
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


def _axis(
    points: Float[np.ndarray, "n 2"], starts: Int[np.ndarray, " m"], options: FillOptions
) -> Axis:
    """Chains of the medial axis: nodes, their distances to the walls, and the nodes of each chain.

    From Delaunay triangles. Which samples make one is undecided where many lie on one circle, as
    between parallel walls: they are moved by far less than a contour is known.
    """
    nodes, radius, runs, begins = kernels.axis_of(
        points, starts, SAMPLE_MM, ON_AXIS_MM, options.facing_ratio
    )
    if kernels.ends_meet(runs, begins, len(nodes)):
        paths = _joined([run.tolist() for run in np.split(runs, begins[1:-1])], nodes)
        runs = np.array([node for path in paths for node in path], np.int64)
        begins = np.array([0, *accumulate(len(path) for path in paths)], np.int64)
    return nodes, radius, runs, begins


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
