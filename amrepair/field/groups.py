"""Groups: points in touching cells, and the area that points on a surface stand for."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int
from scipy import ndimage

from amrepair.arrays import Numbers, Points
from amrepair.field import groups_kernels as kernels
from amrepair.field.options import DEFAULT_SURFELS
from amrepair.frames import cells_of
from gcode.compiled import read_only

# Pieces nearer than this are one defect, and so are cells of a field that touch at a corner.
GROUP_MM, CELLS_APART = 1.2, 1.8
AREA_CELL_MM = 2.0  # the area of points is counted in cells of this edge


def group_points(points_mm: Points, *, reach_mm: float = GROUP_MM) -> Numbers:
    """(n,) group number of each point: those in touching cells of `reach_mm` belong together."""
    if len(points_mm) == 0:
        return np.zeros(0, np.int64)
    index = cells_of(points_mm, points_mm.min(axis=0), reach_mm)
    occupied = np.zeros(tuple(index.max(axis=0) + 1), bool)
    occupied[tuple(index.T)] = True
    numbered, _ = ndimage.label(occupied, structure=np.ones((3, 3, 3), bool))
    return numbered[tuple(index.T)].astype(np.int64) - 1


def cell_numbers(index: Int[np.ndarray, "n k"]) -> Numbers:
    """(n,) a number from 0 for each row of whole numbers, the same for rows that are alike.

    As `numpy.unique` has it for rows, in a tenth of the time.
    """
    low = index.min(axis=0, initial=0)
    shape = index.max(axis=0, initial=0) - low + 1
    key = np.ravel_multi_index(tuple((index - low).T), tuple(shape))
    return np.unique(key, return_inverse=True)[1]


def connected(one: Int[np.ndarray, " p"], other: Int[np.ndarray, " p"], count: int) -> Numbers:
    """(count,) a number for each of some things, the same for those that pairs of them link."""
    return kernels.groups(read_only(one, np.int64), read_only(other, np.int64), count)


def touching_mm(cell_mm: float) -> float:
    """How far apart pieces of one defect may lie in a field of such cells, mm."""
    return max(GROUP_MM, CELLS_APART * cell_mm)


def area_per_point(surface_mm: Points) -> float:
    """Rough area per template point, mm², from how many cells they fill."""
    if len(surface_mm) == 0:
        return 0.0
    cells = int(cell_numbers(cells_of(surface_mm, 0.0, AREA_CELL_MM)).max()) + 1
    return DEFAULT_SURFELS.area_per_cell * AREA_CELL_MM**2 * cells / len(surface_mm)
