# mypy: disable-error-code="no-untyped-def"
"""Which places have points beside them; compiled, for `near`."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange


@njit(cache=True, nogil=True)
def by_cell(asked, points, low, cell, shape):
    """Where the points of each cell begin and the last one's end; points and numbers so ordered.

    Cells are numbered x-major in a box of `shape` cells, an empty layer about all places that are
    asked about; points in no cell of theirs, nor beside one, are left out.
    """
    start = np.zeros(shape[0] * shape[1] * shape[2] + 2, np.int32)
    own, beside = np.uint8(2), np.uint8(1)
    kind = np.zeros(len(start), np.uint8)
    for k in range(len(asked)):
        x = int((asked[k, 0] - low[0]) / cell)
        y = int((asked[k, 1] - low[1]) / cell)
        z = int((asked[k, 2] - low[2]) / cell)
        if kind[(x * shape[1] + y) * shape[2] + z] & own:
            continue
        kind[(x * shape[1] + y) * shape[2] + z] |= own
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                first = ((x + dx) * shape[1] + y + dy) * shape[2] + z - 1
                for at_z in range(first, first + 3):
                    kind[at_z] |= beside
    at = np.full(len(points), -1, np.int32)
    for i in range(len(points)):
        x = (points[i, 0] - low[0]) / cell
        y = (points[i, 1] - low[1]) / cell
        z = (points[i, 2] - low[2]) / cell
        if x >= 0 and y >= 0 and z >= 0 and x < shape[0] and y < shape[1] and z < shape[2]:
            cell_of = (int(x) * shape[1] + int(y)) * shape[2] + int(z)
            if kind[cell_of]:
                at[i] = cell_of
                start[cell_of + 1] += 1
    for c in range(1, len(start)):
        start[c] += start[c - 1]
    ordered, number = np.empty((start[-1], 3)), np.empty(start[-1], np.int32)
    for i in range(len(points) - 1, -1, -1):
        if at[i] >= 0:
            start[at[i] + 1] -= 1
            number[start[at[i] + 1]] = i
            for a in range(3):
                ordered[start[at[i] + 1], a] = points[i, a]
    return start[1:], ordered, number


@njit(cache=True, nogil=True, parallel=True)
def beside(asked, start, ordered, number, low, cell, shape, within, enough):
    """(k,) number of the point nearest to each place, −1 where none is within a distance.

    And (k,) how many are; no more are looked at than are `enough`. The distance is at most a
    cell's edge; `start`, `ordered` and `number` are of `by_cell`.
    """
    nearest, count = np.empty(len(asked), np.int32), np.zeros(len(asked), np.int32)
    for k in prange(len(asked)):
        ix = int((asked[k, 0] - low[0]) / cell)
        iy = int((asked[k, 1] - low[1]) / cell)
        iz = int((asked[k, 2] - low[2]) / cell)
        best, least = -1, np.inf
        for line in range(9):  # cells one above the other: their points lie one after the other
            x, y = ix - 1 + line // 3, iy - 1 + line % 3
            first = (x * shape[1] + y) * shape[2] + iz - 1
            for p in range(start[first], start[first + 3]):
                apart = 0.0
                for a in range(3):
                    apart += (ordered[p, a] - asked[k, a]) ** 2
                if apart > within * within:
                    continue
                count[k] += 1
                if apart < least:
                    best, least = number[p], apart
                if count[k] >= enough:
                    break
            if count[k] >= enough:
                break
        nearest[k] = best
    return nearest, count
