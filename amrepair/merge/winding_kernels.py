# mypy: disable-error-code="no-untyped-def"
"""Winding numbers of oriented points over an octree of dipoles; compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange


@njit(cache=True, nogil=True)
def joined(first, end, place, weight, vector, radius):
    """Nodes over those from `first` to `end`: weights, centres, vector areas and radii."""
    n = len(first)
    w, far = np.zeros(n), np.zeros(n)
    centre, total = np.zeros((n, 3)), np.zeros((n, 3))
    for k in range(n):
        for i in range(first[k], end[k]):
            w[k] += weight[i]
            for a in range(3):
                centre[k, a] += weight[i] * place[i, a]
                total[k, a] += vector[i, a]
        for a in range(3):
            centre[k, a] /= w[k]
        for i in range(first[k], end[k]):
            x, y, z = (
                place[i, 0] - centre[k, 0],
                place[i, 1] - centre[k, 1],
                place[i, 2] - centre[k, 2],
            )
            far[k] = max(far[k], np.sqrt(x * x + y * y + z * z) + radius[i])
    return w, centre, total, far


@njit(cache=True, nogil=True, parallel=True)
def windings(queries, place, vector, soft2, child_start, centre, total, radius, root, leaf, beta):
    """(q,) winding numbers: far nodes as one dipole, near leaves point by point.

    Nodes of all levels lie in one list, leaves' children are sources; `leaf` says which are leaves.
    `soft2` (n,) is added to squared distances: a source is a patch, not a point.
    """
    out = np.empty(len(queries))
    for q in prange(len(queries)):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        stack = np.empty(512, np.int64)
        top = 0
        for r in range(root[0], root[1]):  # the coarsest level has at most eight nodes
            stack[top] = r
            top += 1
        w = 0.0
        while top > 0:
            top -= 1
            node = stack[top]
            dx, dy, dz = centre[node, 0] - x, centre[node, 1] - y, centre[node, 2] - z
            d2 = dx * dx + dy * dy + dz * dz
            if d2 > (beta * radius[node]) ** 2:
                w += (total[node, 0] * dx + total[node, 1] * dy + total[node, 2] * dz) / (
                    d2 * np.sqrt(d2)
                )
            elif leaf[node]:
                for i in range(child_start[node, 0], child_start[node, 1]):
                    ex, ey, ez = place[i, 0] - x, place[i, 1] - y, place[i, 2] - z
                    e2 = ex * ex + ey * ey + ez * ez + soft2[i]
                    w += (vector[i, 0] * ex + vector[i, 1] * ey + vector[i, 2] * ez) / (
                        e2 * np.sqrt(e2)
                    )
            else:
                for i in range(child_start[node, 0], child_start[node, 1]):
                    stack[top] = i
                    top += 1
        out[q] = w / (4 * np.pi)
    return out
