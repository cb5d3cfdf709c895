"""Strands: what lies on a surface longer than wide, told by averages along it.

A string or the trace of a dragged drop is narrower than the window in which noise averages out;
along it there are points enough.
"""

from __future__ import annotations

import numpy as np

from amrepair.arrays import Mask, Values
from amrepair.field.fused import Surfels
from amrepair.field.near import cells_about
from amrepair.frames import unit_vectors, ways_across
from amrepair.regions import strands_kernels as kernels
from amrepair.template.port import Template
from gcode.compiled import read_only

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
    higher_mm: Values,
    maybe: Mask,
    *,
    systematic_mm: float,
    noise_mm: float,
) -> Mask:
    """(n,) cells that lie on a strip whose mean deviation outwards is over its limit.

    Parameters
    ----------
    higher_mm
        (n,) how far outside each cell lies, without what is usual there.
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
    turn = np.pi * np.arange(WAYS) / WAYS
    asked_mm, points_mm = read_only(places), read_only(surfels.place_mm)
    cells = cells_about(asked_mm, points_mm, float(np.hypot(LONG_MM, TALL_MM)))
    enough = SEEN * 4 * LONG_MM * WIDE_MM / surfels.spacing_mm**2
    return kernels.on_strips(
        asked_mm, (outward, *ways_across(outward)),
        np.stack([np.cos(turn), np.sin(turn)], axis=1), cells,
        surfels.count, higher_mm, maybe, (LONG_MM, WIDE_MM, TALL_MM),
        (enough, systematic_mm, noise_mm, LEAST_RIDGE_MM),
    )  # fmt: skip
