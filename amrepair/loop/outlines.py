"""Which beads of a job lie at the outside of the part, where its slicer names no roles.

Slic3r, IceSL and Kiri:Moto write none, and some hosts strip comments. Seen from above, a bead of a
layer is outermost where nothing is laid beside it: the outside, or a hole. A hole is bounded by
closed loops alone, and a bead would fit into it; a void of sparse infill has a line of it, which is
open, at some side, and where no more loops fit in a slit is left between them.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from amrepair.arrays import ColumnMask, Mask, PlanePoints
from gcode.reader import Beads
from gcode.surfaces.lines import columns_around, near_lines

OUTLINE_CELL_MM = 0.15
OUTLINE_LAYERS = 40  # evenly spread: enough walls to register by
CLOSED_MM = 0.8  # a loop ends so near to where it began: slicers leave a gap at the seam
_BESIDE = np.ones((3, 3), bool)


def outermost(beads: Beads, ours: Mask, half_mm: float) -> Mask:
    """Which of a job's beads bound the part, of up to `OUTLINE_LAYERS` of its layers.

    Parameters
    ----------
    ours
        (n,) beads of the part.
    half_mm
        Half of what a bead is wide.
    """
    which = np.flatnonzero(ours)
    layers = np.unique(beads.layer[which])
    steps = np.linspace(0, len(layers) - 1, min(len(layers), OUTLINE_LAYERS)).round().astype(int)
    closed = _closed(beads)
    found = np.zeros(len(ours), bool)
    for layer in layers[steps]:
        own = which[beads.layer[which] == layer]
        found[own] = _at_the_edge(
            beads.start_mm[own, :2], beads.end_mm[own, :2], closed[own], half_mm
        )
    return found


def _closed(beads: Beads) -> Mask:
    """Whether each bead belongs to a path without a travel in it that ends where it began."""
    breaks = (np.linalg.norm(beads.start_mm[1:] - beads.end_mm[:-1], axis=1) > 1e-3) | (
        beads.layer[1:] != beads.layer[:-1]
    )
    first = np.flatnonzero(np.r_[True, breaks])
    last = np.r_[first[1:], len(beads.layer)] - 1
    apart_mm = np.linalg.norm(beads.end_mm[last] - beads.start_mm[first], axis=1)
    return np.repeat((apart_mm < CLOSED_MM) & (last > first + 1), last - first + 1)


def _at_the_edge(start_mm: PlanePoints, end_mm: PlanePoints, closed: Mask, half_mm: float) -> Mask:
    cell = OUTLINE_CELL_MM
    low, shape = columns_around(start_mm, end_mm, 2.0, cell)

    def covered(pick: Mask) -> ColumnMask:
        return near_lines(
            start_mm[pick], end_mm[pick], half_mm + 0.5 * cell,
            low_mm=low, cell_mm=cell, shape=shape,
        )  # fmt: skip

    bare = ~covered(np.ones(len(closed), bool))
    voids, count = ndimage.label(bare)
    infill = ndimage.binary_dilation(covered(~closed), _BESIDE, iterations=2)
    inside = ndimage.maximum(infill, voids, range(count + 1)) > 0
    free_mm = cell * ndimage.distance_transform_edt(bare)
    inside |= ndimage.maximum(free_mm, voids, range(count + 1)) < half_mm  # a slit between loops
    inside[[0, voids[0, 0]]] = [True, False]  # the beads themselves; the outside
    away_mm = cell * ndimage.distance_transform_edt(inside[voids])
    x, y = np.floor((0.5 * (start_mm + end_mm) - low) / cell).astype(np.int64).T
    return np.asarray(away_mm[y, x] < half_mm + 2 * cell)
