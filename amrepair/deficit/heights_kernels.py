"""Which points have others beside them, for `heights`; compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def in_company(asked: Any, points: Any, within: float, others: int) -> Any:
    """(k,) whether `others` more of the points lie within a distance of each that is asked about.

    `asked` (k, 3) are points themselves. Only columns as wide as the distance around them are
    filled: the rest of a large cloud is passed by.
    """
    low = np.array((asked[:, 0].min() - 2 * within, asked[:, 1].min() - 2 * within))
    nx = int((asked[:, 0].max() + 2 * within - low[0]) / within) + 1
    ny = int((asked[:, 1].max() + 2 * within - low[1]) / within) + 1
    lowest, highest = asked[:, 2].min() - within, asked[:, 2].max() + within
    wanted = np.zeros((ny, nx), np.bool_)
    for k in range(len(asked)):
        i, j = int((asked[k, 1] - low[1]) / within), int((asked[k, 0] - low[0]) / within)
        wanted[i - 1 : i + 2, j - 1 : j + 2] = True
    start = np.zeros(ny * nx + 1, np.int64)
    column = np.full(len(points), -1, np.int64)
    for p in range(len(points)):
        if points[p, 2] <= lowest or points[p, 2] >= highest:
            continue
        x, y = (points[p, 0] - low[0]) / within, (points[p, 1] - low[1]) / within
        if x < 0 or y < 0 or x >= nx or y >= ny or not wanted[int(y), int(x)]:
            continue
        column[p] = int(y) * nx + int(x)
        start[column[p] + 1] += 1
    start = np.cumsum(start)
    order, filled = np.empty(start[-1], np.int64), start[:-1].copy()
    for p in range(len(points)):
        if column[p] >= 0:
            order[filled[column[p]]] = p
            filled[column[p]] += 1
    found = np.zeros(len(asked), np.bool_)
    for k in range(len(asked)):
        i, j = int((asked[k, 1] - low[1]) / within), int((asked[k, 0] - low[0]) / within)
        count = -1  # itself
        for row in range(i - 1, i + 2):
            for p in order[start[row * nx + j - 1] : start[row * nx + j + 2]]:
                d = points[p] - asked[k]
                if d[0] * d[0] + d[1] * d[1] + d[2] * d[2] <= within * within:
                    count += 1
        found[k] = count >= others
    return found
