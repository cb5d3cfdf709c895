# mypy: disable-error-code="no-untyped-def"
"""A step of a pose: six equations solved, a rotation turned further; compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit


@njit(inner=True, cache=True, nogil=True)
def solve(h, b):
    """Solve a symmetric positive system of six by Cholesky, in place."""
    for i in range(6):
        for j in range(i + 1):
            total = h[i, j]
            for k in range(j):
                total -= h[i, k] * h[j, k]
            if i == j:
                h[i, i] = np.sqrt(max(total, 1e-30))
            else:
                h[i, j] = total / h[j, j]
    for i in range(6):
        for k in range(i):
            b[i] -= h[i, k] * b[k]
        b[i] /= h[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            b[i] -= h[k, i] * b[k]
        b[i] /= h[i, i]


@njit(inner=True, cache=True, nogil=True)
def turn(r, x, y, z):
    """Turn a rotation further by an axis-angle vector, in place (Rodrigues)."""
    angle = np.sqrt(x * x + y * y + z * z)
    if angle < 1e-12:
        return
    x, y, z = x / angle, y / angle, z / angle
    s, c = np.sin(angle), 1.0 - np.cos(angle)
    for column in range(3):
        a, b, d = r[0, column], r[1, column], r[2, column]
        ca, cb, cd = y * d - z * b, z * a - x * d, x * b - y * a
        r[0, column] = a + s * ca + c * (y * cd - z * cb)
        r[1, column] = b + s * cb + c * (z * ca - x * cd)
        r[2, column] = d + s * cd + c * (x * cb - y * ca)


@njit(inner=True, cache=True, nogil=True)
def step_down(r, p, h, b, damping, least, widest, reach):
    """One damped Gauss–Newton step of a pose, in place; `h` and `b` are used up.

    It turns by at most `widest` rad, and shifts by no more than that moves what lies `reach` off.
    """
    turning = (h[0, 0] + h[1, 1] + h[2, 2]) / 3.0
    moving = (h[3, 3] + h[4, 4] + h[5, 5]) / 3.0
    for m in range(3):
        h[m, m] += damping * turning + least
        h[m + 3, m + 3] += damping * moving + least
    solve(h, b)
    angle = np.sqrt(b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
    shift = np.sqrt(b[3] ** 2 + b[4] ** 2 + b[5] ** 2)
    share = min(1.0, widest / max(angle, 1e-12))
    share = min(share, widest * reach / max(shift, 1e-12))
    turn(r, share * b[0], share * b[1], share * b[2])
    for m in range(3):
        p[m] += share * b[3 + m]
