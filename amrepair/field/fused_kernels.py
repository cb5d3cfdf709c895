# mypy: disable-error-code="no-untyped-def"
"""Loops over occupied cells: compiled, no policy."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def neighbour_table(keys, stride_x, stride_y):
    """(s, 27) index of the cell at each offset, −1 where it is empty.

    `keys` are sorted cell numbers ix·stride_x + iy·stride_y + iz. For one offset the sought keys
    rise with the cell, so one pointer per offset walks the list once.
    """
    n = keys.shape[0]
    table = np.full((n, 27), -1, np.int32)
    for column in range(27):
        dx, dy, dz = column // 9 - 1, column // 3 % 3 - 1, column % 3 - 1
        offset = dx * stride_x + dy * stride_y + dz
        j = 0
        for i in range(n):
            want = keys[i] + offset
            while j < n and keys[j] < want:
                j += 1
            if j == n:
                break
            if keys[j] == want:
                table[i, column] = j
    return table


@njit(cache=True, nogil=True)
def neighbour_sums(table, values):
    """(s, c) sums of `values` over each cell and its neighbours."""
    n, channels = table.shape[0], values.shape[1]
    out = np.zeros((n, channels))
    for i in range(n):
        for k in range(table.shape[1]):
            j = table[i, k]
            if j >= 0:
                for c in range(channels):
                    out[i, c] += values[j, c]
    return out


@njit(cache=True, nogil=True)
def numbered(points, keep, low, cell, shape):
    """(n,) which occupied cell each kept point lies in, −1 for the others; (s,) keys of those.

    Cells are numbered x-major in a grid of `shape` cells, one empty layer around.
    """
    at = np.full(len(points), -1, np.int64)
    number = np.zeros(shape[0] * shape[1] * shape[2], np.int32)
    for i in range(len(points)):
        if keep[i]:
            x = int((points[i, 0] - low[0]) / cell) + 1
            y = int((points[i, 1] - low[1]) / cell) + 1
            z = int((points[i, 2] - low[2]) / cell) + 1
            at[i] = (x * shape[1] + y) * shape[2] + z
            number[at[i]] = 1
    keys = np.flatnonzero(number)
    for k in range(len(keys)):
        number[keys[k]] = k
    for i in range(len(points)):
        if at[i] >= 0:
            at[i] = number[at[i]]
    return at, keys


@njit(cache=True, nogil=True)
def cell_sums(of_point, points, origin, deviation, cells):
    """(s, 12) per cell: Σx Σy Σz Σf Σxx Σyy Σzz Σxy Σxz Σyz Σff about one origin, and points."""
    out = np.zeros((cells, 12))
    for p in range(len(of_point)):
        i = of_point[p]
        if i < 0:
            continue
        x, y, z = points[p, 0] - origin[0], points[p, 1] - origin[1], points[p, 2] - origin[2]
        f = deviation[p]
        told = (x, y, z, f, x * x, y * y, z * z, x * y, x * z, y * z, f * f, 1.0)
        for c in range(12):
            out[i, c] += told[c]
    return out


@njit(cache=True, nogil=True)
def sensor_sums(of_point, index, sensors, cells):
    """(s, 3) sum over each cell's points of the place of what saw them."""
    out = np.zeros((cells, 3))
    for p in range(len(of_point)):
        if of_point[p] >= 0:
            for a in range(3):
                out[of_point[p], a] += sensors[index[p], a]
    return out


@njit(cache=True, nogil=True)
def sums_by_view(of_point, view, deviation, cells, views):
    """(s, v) how many of a cell's points each view saw, and their summed deviation."""
    count, total = np.zeros((cells, views), np.int64), np.zeros((cells, views))
    for p in range(len(of_point)):
        if of_point[p] >= 0:
            count[of_point[p], view[p]] += 1
            total[of_point[p], view[p]] += deviation[p]
    return count, total
