"""What of a cloud lies beside places, in a grid of cells instead of a tree."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from amrepair.arrays import Mask, Numbers, Points
from amrepair.field import near_kernels as kernels
from amrepair.frames import box_of
from gcode.compiled import read_only

# In one grid; cells of a larger one are wider than the distance asked for.
MOST_NEAR_CELLS = 16_000_000
SPACING_POINTS = 2_000  # that tell how dense a cloud is


def spacing_in(tree: cKDTree) -> float:
    """1/√ρ of ρ points a mm² of surface, from a sample's nearest neighbours.

    Random points have their 8th neighbour at √(8/πρ) on average.
    """
    some = tree.data[:: max(1, tree.n // SPACING_POINTS)]
    count = min(8, tree.n - 1)
    reach = tree.query(some, k=[count + 1], workers=-1)[0][:, 0]
    return float(np.median(reach) * np.sqrt(np.pi / max(count, 1)))


def has_near(
    asked_mm: Points, points_mm: Float[np.ndarray, "m 3"], within_mm: float, *, enough: int = 1
) -> Mask:
    """(k,) whether at least so many of the points lie within a distance of each place."""
    return _beside(asked_mm, points_mm, within_mm, enough)[1] >= enough


def nearest_within(
    asked_mm: Points, points_mm: Float[np.ndarray, "m 3"], within_mm: float
) -> Numbers:
    """(k,) number of the point nearest to each place, −1 where none is nearer than a distance."""
    return _beside(asked_mm, points_mm, within_mm, len(points_mm) + 1)[0]


def _beside(
    asked_mm: Points, points_mm: Float[np.ndarray, "m 3"], within_mm: float, enough: int
) -> tuple[Numbers, Numbers]:
    """(n,) the nearest within a distance, or −1, and (n,) how many are, up to `enough`.

    The points lie in cells at least as wide as the distance, an empty layer about the places.
    """
    if len(asked_mm) == 0 or len(points_mm) == 0:
        return np.full(len(asked_mm), -1, dtype=np.int32), np.zeros(len(asked_mm), dtype=np.int32)
    asked, points = (read_only(places) for places in (asked_mm, points_mm))
    cells = cells_about(asked, points, within_mm)
    nearest, count = kernels.beside(asked, *cells, within_mm, enough)
    return nearest, count


def cells_about(
    asked: Points, points: Float[np.ndarray, "m 3"], within_mm: float
) -> tuple[
    Int[np.ndarray, " _c"],
    Float[np.ndarray, "_k 3"],
    Int[np.ndarray, " _k"],
    Float[np.ndarray, " 3"],
    float,
    Int[np.ndarray, " 3"],
]:
    """Points by cells, as `near_kernels.by_cell` has them; the cells' corner, edge and number.

    All points within a distance of a place lie in its own cell and those about it.
    """
    low, high = box_of(asked)
    size_mm = high - low + 3.0 * within_mm
    # by a hair wider: what rounding puts into the next cell is looked for there
    cell_mm = max(1.0001 * within_mm, float(np.cbrt(np.prod(size_mm) / MOST_NEAR_CELLS)))
    corner = low - 1.0001 * cell_mm  # the lowest place must not round into the empty layer
    shape = np.floor((high - corner) / cell_mm).astype(np.int64) + 2
    return *kernels.by_cell(asked, points, corner, cell_mm, shape), corner, cell_mm, shape
