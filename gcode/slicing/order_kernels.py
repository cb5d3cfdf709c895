"""Where loops begin, and which bead is the next; compiled, for `order` and `beads`."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def seam_at(loop: Any, x: float, y: float, sharp: float, inward_mm: float, other_mm: float) -> int:
    """Vertex of an open-ended loop that is nearest to a place, corners worth some millimetres."""
    n = len(loop)
    best, found = np.inf, 0
    for k in range(n):
        before, after = loop[k - 1 if k else n - 1], loop[k + 1 if k + 1 < n else 0]
        ux, uy = loop[k, 0] - before[0], loop[k, 1] - before[1]
        vx, vy = after[0] - loop[k, 0], after[1] - loop[k, 1]
        turn = np.arctan2(ux * vy - uy * vx, ux * vx + uy * vy)
        cost = np.hypot(loop[k, 0] - x, loop[k, 1] - y)
        if turn < -sharp:
            cost -= inward_mm
        elif turn > sharp:
            cost -= other_mm
        if cost < best:
            best, found = cost, k
    return found


@njit(cache=True, nogil=True)
def nearest_next(heads: Any, tails: Any, closed: Any, x: float, y: float) -> tuple[Any, Any]:
    """(n,) beads in the order in which the next one has the nearest end, and which go backwards."""
    n = len(heads)
    order, backward = np.empty(n, np.int64), np.zeros(n, np.bool_)
    left = np.ones(n, np.bool_)
    for place in range(n):
        best, found, turned = np.inf, -1, False
        for k in range(n):
            if not left[k]:
                continue
            to_head = (heads[k, 0] - x) ** 2 + (heads[k, 1] - y) ** 2
            to_tail = (tails[k, 0] - x) ** 2 + (tails[k, 1] - y) ** 2
            if min(to_head, to_tail) < best:
                best, found = min(to_head, to_tail), k
                turned = to_tail < to_head and not closed[k]
        order[place], backward[place] = found, turned
        left[found] = False
        end = heads[found] if turned else tails[found]
        x, y = end[0], end[1]
    return order, backward


@njit(cache=True, nogil=True)
def area_along(xy: Any, share: Any) -> float:
    """Length of each piece of a line times its share, summed."""
    total = 0.0
    for k in range(len(share)):
        total += np.hypot(xy[k + 1, 0] - xy[k, 0], xy[k + 1, 1] - xy[k, 1]) * share[k]
    return total
