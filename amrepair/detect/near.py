"""Which places have points of a cloud beside them, in a grid of cells instead of a tree."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from amrepair.detect import near_kernels as kernels

# In one grid; cells of a larger one are wider than the distance asked for.
MOST_CELLS = 16_000_000


def has_near(
    asked_mm: Float[np.ndarray, "k 3"],
    points_mm: Float[np.ndarray, "n 3"],
    within_mm: float,
    *,
    enough: int = 1,
) -> Bool[np.ndarray, " k"]:
    """(k,) whether at least so many of the points lie within a distance of each place."""
    if len(asked_mm) == 0 or len(points_mm) == 0:
        return np.zeros(len(asked_mm), dtype=bool)
    low, high = asked_mm.min(axis=0), asked_mm.max(axis=0)
    size_mm = high - low + 3.0 * within_mm
    # by a hair wider: what rounding puts into the next cell is looked for there
    cell_mm = max(1.0001 * within_mm, float(np.cbrt(np.prod(size_mm) / MOST_CELLS)))
    shape = np.floor((high - low) / cell_mm).astype(np.int64) + 3
    corner = low - cell_mm
    asked, points = np.ascontiguousarray(asked_mm), np.ascontiguousarray(points_mm)
    start, ordered = kernels.by_cell(points, corner, cell_mm, shape)
    return np.asarray(
        kernels.has_enough(asked, start, ordered, corner, cell_mm, shape, within_mm, enough)
    )
