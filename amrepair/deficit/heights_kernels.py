"""Points that stand out of a field; compiled, for `heights`."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


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
