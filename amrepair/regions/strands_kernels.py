# mypy: disable-error-code="no-untyped-def"
"""Means along strips about places, in all ways over a surface; compiled, for `strands`."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def on_strips(place, frames, turn, cells, count, deviation, maybe, sides, limits):
    """(n,) those in `maybe` that lie on the strip about a place that stands out most, if it does.

    `frames` are unit vectors off the surface and two along it, `turn` (w, 2) the cosine and sine of
    each way between these; `cells` is of `near.cells_about`, `sides` half of a strip's length,
    width and height. `limits` are how many points are enough, then those of the mean: what
    averaging does not remove, what it does, for one point, and the least.
    """
    up, one, other = frames
    start, ordered, number, corner, cell, shape = cells
    long, wide, tall = sides
    enough, systematic, noise, least = limits
    on = np.zeros(len(count), np.bool_)
    ways = len(turn)
    seen, total = np.empty(ways), np.empty(ways)
    mine, a, b = np.empty(0, np.int32), np.empty(0), np.empty(0)
    for k in range(len(place)):
        ix = int((place[k, 0] - corner[0]) / cell)
        iy = int((place[k, 1] - corner[1]) / cell)
        iz = int((place[k, 2] - corner[2]) / cell)
        n = 0
        for line in range(9):
            x, y = ix - 1 + line // 3, iy - 1 + line % 3
            first = (x * shape[1] + y) * shape[2] + iz - 1
            last = start[first + 3]
            if n + last - start[first] > len(mine):
                most = 2 * (n + last - start[first])
                more, more_a, more_b = np.empty(most, np.int32), np.empty(most), np.empty(most)
                more[:n], more_a[:n], more_b[:n] = mine[:n], a[:n], b[:n]
                mine, a, b = more, more_a, more_b
            for p in range(start[first], last):
                dx = ordered[p, 0] - place[k, 0]
                dy = ordered[p, 1] - place[k, 1]
                dz = ordered[p, 2] - place[k, 2]
                if abs(dx * up[k, 0] + dy * up[k, 1] + dz * up[k, 2]) > tall:
                    continue
                a[n] = dx * one[k, 0] + dy * one[k, 1] + dz * one[k, 2]
                b[n] = dx * other[k, 0] + dy * other[k, 1] + dz * other[k, 2]
                if a[n] * a[n] + b[n] * b[n] <= long * long:
                    mine[n] = number[p]
                    n += 1
        seen[:], total[:] = 0.0, 0.0
        for j in range(n):
            points = count[mine[j]]
            for w in range(ways):
                if abs(b[j] * turn[w, 0] - a[j] * turn[w, 1]) < wide:
                    seen[w] += points
                    total[w] += points * deviation[mine[j]]
        best, over = -1, 0.0
        for w in range(ways):
            if seen[w] > enough:  # of too few the mean says nothing
                limit = max(systematic + noise / np.sqrt(seen[w]), least)
                if total[w] / seen[w] - limit > over:
                    best, over = w, total[w] / seen[w] - limit
        if best >= 0:
            for j in range(n):
                if abs(b[j] * turn[best, 0] - a[j] * turn[best, 1]) < wide and maybe[mine[j]]:
                    on[mine[j]] = True
    return on
