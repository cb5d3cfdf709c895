# mypy: disable-error-code="no-untyped-def"
"""Beads into voxels, and a field between voxels: the loops of the planned template, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(cache=True, nogil=True)
def fill(start, end, width, height, origin, voxel, solid):
    """Mark the voxels whose centres lie in a bead: a slab with round ends, hanging at its z."""
    nx, ny, nz = solid.shape
    for k in range(len(width)):
        half = 0.5 * width[k] + 0.1 * voxel  # neighbours touch: no hairline between them
        x0, y0, x1, y1 = start[k, 0], start[k, 1], end[k, 0], end[k, 1]
        top = 0.5 * (start[k, 2] + end[k, 2])
        low = int(np.ceil((top - height[k] - origin[2]) / voxel - 0.5 - 1e-6))
        high = int(np.floor((top - origin[2]) / voxel - 0.5 + 1e-6))
        low, high = max(low, 0), min(high, nz - 1)
        if low > high:
            continue
        dx, dy = x1 - x0, y1 - y0
        length2 = dx * dx + dy * dy
        ix0 = max(0, int((min(x0, x1) - half - origin[0]) / voxel))
        ix1 = min(nx - 1, int((max(x0, x1) + half - origin[0]) / voxel) + 1)
        iy0 = max(0, int((min(y0, y1) - half - origin[1]) / voxel))
        iy1 = min(ny - 1, int((max(y0, y1) + half - origin[1]) / voxel) + 1)
        for ix in range(ix0, ix1 + 1):
            px = origin[0] + (ix + 0.5) * voxel - x0
            for iy in range(iy0, iy1 + 1):
                py = origin[1] + (iy + 0.5) * voxel - y0
                t = 0.0
                if length2 > 0.0:
                    t = min(1.0, max(0.0, (px * dx + py * dy) / length2))
                ax, ay = px - t * dx, py - t * dy
                if ax * ax + ay * ay <= half * half:
                    for iz in range(low, high + 1):
                        solid[ix, iy, iz] = True


@njit(cache=True, nogil=True, parallel=True)
def interpolate(points, origin, voxel, field):
    """(n,) trilinear between voxel centres; beyond the grid the way to it is added."""
    out = np.empty(len(points))
    shape = np.array(field.shape)
    for k in prange(len(points)):
        i = np.empty(3, np.int64)
        t = np.empty(3)
        beyond = 0.0
        for a in range(3):
            g = (points[k, a] - origin[a]) / voxel - 0.5
            clamped = min(max(g, 0.0), shape[a] - 1 - 1e-9)
            beyond += ((g - clamped) * voxel) ** 2
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
            if weight > 0.0:
                f += weight * field[i[0] + dx, i[1] + dy, i[2] + dz]
        out[k] = f + np.sqrt(beyond)
    return out
