"""Which beads of a job lie at the outside of the part, where its slicer names no roles.

Slic3r, IceSL and Kiri:Moto write none, and some hosts strip comments. A bead is outermost in its
layer where air of the outside lies beside it: around the part, or in a hole. A hole is bounded by
closed loops alone, and a bead could be dropped into it, from above or from below. A void of sparse
infill lies between solid tops and bottoms, however its lines run; where a job leaves those out, its
lines are open, most of them. A slit between loops is too narrow for a bead.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from amrepair.arrays import ColumnMask, Mask, Numbers, PlanePoints
from amrepair.frames import cells_of
from gcode.reader import Beads
from gcode.surfaces.lines import columns_around, heights_by_lines, near_lines

OUTLINE_CELL_MM = 0.15
OUTLINE_LAYERS = 40  # evenly spread: enough walls to register by
CLOSED_MM = 0.8  # a loop ends so near to where it began: slicers leave a gap at the seam
_BESIDE = np.ones((3, 3), bool)


class _Columns(NamedTuple):
    """Columns of a job seen from above, and between which layers beads lie in each.

    Attributes
    ----------
    low_mm
        (2,) corner of column [0, 0], build frame.
    reach_mm
        How far a bead covers, from its middle.
    lowest, highest
        (ny, nx) of the layers that have a bead there; +inf and -inf where none has.
    """

    low_mm: Float[np.ndarray, " 2"]
    reach_mm: float
    lowest: Float[np.ndarray, "ny nx"]
    highest: Float[np.ndarray, "ny nx"]

    @classmethod
    def of(
        cls, start_mm: PlanePoints, end_mm: PlanePoints, layer: Numbers, half_mm: float
    ) -> _Columns:
        low, shape = columns_around(start_mm, end_mm, 2.0, OUTLINE_CELL_MM)
        reach_mm = half_mm + 0.5 * OUTLINE_CELL_MM
        lowest, highest = (
            sign
            * heights_by_lines(
                start_mm, end_mm, reach_mm, sign * layer.astype(np.float64),
                low_mm=low, cell_mm=OUTLINE_CELL_MM, shape=shape,
            )
            for sign in (-1.0, 1.0)
        )  # fmt: skip
        return cls(low, reach_mm, lowest, highest)

    def covered(self, start_mm: PlanePoints, end_mm: PlanePoints) -> ColumnMask:
        return near_lines(
            start_mm, end_mm, self.reach_mm,
            low_mm=self.low_mm, cell_mm=OUTLINE_CELL_MM, shape=self.lowest.shape,
        )  # fmt: skip

    def open_from(self, layer: int) -> ColumnMask:
        """Over which no higher layer has a bead, or under which no lower one has."""
        return (self.highest <= layer) | (self.lowest >= layer)


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
    start_mm, end_mm, of = beads.start_mm[which, :2], beads.end_mm[which, :2], beads.layer[which]
    columns = _Columns.of(start_mm, end_mm, of, half_mm)
    layers = np.unique(of)
    steps = np.linspace(0, len(layers) - 1, min(len(layers), OUTLINE_LAYERS)).round().astype(int)
    closed = _closed(beads)[which]
    found = np.zeros(len(ours), bool)
    for layer in layers[steps]:
        own = np.flatnonzero(of == layer)
        bare = ~columns.covered(start_mm[own], end_mm[own])
        lines = own[~closed[own]]
        infill = columns.covered(start_mm[lines], end_mm[lines])
        outside = _outside(bare, infill, columns.open_from(int(layer)), half_mm)
        away_mm = OUTLINE_CELL_MM * ndimage.distance_transform_edt(~outside)
        middle_mm = 0.5 * (start_mm[own] + end_mm[own])
        x, y = cells_of(middle_mm, columns.low_mm, OUTLINE_CELL_MM).T
        found[which[own]] = away_mm[y, x] < half_mm + 2 * OUTLINE_CELL_MM
    return found


def _outside(
    bare: ColumnMask, infill: ColumnMask, open_from: ColumnMask, half_mm: float
) -> ColumnMask:
    """Which bare columns of a layer are around the part or in a hole of it."""
    voids, count = ndimage.label(bare)
    every = range(count + 1)
    free_mm = OUTLINE_CELL_MM * ndimage.distance_transform_edt(bare & open_from)
    outside = ndimage.maximum(free_mm, voids, every) >= half_mm
    outside &= ndimage.maximum(ndimage.binary_dilation(infill, _BESIDE), voids, every) == 0
    outside[[0, voids[0, 0]]] = [False, True]  # the beads themselves; what is around the part
    return np.asarray(outside[voids])


def _closed(beads: Beads) -> Mask:
    """Whether each bead belongs to a path without a travel in it that ends where it began."""
    breaks = (np.linalg.norm(beads.start_mm[1:] - beads.end_mm[:-1], axis=1) > 1e-3) | (
        beads.layer[1:] != beads.layer[:-1]
    )
    first = np.flatnonzero(np.r_[True, breaks])
    last = np.r_[first[1:], len(beads.layer)] - 1
    apart_mm = np.linalg.norm(beads.end_mm[last] - beads.start_mm[first], axis=1)
    return np.repeat((apart_mm < CLOSED_MM) & (last > first + 1), last - first + 1)
