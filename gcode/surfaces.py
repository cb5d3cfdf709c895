"""Height fields of what already stands on the bed: readers and queries.

A height field answers "how high is the part here?" for the slicer (floor of a defect), the
checker (nozzle body against the part) and the writer (Z-hop). It does not know why it stands so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True, slots=True)
class HeightField:
    """Top surface over a regular XY grid, build frame.

    Attributes
    ----------
    origin_mm
        (2,) XY of the *corner* of cell [0, 0]; cell [iy, ix] has its centre at
        origin + (ix + ½, iy + ½) × cell.
    cell_mm
        Edge of a square cell.
    z_mm
        (ny, nx) height of the top surface; 0 is the bed. Unseen cells carry the height that
        is safe for collisions (idea 7 of the design: unseen is solid), and are False in `seen`.
    seen
        (ny, nx) whether a sensor measured the cell.
    """

    origin_mm: Float[np.ndarray, " 2"]
    cell_mm: float
    z_mm: Float[np.ndarray, "ny nx"]
    seen: Bool[np.ndarray, "ny nx"]
