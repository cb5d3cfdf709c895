# mypy: disable-error-code="no-untyped-def"
"""The tool head swept along moves over a height field that grows by what is laid; compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit
from gcode.surfaces.standing_kernels import across_row, columns_of, height_over, rows_of


@njit(cache=True, nogil=True)
def sweep(
    start, end, laid, half_width, field, origin, cell, above, owner, need, which, rows, row_at
):
    """Worst contact of every move.

    Parameters: (n, 3) start and end, (n,) 1 where plastic is laid and its half width; the field
    (ny, nx) of what stands there, which is raised; (s,) by how much what stands under a slice of
    the head may stand above the tip, and whose slice it is; (ny, nx) how high the tip must at
    least be and whose fault that is, both of which are raised; footprint rows (dy, low, high) of
    each slice at row_at[s]:row_at[s+1].
    Returns (n,) depth of the worst contact (≤ 0: none), and whose it is.
    """
    n = len(laid)
    ny, nx = field.shape
    worst = np.full(n, -np.inf)
    whose = np.zeros(n, np.int64)
    step = 0.5 * cell
    # what is laid can only be hit by a slice that comes below it afterwards
    later = np.empty(n + 1)
    later[n] = np.inf
    for k in range(n - 1, -1, -1):
        later[k] = min(later[k + 1], start[k, 2], end[k, 2])
    for k in range(n):
        dx, dy, dz = end[k, 0] - start[k, 0], end[k, 1] - start[k, 1], end[k, 2] - start[k, 2]
        count = max(1, int(np.ceil(np.hypot(dx, dy) / step)))
        for i in range(count + 1):
            t = i / count
            x, y, z = start[k, 0] + dx * t, start[k, 1] + dy * t, start[k, 2] + dz * t
            ix = int(np.floor((x - origin[0]) / cell))
            iy = int(np.floor((y - origin[1]) / cell))
            if ix < 0 or iy < 0 or ix >= nx or iy >= ny:
                continue
            if need[iy, ix] - z > worst[k]:
                worst[k] = need[iy, ix] - z
                whose[k] = which[iy, ix]
        if laid[k] <= 0:
            continue
        # what is laid now stands there from now on
        ax, ay, az = start[k, 0], start[k, 1], start[k, 2]
        bx, by, bz = end[k, 0], end[k, 1], end[k, 2]
        half = half_width[k]
        first, last = rows_of(ay, by, half, origin[1], cell, ny)
        for iy in range(first, last):
            py = origin[1] + (iy + 0.5) * cell
            x_low, x_high = across_row(ax, ay, bx, by, half, py)
            for ix in range(*columns_of(x_low, x_high, origin[0], cell, nx)):
                px = origin[0] + (ix + 0.5) * cell
                z = height_over(ax, ay, az, bx, by, bz, half, px, py)
                if field[iy, ix] < z:
                    field[iy, ix] = z
                    raise_need(need, which, rows, row_at, iy, ix, z, above, owner, later[k])
    return worst, whose


@njit(inner=True, cache=True, nogil=True)
def raise_need(need, which, rows, row_at, iy, ix, z, above, owner, later):
    """Every place of the head that covers this column sees the new height."""
    ny, nx = need.shape
    for s in range(len(above)):
        least = z - above[s]
        if least <= later:
            continue
        for r in range(row_at[s], row_at[s + 1]):
            row = iy - rows[r, 0]
            if row < 0 or row >= ny:
                continue
            first = max(0, ix - rows[r, 2])
            last = min(nx - 1, ix - rows[r, 1])
            for column in range(first, last + 1):
                if least > need[row, column]:
                    need[row, column] = least
                    which[row, column] = owner[s]
