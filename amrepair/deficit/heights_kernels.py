# mypy: disable-error-code="no-untyped-def"
"""A scan's points over the columns of a height field, one walk over all of them; for `heights`."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def columns(points, corner, cell, ny, nx):
    """(n,) number of the column that holds each point, row by row; −1 outside."""
    found = np.full(len(points), -1, np.int32)
    for i in range(len(points)):
        x = np.floor((points[i, 0] - corner[0]) / cell)
        y = np.floor((points[i, 1] - corner[1]) / cell)
        if 0 <= x < nx and 0 <= y < ny:
            found[i] = int(y) * nx + int(x)
    return found


@njit(cache=True, nogil=True)
def topmost(column, points, below, band):
    """Of each column's points under `below` (c,): the highest, the mean and number of those within
    a band of it, and how many there are.
    """
    top, mean = np.full(len(below), -np.inf), np.zeros(len(below))
    count, among = np.zeros(len(below), np.int64), np.zeros(len(below), np.int64)
    for i in range(len(points)):
        c, z = column[i], points[i, 2]
        if c >= 0 and z < below[c]:
            top[c] = max(top[c], z)
            among[c] += 1
    for i in range(len(points)):
        c, z = column[i], points[i, 2]
        if c >= 0 and z < below[c] and z >= top[c] - band:
            mean[c] += z
            count[c] += 1
    for c in range(len(below)):
        mean[c] /= max(count[c], 1)
    return top, mean, count, among


@njit(cache=True, nogil=True)
def unexplained(points, down, steps, corner, cell, z):
    """(n,) whether a point, so much lower, is over the field at each of these steps aside."""
    ny, nx = z.shape
    found = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        out = True
        for k in range(len(steps)):
            x = np.floor((points[i, 0] + steps[k, 0] - corner[0]) / cell)
            y = np.floor((points[i, 1] + steps[k, 1] - corner[1]) / cell)
            inside = 0 <= x < nx and 0 <= y < ny
            if not points[i, 2] - down > (z[int(y), int(x)] if inside else 0.0):
                out = False
                break
        found[i] = out
    return found
