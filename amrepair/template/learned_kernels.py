# mypy: disable-error-code="no-untyped-def"
"""The learned field at points: trilinear base, hashed features, a small network; compiled.

Layout of the tables is `learned.Tables`'; the same arithmetic trains in torch (`fit`).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

PRIMES = (1, 2654435761, 805459861)  # spatial hash of Müller et al., "Instant NGP", 2022
FEATURES = 2
HIDDEN = 32


@njit(cache=True, nogil=True, inline="always")
def slot(ix, iy, iz, nx, ny, nz, size):
    """Place of a node in its level's table: dense where it fits, hashed where not."""
    if nx * ny * nz <= size:
        return (ix * ny + iy) * nz + iz
    h = np.uint64(ix) * np.uint64(1)
    h ^= np.uint64(iy) * np.uint64(2654435761)
    h ^= np.uint64(iz) * np.uint64(805459861)
    return np.int64(h & np.uint64(size - 1))


@njit(cache=True, nogil=True, parallel=True, fastmath=True)
def evaluate(
    points, origin, cell, base, active, level_cells, level_shapes, tables, w1, b1, w2, b2, w3, b3
):
    """(n,) signed distance, mm; beyond the grid the distance to its box is added."""
    n = len(points)
    out = np.empty(n, np.float64)
    levels = len(level_cells)
    for k in prange(n):
        beyond = 0.0
        u = np.empty(3)
        i = np.empty(3, np.int64)
        t = np.empty(3)
        for a in range(3):
            g = (points[k, a] - origin[a]) / cell
            top = base.shape[a] - 1
            clamped = min(max(g, 0.0), top - 1e-9)
            beyond += ((g - clamped) * cell) ** 2
            u[a] = clamped
            i[a] = int(clamped)
            t[a] = clamped - i[a]
        f = 0.0
        for c in range(8):
            dx, dy, dz = c >> 2, (c >> 1) & 1, c & 1
            weight = (
                (t[0] if dx else 1.0 - t[0])
                * (t[1] if dy else 1.0 - t[1])
                * (t[2] if dz else 1.0 - t[2])
            )
            f += weight * base[i[0] + dx, i[1] + dy, i[2] + dz]
        if active[i[0], i[1], i[2]]:
            feature = np.zeros(levels * FEATURES)
            for level in range(levels):
                ratio = cell / level_cells[level]
                j = np.empty(3, np.int64)
                s = np.empty(3)
                for a in range(3):
                    g = u[a] * ratio
                    j[a] = min(int(g), level_shapes[level, a] - 2)
                    s[a] = g - j[a]
                for c in range(8):
                    dx, dy, dz = c >> 2, (c >> 1) & 1, c & 1
                    weight = (
                        (s[0] if dx else 1.0 - s[0])
                        * (s[1] if dy else 1.0 - s[1])
                        * (s[2] if dz else 1.0 - s[2])
                    )
                    at = slot(
                        j[0] + dx,
                        j[1] + dy,
                        j[2] + dz,
                        level_shapes[level, 0],
                        level_shapes[level, 1],
                        level_shapes[level, 2],
                        tables.shape[1],
                    )
                    for q in range(FEATURES):
                        feature[level * FEATURES + q] += weight * tables[level, at, q]
            first = np.empty(HIDDEN)
            for h in range(HIDDEN):
                value = b1[h]
                for q in range(levels * FEATURES):
                    value += w1[h, q] * feature[q]
                first[h] = max(value, 0.0)
            last = b3
            for h in range(HIDDEN):
                value = b2[h]
                for q in range(HIDDEN):
                    value += w2[h, q] * first[q]
                last += w3[h] * max(value, 0.0)
            f += last * cell
        if beyond > 0.0:
            # the field at the box's face and the way there: never more than the true distance
            f = max(np.sqrt(beyond), np.sqrt(f * f + beyond) if f > 0.0 else np.sqrt(beyond))
        out[k] = f
    return out
