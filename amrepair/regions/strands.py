"""Strands: what lies on a surface longer than wide, told by averages along it.

A string or the trace of a dragged drop is narrower than the window in which noise averages out;
along it there are points enough.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from amrepair.arrays import Mask
from amrepair.field.fused import Surfels
from amrepair.field.near import has_near
from amrepair.frames import unit_vectors, ways_across
from amrepair.template.port import Template

# To each side of a place: along a strand, across it, and off the surface.
LONG_MM, WIDE_MM, TALL_MM = 2.5, 0.4, 1.5
WAYS = 16
# Lower ridges are a process's own: seams, the last lines of a fill.
LEAST_RIDGE_MM = 0.3
# Of the points that a strip has on a surface: what was left over of noise lies scattered.
SEEN = 0.5


def on_strands(
    surfels: Surfels, template: Template, maybe: Mask, *, systematic_mm: float, noise_mm: float
) -> Mask:
    """(n,) cells that lie on a strip whose mean deviation outwards is over its limit.

    Parameters
    ----------
    maybe
        Cells that such a strip may pass through.
    systematic_mm, noise_mm
        Of the limit of a mean: what averaging does not remove, and what it does, for one point.
    """
    on = np.zeros(len(surfels), dtype=bool)
    asked = np.flatnonzero(maybe)
    if len(asked) == 0:
        return on
    places = surfels.place_mm[asked]
    outward = unit_vectors(template.distance_and_gradient(places)[1])
    reach_mm = float(np.hypot(LONG_MM, TALL_MM))
    near = np.flatnonzero(has_near(surfels.place_mm, places, reach_mm))
    tree = cKDTree(surfels.place_mm[near])
    enough = SEEN * 4 * LONG_MM * WIDE_MM / surfels.spacing_mm**2
    turn = np.pi * np.arange(WAYS)[:, None] / WAYS
    for place, up, one, other in zip(places, outward, *ways_across(outward), strict=True):
        beside = near[tree.query_ball_point(place, reach_mm)]
        off_mm = surfels.place_mm[beside] - place
        a, b = off_mm @ one, off_mm @ other
        around = (np.abs(off_mm @ up) <= TALL_MM) & (np.hypot(a, b) <= LONG_MM)
        strips = around & (np.abs(b * np.cos(turn) - a * np.sin(turn)) < WIDE_MM)
        points = surfels.count[beside]
        seen, total_mm = strips @ points, strips @ (points * surfels.deviation_mm[beside])
        seen = np.where(seen > enough, seen, np.inf)  # of too few the mean says nothing
        limit_mm = np.maximum(systematic_mm + noise_mm / np.sqrt(seen), LEAST_RIDGE_MM)
        over_mm = total_mm / seen - limit_mm
        if over_mm.max() > 0:
            # as all cells of a window are part of a region, all that `maybe` belong to it are
            own = beside[strips[over_mm.argmax()]]
            on[own[maybe[own]]] = True
    return on
