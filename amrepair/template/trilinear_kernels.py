# mypy: disable-error-code="no-untyped-def"
"""The fast field at points: a coarse grid, and finer blocks in the cells that need them; compiled.

Layout of the arrays is `grid.Grid`'s.
"""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange

ON_BORDER = 1e-9


@njit(cache=True, nogil=True, inline="always")
def field_at(px, py, pz, origin, cell, base, block_of, blocks):
    """Signed distance, mm, and its gradient by trilinear interpolation.

    Beyond the grid: to the surface point that is nearest to the grid's nearest point. That is the
    distance itself wherever both points have the same nearest surface point, and never less.
    """
    x, y, z = (px - origin[0]) / cell, (py - origin[1]) / cell, (pz - origin[2]) / cell
    cx = min(max(x, 0.0), base.shape[0] - 1 - ON_BORDER)
    cy = min(max(y, 0.0), base.shape[1] - 1 - ON_BORDER)
    cz = min(max(z, 0.0), base.shape[2] - 1 - ON_BORDER)
    i, j, k = int(cx), int(cy), int(cz)
    u, v, w = cx - i, cy - j, cz - k
    edge = cell
    number = block_of[i, j, k]
    if number >= 0:
        fine = blocks.shape[1] - 1
        edge = cell / fine
        q = min(int(u * fine), fine - 1)
        m = min(int(v * fine), fine - 1)
        n = min(int(w * fine), fine - 1)
        u, v, w = u * fine - q, v * fine - m, w * fine - n
        c0, c1 = blocks[number, q, m, n], blocks[number, q, m, n + 1]
        c2, c3 = blocks[number, q, m + 1, n], blocks[number, q, m + 1, n + 1]
        c4, c5 = blocks[number, q + 1, m, n], blocks[number, q + 1, m, n + 1]
        c6, c7 = blocks[number, q + 1, m + 1, n], blocks[number, q + 1, m + 1, n + 1]
    else:
        c0, c1 = base[i, j, k], base[i, j, k + 1]
        c2, c3 = base[i, j + 1, k], base[i, j + 1, k + 1]
        c4, c5 = base[i + 1, j, k], base[i + 1, j, k + 1]
        c6, c7 = base[i + 1, j + 1, k], base[i + 1, j + 1, k + 1]
    a, b = c0 * (1 - w) + c1 * w, c2 * (1 - w) + c3 * w
    c, d = c4 * (1 - w) + c5 * w, c6 * (1 - w) + c7 * w
    front, back = a * (1 - v) + b * v, c * (1 - v) + d * v
    f = front * (1 - u) + back * u
    gx = (back - front) / edge
    gy = ((b - a) * (1 - u) + (d - c) * u) / edge
    low, high = (c1 - c0) * (1 - v) + (c3 - c2) * v, (c5 - c4) * (1 - v) + (c7 - c6) * v
    gz = (low * (1 - u) + high * u) / edge
    ax, ay, az = (x - cx) * cell, (y - cy) * cell, (z - cz) * cell
    beyond = ax * ax + ay * ay + az * az
    if beyond > 0.0:
        norm = max(np.sqrt(gx * gx + gy * gy + gz * gz), 1e-12)
        ax, ay, az = ax + f * gx / norm, ay + f * gy / norm, az + f * gz / norm
        away = np.sqrt(ax * ax + ay * ay + az * az)
        f = max(away, np.sqrt(beyond))
        away = max(away, 1e-12)
        gx, gy, gz = ax / away, ay / away, az / away
    return f, gx, gy, gz


@njit(cache=True, nogil=True, parallel=True)
def evaluate(points, origin, cell, base, block_of, blocks):
    """(n,) signed distance, mm."""
    out = np.empty(len(points), np.float64)
    for p in prange(len(points)):
        out[p] = field_at(
            points[p, 0], points[p, 1], points[p, 2], origin, cell, base, block_of, blocks
        )[0]
    return out


@njit(cache=True, nogil=True, parallel=True)
def evaluate_with_gradient(points, origin, cell, base, block_of, blocks):
    """(n,) signed distance, mm, and (n, 3) its gradient within the cell."""
    out, gradient = np.empty(len(points), np.float64), np.empty((len(points), 3), np.float64)
    for p in prange(len(points)):
        out[p], gradient[p, 0], gradient[p, 1], gradient[p, 2] = field_at(
            points[p, 0], points[p, 1], points[p, 2], origin, cell, base, block_of, blocks
        )
    return out, gradient
