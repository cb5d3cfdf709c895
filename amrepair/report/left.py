"""What a repair leaves open, as shapes to draw: boxes over columns, those of one cause together."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Faces
from amrepair.report.data import LeftPart, SolidMesh
from amrepair.report.options import DEFAULT_PAGE
from gcode.slicing.patch import LeftCause, LeftColumns

LEFT_KEYS = {
    LeftCause.OUT_OF_REACH: "left_reach",
    LeftCause.NO_BEAD: "left_bead",
    LeftCause.COVERED: "left_covered",
    LeftCause.TOO_LONG: "left_span",
}
# Corners of a box, bits of which are X, Y, Z; faces counter-clockwise from outside.
CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)])
FACES = np.array(
    [[0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4],
     [2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5]]
)  # fmt: skip


def left_parts(left: tuple[LeftColumns, ...]) -> tuple[LeftPart, ...]:
    """What is left by cause, the most first; volumes are those of all columns."""
    parts = [LeftPart(LEFT_KEYS[each.cause], each.volume_mm3, shape_of(each)) for each in left]
    return tuple(sorted(parts, key=lambda part: -part.volume_mm3))


def shape_of(columns: LeftColumns, most: int = DEFAULT_PAGE.left_boxes) -> SolidMesh:
    """Boxes over columns; neighbours joined, as many as it takes, each as high as they are.

    A box lies about the mean of its columns' middles, and holds as much as they do.
    """
    times = max(1, int(np.ceil(np.sqrt(len(columns.low_mm) / most))))
    while True:
        low, high = _joined(columns, times)
        if len(low) <= most:
            return _boxes(low, high)
        times += 1


def _joined(
    columns: LeftColumns, times: int
) -> tuple[Float[np.ndarray, "b 3"], Float[np.ndarray, "b 3"]]:
    """(b, 3) low and high corners of boxes over so many columns each way."""
    edge_mm = columns.cell_mm * times
    corner_mm = columns.middle_mm.min(axis=0) - 0.5 * columns.cell_mm
    cell = np.floor((columns.middle_mm - corner_mm) / edge_mm + 1e-9).astype(np.int64)
    cells, which = np.unique(cell, axis=0, return_inverse=True)
    which = which.reshape(-1)
    number = np.bincount(which)
    middle_mm = np.bincount(which, 0.5 * (columns.low_mm + columns.high_mm)) / number
    thick_mm = np.bincount(which, columns.high_mm - columns.low_mm) / times**2
    xy_mm = corner_mm + cells * edge_mm
    low = np.column_stack([xy_mm, middle_mm - 0.5 * thick_mm])
    return low, np.column_stack([xy_mm + edge_mm, middle_mm + 0.5 * thick_mm])


def _boxes(low_mm: Float[np.ndarray, "b 3"], high_mm: Float[np.ndarray, "b 3"]) -> SolidMesh:
    vertices = low_mm[:, None] + CORNERS * (high_mm - low_mm)[:, None]
    faces: Faces = (FACES + 8 * np.arange(len(low_mm))[:, None, None]).reshape(-1, 3)
    return SolidMesh(vertices.reshape(-1, 3), faces)
