# mypy: disable-error-code="no-untyped-def"
"""The fast field at points: a coarse grid, and finer blocks in the cells that need them; compiled.

Layout of the arrays is `learned.Grid`'s.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(cache=True, nogil=True, parallel=True)
def evaluate(points, origin, cell, base, block_of, blocks):
    """(n,) signed distance, mm, by trilinear interpolation.

    Beyond the grid: to the surface point that is nearest to the grid's nearest point. That is the
    distance itself wherever both points have the same nearest surface point, and never less.
    """
    n = len(points)
    out = np.empty(n, np.float64)
    fine = blocks.shape[1] - 1
    for k in prange(n):
        away = np.empty(3)
        i = np.empty(3, np.int64)
        t = np.empty(3)
        beyond = 0.0
        for a in range(3):
            g = (points[k, a] - origin[a]) / cell
            clamped = min(max(g, 0.0), base.shape[a] - 1 - 1e-9)
            away[a] = (g - clamped) * cell
            beyond += away[a] * away[a]
            i[a] = int(clamped)
            t[a] = clamped - i[a]
        number = block_of[i[0], i[1], i[2]]
        c = np.empty(8)
        if number >= 0:
            j0 = min(int(t[0] * fine), fine - 1)
            j1 = min(int(t[1] * fine), fine - 1)
            j2 = min(int(t[2] * fine), fine - 1)
            t[0] = t[0] * fine - j0
            t[1] = t[1] * fine - j1
            t[2] = t[2] * fine - j2
            for d in range(8):
                c[d] = blocks[number, j0 + (d >> 2), j1 + ((d >> 1) & 1), j2 + (d & 1)]
        else:
            for d in range(8):
                c[d] = base[i[0] + (d >> 2), i[1] + ((d >> 1) & 1), i[2] + (d & 1)]
        x, y, z = t[0], t[1], t[2]
        front = (c[0] * (1 - z) + c[1] * z) * (1 - y) + (c[2] * (1 - z) + c[3] * z) * y
        back = (c[4] * (1 - z) + c[5] * z) * (1 - y) + (c[6] * (1 - z) + c[7] * z) * y
        f = front * (1 - x) + back * x
        if beyond > 0.0:
            gx = back - front
            low = (c[0] * (1 - z) + c[1] * z) * (1 - x) + (c[4] * (1 - z) + c[5] * z) * x
            high = (c[2] * (1 - z) + c[3] * z) * (1 - x) + (c[6] * (1 - z) + c[7] * z) * x
            gy = high - low
            low = (c[0] * (1 - y) + c[2] * y) * (1 - x) + (c[4] * (1 - y) + c[6] * y) * x
            high = (c[1] * (1 - y) + c[3] * y) * (1 - x) + (c[5] * (1 - y) + c[7] * y) * x
            gz = high - low
            norm = max(np.sqrt(gx * gx + gy * gy + gz * gz), 1e-12)
            ax = away[0] + f * gx / norm
            ay = away[1] + f * gy / norm
            az = away[2] + f * gz / norm
            f = max(np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(beyond))
        out[k] = f
    return out
