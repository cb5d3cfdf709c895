"""Strands: what lies on a surface longer than wide, told by averages along it.

A string or the trace of a dragged drop is narrower than the window in which noise averages out;
along it there are points enough.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool
from scipy.spatial import cKDTree

from amrepair.field.fused import Surfels
from amrepair.field.near import cells_of
from amrepair.frames import unit_vectors, ways_across
from amrepair.regions import strands_kernels as kernels
from amrepair.template.port import Template

# To each side of a place: along a strand, across it, and off the surface.
LONG_MM, WIDE_MM, TALL_MM = 2.5, 0.4, 1.5
WAYS = 16
# Lower ridges are a process's own: seams, the last lines of a fill.
LEAST_RIDGE_MM = 0.3
# Of the points that a strip has on a surface: what was left over of noise lies scattered.
SEEN = 0.5


def on_strands(
    surfels: Surfels,
    template: Template,
    maybe: Bool[np.ndarray, " s"],
    *,
    systematic_mm: float,
    noise_mm: float,
) -> Bool[np.ndarray, " s"]:
    """(s,) cells that lie on a strip whose mean deviation outwards is over its limit.

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
    places = np.ascontiguousarray(surfels.place_mm[asked])
    outward = unit_vectors(template.distance_and_gradient(places)[1])
    enough = SEEN * 4 * LONG_MM * WIDE_MM / surfels.spacing_mm**2
    reach = np.array([LONG_MM, WIDE_MM, TALL_MM])
    cells = cells_of(places, surfels.place_mm, float(np.linalg.norm(reach)))
    over_mm, way = kernels.best_strips(
        places, np.stack([outward, *ways_across(outward)]), cells,
        surfels.deviation_mm, surfels.count, reach, WAYS,
        np.array([systematic_mm, noise_mm, LEAST_RIDGE_MM, enough]),
    )  # fmt: skip
    # as all cells of a window are part of a region, all of a strip that `maybe` belong to it are
    found = over_mm > 0
    tree = cKDTree(places)
    for place, along, up in zip(places[found], way[found], outward[found], strict=True):
        beside = np.array(tree.query_ball_point(place, LONG_MM))
        off = places[beside] - place
        across = np.linalg.norm(np.cross(off - np.outer(off @ up, up), along), axis=1)
        on[asked[beside[(across < WIDE_MM) & (np.abs(off @ up) < TALL_MM)]]] = True
    return on
