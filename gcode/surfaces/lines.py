"""Columns near lines, seen from above: which they are, and how high the highest line there is."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from gcode.compiled import read_only
from gcode.surfaces import raster_kernels as kernels


def columns_around(
    start_mm: Float[np.ndarray, "n _a"],
    end_mm: Float[np.ndarray, "n _a"],
    margin_mm: float,
    cell_mm: float,
) -> tuple[Float[np.ndarray, " 2"], tuple[int, int]]:
    """(2,) corner and (ny, nx) of the columns that hold lines and a margin around them."""
    ends = np.concatenate([start_mm[:, :2], end_mm[:, :2]])
    low, high = ends.min(axis=0) - margin_mm, ends.max(axis=0) + margin_mm
    nx, ny = np.ceil((high - low) / cell_mm).astype(int).tolist()
    return low, (ny, nx)


def near_lines(
    start_mm: Float[np.ndarray, "n _a"],
    end_mm: Float[np.ndarray, "n _a"],
    within_mm: float | Float[np.ndarray, " n"],
    *,
    low_mm: Float[np.ndarray, " 2"],
    cell_mm: float,
    shape: tuple[int, int],
) -> Bool[np.ndarray, "ny nx"]:
    """Columns whose middles lie within some distance of lines; parameters of `heights_by_lines`."""
    none_mm = np.zeros(len(start_mm))
    heights_mm = heights_by_lines(
        start_mm, end_mm, within_mm, none_mm, low_mm=low_mm, cell_mm=cell_mm, shape=shape
    )
    return np.asarray(heights_mm > -np.inf)


def heights_by_lines(
    start_mm: Float[np.ndarray, "n _a"],
    end_mm: Float[np.ndarray, "n _a"],
    within_mm: float | Float[np.ndarray, " n"],
    height_mm: Float[np.ndarray, " n"],
    *,
    low_mm: Float[np.ndarray, " 2"],
    cell_mm: float,
    shape: tuple[int, int],
) -> Float[np.ndarray, "ny nx"]:
    """(ny, nx) greatest height of the lines that columns' middles lie near to; −inf beside them.

    Parameters
    ----------
    start_mm, end_mm
        (n, 2) or (n, 3) ends, build frame; lines are seen from above.
    within_mm
        How far each reaches aside.
    height_mm
        (n,) of each.
    low_mm
        (2,) corner of column [0, 0].
    cell_mm, shape
        Edge of a column, and how many there are: (ny, nx).
    """
    start, end = (read_only(at[:, :2], np.float64) for at in (start_mm, end_mm))
    within, height = (
        read_only(np.broadcast_to(each, len(start)), np.float64) for each in (within_mm, height_mm)
    )
    found = kernels.beside_lines(start, end, within, height, low_mm, cell_mm, *shape)
    return np.asarray(found)
