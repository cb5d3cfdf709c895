# mypy: disable-error-code="no-untyped-def"
"""The plane that points lie on best, from their second moments; compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True, inline="always")
def least_axis(xx, xy, xz, yy, yz, zz, out):
    """Unit eigenvector of the smallest eigenvalue of a symmetric matrix; returns that value."""
    # eigenvalues by the trigonometric formula (Smith 1961), vector by the largest cross product
    mean = (xx + yy + zz) / 3.0
    p = (xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2
    p = np.sqrt((p + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if p < 1e-30:
        out[0], out[1], out[2] = 0.0, 0.0, 1.0
        return mean
    a, b, c = (xx - mean) / p, (yy - mean) / p, (zz - mean) / p
    d, e, g = xy / p, xz / p, yz / p
    det = (a * (b * c - g * g) - d * (d * c - g * e) + e * (d * g - b * e)) / 2.0
    angle = np.arccos(min(max(det, -1.0), 1.0)) / 3.0
    least = mean + 2.0 * p * np.cos(angle + 2.0 * np.pi / 3.0)
    r0 = (xx - least, xy, xz)
    r1 = (xy, yy - least, yz)
    r2 = (xz, yz, zz - least)
    best = -1.0
    for k in range(3):
        u = r0 if k < 2 else r1
        v = r1 if k == 0 else r2
        x = u[1] * v[2] - u[2] * v[1]
        y = u[2] * v[0] - u[0] * v[2]
        z = u[0] * v[1] - u[1] * v[0]
        size = x * x + y * y + z * z
        if size > best:
            best = size
            out[0], out[1], out[2] = x, y, z
    norm = np.sqrt(max(best, 1e-300))
    for k in range(3):
        out[k] /= norm
    return least
