"""Averages along narrow strips of a surface, every way; compiled, for `strands`."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit, prange


@njit(cache=True, nogil=True, parallel=True)
def best_strips(
    places: Any,
    frame: Any,
    cells: Any,
    deviation: Any,
    count: Any,
    strip: Any,
    ways: int,
    limit: Any,
) -> Any:
    """(k,) by how much the best strip through a place is over its limit, and (k, 3) its way.

    `frame` (3, k, 3) is the way outward at each place and two across it. `strip` (long, wide,
    tall: outward) says how far a strip goes to each side of a place. Its `limit` is (systematic,
    noise, least, enough): the first and the second over the root of its points, or the third; with
    fewer points than the last it tells nothing. `cells` are of `near.cells_of`, as wide as a
    strip's corner is away; `deviation` and `count` are of all its points.
    """
    start, ordered, number, low, cell, shape = cells
    out = np.full(len(places), -np.inf)
    way = np.zeros((len(places), 3))
    for k in prange(len(places)):
        nx, ny, nz = frame[0, k, 0], frame[0, k, 1], frame[0, k, 2]
        ux, uy, uz = frame[1, k, 0], frame[1, k, 1], frame[1, k, 2]
        vx, vy, vz = frame[2, k, 0], frame[2, k, 1], frame[2, k, 2]
        total, weight = np.zeros(ways), np.zeros(ways)
        cos, sin = np.empty(ways), np.empty(ways)
        for w in range(ways):
            cos[w], sin[w] = np.cos(np.pi * w / ways), np.sin(np.pi * w / ways)
        ix = int((places[k, 0] - low[0]) / cell)
        iy = int((places[k, 1] - low[1]) / cell)
        iz = int((places[k, 2] - low[2]) / cell)
        for x in range(ix - 1, ix + 2):
            for y in range(iy - 1, iy + 2):
                first = (x * shape[1] + y) * shape[2] + iz - 1
                for p in range(start[first], start[first + 3]):
                    dx = ordered[p, 0] - places[k, 0]
                    dy = ordered[p, 1] - places[k, 1]
                    dz = ordered[p, 2] - places[k, 2]
                    if abs(dx * nx + dy * ny + dz * nz) > strip[2]:
                        continue
                    a = dx * ux + dy * uy + dz * uz
                    b = dx * vx + dy * vy + dz * vz
                    if a * a + b * b > strip[0] * strip[0]:
                        continue
                    c = count[number[p]]
                    f = deviation[number[p]] * c
                    for w in range(ways):
                        if abs(b * cos[w] - a * sin[w]) < strip[1]:
                            total[w] += f
                            weight[w] += c
        for w in range(ways):
            if weight[w] > limit[3]:
                most = max(limit[0] + limit[1] / np.sqrt(weight[w]), limit[2])
                over = total[w] / weight[w] - most
                if over > out[k]:
                    out[k] = over
                    way[k, 0] = ux * cos[w] + vx * sin[w]
                    way[k, 1] = uy * cos[w] + vy * sin[w]
                    way[k, 2] = uz * cos[w] + vz * sin[w]
    return out, way
