"""How much of a mesh lies below a height: the loop under `layers.slab_volumes`."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def volume_below(vertices: Any, faces: Any, levels: Any) -> Any:
    """Volume of a closed mesh below each of the ascending levels.

    Each face of signed horizontal area a adds −a·mean((z − z')₊) over the face; that mean is a
    cubic while z is inside the face's height range and z − centroid above it.
    """
    n = levels.shape[0]
    partial = np.zeros(n)
    area_above = np.zeros(n + 1)
    moment_above = np.zeros(n + 1)
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, z0 = vertices[a, 0], vertices[a, 1], vertices[a, 2]
        bx, by, z1 = vertices[b, 0], vertices[b, 1], vertices[b, 2]
        cx, cy, z2 = vertices[c, 0], vertices[c, 1], vertices[c, 2]
        area = 0.5 * ((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
        if area == 0.0:
            continue
        low = min(z0, z1, z2)
        high = max(z0, z1, z2)
        mean = (z0 + z1 + z2) / 3.0
        mid = 3.0 * mean - low - high
        first = np.searchsorted(levels, low)
        last = np.searchsorted(levels, high)
        for i in range(first, last):
            z = levels[i]
            if z <= mid:
                share = (z - low) ** 3 / (3.0 * (mid - low) * (high - low)) if mid > low else 0.0
            else:
                share = z - mean + (high - z) ** 3 / (3.0 * (high - low) * (high - mid))
            partial[i] -= area * share
        area_above[last] += area
        moment_above[last] += area * mean
    area = 0.0
    moment = 0.0
    out = np.empty(n)
    for i in range(n):
        area += area_above[i]
        moment += moment_above[i]
        out[i] = partial[i] - (area * levels[i] - moment)
    return out
