# mypy: disable-error-code="no-untyped-def"
"""Which points lie in beads: a loop over points that are sorted by cells, compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def held(points, order, first, corner, cell, shape, start, end, width, height):
    """(n,) whether each point lies in a bead: beside its line no farther than half its width.

    `order` has the points by cells as seen from above, x-major, and `first` where each begins.
    """
    found = np.zeros(len(points), np.bool_)
    nx, ny = shape
    for k in range(len(width)):
        x, y, half = start[k, 0], start[k, 1], 0.5 * width[k]
        dx, dy = end[k, 0] - x, end[k, 1] - y
        length2 = max(dx * dx + dy * dy, 1e-9)
        top = max(start[k, 2], end[k, 2])
        bottom = min(start[k, 2], end[k, 2]) - height[k]
        a0 = max(int(np.floor((min(x, x + dx) - half - corner[0]) / cell)), 0)
        a1 = min(int(np.floor((max(x, x + dx) + half - corner[0]) / cell)), nx - 1)
        b0 = max(int(np.floor((min(y, y + dy) - half - corner[1]) / cell)), 0)
        b1 = min(int(np.floor((max(y, y + dy) + half - corner[1]) / cell)), ny - 1)
        if b0 > b1:
            continue
        for a in range(a0, a1 + 1):
            for at in range(first[a * ny + b0], first[a * ny + b1 + 1]):
                i = order[at]
                if found[i] or not bottom <= points[i, 2] <= top:
                    continue
                u, v = points[i, 0] - x, points[i, 1] - y
                share = min(max((u * dx + v * dy) / length2, 0.0), 1.0)
                u, v = u - share * dx, v - share * dy
                found[i] = np.sqrt(u * u + v * v) <= half
    return found
