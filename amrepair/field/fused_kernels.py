# mypy: disable-error-code="no-untyped-def"
"""Loops over occupied cells: compiled, no policy."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange


@njit(cache=True, nogil=True, parallel=True)
def neighbour_table(keys, stride_x, stride_y):
    """(s, 27) index of the cell at each offset, −1 where it is empty.

    `keys` are sorted cell numbers ix·stride_x + iy·stride_y + iz. For one offset the sought keys
    rise with the cell, so one pointer per offset walks the list once.
    """
    n = keys.shape[0]
    table = np.full((n, 27), -1, np.int32)
    for column in prange(27):
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


@njit(cache=True, nogil=True, parallel=True)
def neighbour_sums(table, values):
    """(s, c) sums of `values` over each cell and its neighbours."""
    n, channels = table.shape[0], values.shape[1]
    out = np.zeros((n, channels))
    for i in prange(n):
        for k in range(table.shape[1]):
            j = table[i, k]
            if j >= 0:
                for c in range(channels):
                    out[i, c] += values[j, c]
    return out


@njit(cache=True, nogil=True)
def occupied(points, keep, low, cell, shape):
    """How many cells of a grid hold a kept point."""
    filled = np.zeros(shape[0] * shape[1] * shape[2], np.bool_)
    found = 0
    for i in range(len(points)):
        if keep[i]:
            x = int((points[i, 0] - low[0]) / cell)
            y = int((points[i, 1] - low[1]) / cell)
            z = int((points[i, 2] - low[2]) / cell)
            at = (x * shape[1] + y) * shape[2] + z
            if not filled[at]:
                filled[at] = True
                found += 1
    return found


@njit(cache=True, nogil=True)
def sort_by_cell(points, keep, low, cell, shape):
    """Kept points in the order of their cells, and as they came within each.

    Returns the order, where each occupied cell begins in it, their numbers in a grid of `shape`
    (one empty layer around), and the occupied cell of each point, −1 for those left out.
    """
    n = len(points)
    at = np.full(n, -1, np.int32)
    count = np.zeros(shape[0] * shape[1] * shape[2], np.int32)
    for i in range(n):
        if keep[i]:
            x = int((points[i, 0] - low[0]) / cell) + 1
            y = int((points[i, 1] - low[1]) / cell) + 1
            z = int((points[i, 2] - low[2]) / cell) + 1
            at[i] = (x * shape[1] + y) * shape[2] + z
            count[at[i]] += 1
    cells = 0
    for c in range(len(count)):
        cells += count[c] > 0
    keys = np.empty(cells, np.int64)
    start = np.zeros(cells + 1, np.int64)
    k = 0
    for c in range(len(count)):
        if count[c] > 0:
            keys[k] = c
            start[k + 1] = start[k] + count[c]
            count[c] = k  # from here on: which occupied cell it is
            k += 1
    order = np.empty(start[cells], np.int64)
    of_point = np.full(n, -1, np.int64)
    filled = start[:-1].copy()
    for i in range(n):
        if at[i] >= 0:
            k = count[at[i]]
            order[filled[k]] = i
            filled[k] += 1
            of_point[i] = k
    return order, start, keys, of_point


@njit(cache=True, nogil=True, parallel=True)
def cell_sums(order, start, points, origin, deviation):
    """(s, 11) per cell: Σx Σy Σz Σf Σxx Σyy Σzz Σxy Σxz Σyz Σff about one origin."""
    n = start.shape[0] - 1
    out = np.zeros((n, 11))
    for i in prange(n):
        for k in range(start[i], start[i + 1]):
            p = order[k]
            x, y, z = points[p, 0] - origin[0], points[p, 1] - origin[1], points[p, 2] - origin[2]
            f = deviation[p]
            out[i, 0] += x
            out[i, 1] += y
            out[i, 2] += z
            out[i, 3] += f
            out[i, 4] += x * x
            out[i, 5] += y * y
            out[i, 6] += z * z
            out[i, 7] += x * y
            out[i, 8] += x * z
            out[i, 9] += y * z
            out[i, 10] += f * f
    return out


@njit(cache=True, nogil=True)
def mean_to_sensor(which, order, start, points, sensors, index):
    """(q, 3) mean over some cells of the way from their points to the sensors that saw them."""
    out = np.zeros((len(which), 3))
    for q in range(len(which)):
        first, end = start[which[q]], start[which[q] + 1]
        for k in range(first, end):
            p = order[k]
            for a in range(3):
                out[q, a] += sensors[index[p], a] - points[p, a]
        out[q] /= end - first
    return out


@njit(cache=True, nogil=True)
def kept_box(points, keep):
    """(2, 3) box of the kept points, and how many there are."""
    out = np.empty((2, 3))
    out[0], out[1] = np.inf, -np.inf
    n = 0
    for i in range(len(points)):
        if keep[i]:
            n += 1
            for a in range(3):
                v = points[i, a]
                out[0, a] = min(out[0, a], v)
                out[1, a] = max(out[1, a], v)
    return out, n
