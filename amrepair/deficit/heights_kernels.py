"""Heights of a cloud by column, and points that stand out of them; compiled, for `heights`."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def cells_under(points: Any, low: Any, cell: float, ny: int, nx: int) -> Any:
    """(n,) number of the column that holds each point, by rows; −1 outside."""
    out = np.full(len(points), -1, np.int64)
    for p in range(len(points)):
        ix = int(np.floor((points[p, 0] - low[0]) / cell))
        iy = int(np.floor((points[p, 1] - low[1]) / cell))
        if 0 <= ix < nx and 0 <= iy < ny:
            out[p] = iy * nx + ix
    return out


@njit(cache=True, nogil=True)
def topmost(at: Any, points: Any, band: float, cells: int) -> Any:
    """By column: the highest point, the mean and number of those within a band of it, and of all.

    `at` (n,) are columns of points, −1 for those left out.
    """
    top = np.full(cells, -np.inf)
    for p in range(len(at)):
        if at[p] >= 0:
            top[at[p]] = max(top[at[p]], points[p, 2])
    mean = np.zeros(cells)
    count, among = np.zeros(cells, np.int64), np.zeros(cells, np.int64)
    for p in range(len(at)):
        c = at[p]
        if c >= 0:
            among[c] += 1
            if points[p, 2] >= top[c] - band:
                count[c] += 1
                mean[c] += points[p, 2]
    for c in range(cells):
        if count[c] > 0:
            mean[c] /= count[c]
    return top, mean, count, among


@njit(cache=True, nogil=True)
def standing_out(points: Any, z: Any, low: Any, cell: float, off: float) -> Any:
    """(n,) whether a point is higher than a field by more than noise, as near as noise moves it.

    Beyond the field is the bed.
    """
    out = np.zeros(len(points), np.bool_)
    ny, nx = z.shape
    for p in range(len(points)):
        least = points[p, 2] - off
        found = True
        for k in range(9):
            # its own column first: most points lie on it
            side = (k + 4) % 9
            x, y = points[p, 0] + (side // 3 - 1) * off, points[p, 1] + (side % 3 - 1) * off
            ix, iy = int(np.floor((x - low[0]) / cell)), int(np.floor((y - low[1]) / cell))
            height = z[iy, ix] if 0 <= ix < nx and 0 <= iy < ny else 0.0
            if not least > height:
                found = False
                break
        out[p] = found
    return out
