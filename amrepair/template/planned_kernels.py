# mypy: disable-error-code="no-untyped-def"
"""Beads into voxels, and a field between voxels: the loops of the planned template, compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange

FAR, FAR2 = 1e4, 1e8  # voxels, and squared: nothing is so far


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


@njit(inner=True, cache=True, nogil=True)
def _between(x, y, z, origin, voxel, field):
    """Trilinear between voxel centres; beyond the grid the way to it is added."""
    gx, gy, gz = (
        (x - origin[0]) / voxel - 0.5,
        (y - origin[1]) / voxel - 0.5,
        (z - origin[2]) / voxel - 0.5,
    )
    cx = min(max(gx, 0.0), field.shape[0] - 1 - 1e-9)
    cy = min(max(gy, 0.0), field.shape[1] - 1 - 1e-9)
    cz = min(max(gz, 0.0), field.shape[2] - 1 - 1e-9)
    i, j, k = int(cx), int(cy), int(cz)
    u, v, w = cx - i, cy - j, cz - k
    low, high = (1.0 - u) * (1.0 - v), (1.0 - u) * v
    f = low * (1.0 - w) * field[i, j, k] + low * w * field[i, j, k + 1]
    f += high * (1.0 - w) * field[i, j + 1, k]
    f += high * w * field[i, j + 1, k + 1]
    low, high = u * (1.0 - v), u * v
    f += low * (1.0 - w) * field[i + 1, j, k]
    f += low * w * field[i + 1, j, k + 1]
    f += high * (1.0 - w) * field[i + 1, j + 1, k]
    f += high * w * field[i + 1, j + 1, k + 1]
    beyond = ((gx - cx) * voxel) ** 2 + ((gy - cy) * voxel) ** 2 + ((gz - cz) * voxel) ** 2
    return f + np.sqrt(beyond)


@njit(cache=True, nogil=True, parallel=True)
def interpolate(points, origin, voxel, field):
    """(n,) of the field at points."""
    out = np.empty(len(points))
    for p in prange(len(points)):
        out[p] = _between(points[p, 0], points[p, 1], points[p, 2], origin, voxel, field)
    return out


@njit(cache=True, nogil=True, parallel=True)
def interpolate_with_gradient(points, origin, voxel, field):
    """(n,) of the field at points, and (n, 3) its central differences over a voxel."""
    out, gradient = np.empty(len(points)), np.empty((len(points), 3))
    half = 0.5 * voxel
    for p in prange(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        out[p] = _between(x, y, z, origin, voxel, field)
        ahead = _between(x + half, y, z, origin, voxel, field)
        gradient[p, 0] = (ahead - _between(x - half, y, z, origin, voxel, field)) / voxel
        ahead = _between(x, y + half, z, origin, voxel, field)
        gradient[p, 1] = (ahead - _between(x, y - half, z, origin, voxel, field)) / voxel
        ahead = _between(x, y, z + half, origin, voxel, field)
        gradient[p, 2] = (ahead - _between(x, y, z - half, origin, voxel, field)) / voxel
    return out, gradient


@njit(inner=True, cache=True, nogil=True)
def _envelope(f, n, d, v, z):
    """Squared distances along a line: the lower envelope of parabolas that stand at its places.

    Felzenszwalb and Huttenlocher 2012, algorithm 1; `d` gets min over q of (p − q)² + f(q).
    """
    k = -1
    for q in range(n):
        if f[q] >= FAR2:
            continue
        s = -np.inf
        while k >= 0:
            s = ((f[q] + q * q) - (f[v[k]] + v[k] * v[k])) / (2.0 * q - 2.0 * v[k])
            if s > z[k]:
                break
            k -= 1
        k += 1
        v[k] = q
        z[k] = s if k > 0 else -np.inf
    if k < 0:
        for q in range(n):
            d[q] = FAR2
        return
    last, k = k, 0
    for q in range(n):
        while k < last and z[k + 1] < q:
            k += 1
        d[q] = (q - v[k]) ** 2 + f[v[k]]


@njit(cache=True, nogil=True, parallel=True)
def squared_distances(solid, sought):
    """(x, y, z) squared distance of every voxel to the nearest one that is `sought`, in voxels."""
    nx, ny, nz = solid.shape
    out = np.empty((nx, ny, nz), np.float32)
    for x in prange(nx):
        here = np.empty((ny, nz))
        for y in range(ny):
            since = FAR
            for z in range(nz):
                since = 0.0 if solid[x, y, z] == sought else since + 1.0
                here[y, z] = since
            since = FAR
            for z in range(nz - 1, -1, -1):
                since = 0.0 if solid[x, y, z] == sought else since + 1.0
                here[y, z] = min(here[y, z], since, FAR) ** 2
        f, d, v, s = np.empty(ny), np.empty(ny), np.empty(ny, np.int64), np.empty(ny)
        for z in range(nz):
            for y in range(ny):
                f[y] = here[y, z]
            _envelope(f, ny, d, v, s)
            for y in range(ny):
                out[x, y, z] = d[y]
    for y in prange(ny):
        f, d, v, s = np.empty(nx), np.empty(nx), np.empty(nx, np.int64), np.empty(nx)
        here = out[:, y, :].copy()
        for z in range(nz):
            for x in range(nx):
                f[x] = here[x, z]
            _envelope(f, nx, d, v, s)
            for x in range(nx):
                here[x, z] = d[x]
        out[:, y, :] = here
    return out


@njit(cache=True, nogil=True, parallel=True)
def signed(solid, to_solid, to_empty, voxel):
    """(x, y, z) signed distances; the surface lies midway between unlike voxels."""
    nx, ny, nz = solid.shape
    out = np.empty((nx, ny, nz), np.float32)
    for x in prange(nx):
        for y in range(ny):
            for z in range(nz):
                if solid[x, y, z]:
                    out[x, y, z] = (0.5 - np.sqrt(to_empty[x, y, z])) * voxel
                else:
                    out[x, y, z] = (np.sqrt(to_solid[x, y, z]) - 0.5) * voxel
    return out


@njit(cache=True, nogil=True)
def open_faces(solid, axis, side, every, first, out):
    """Middles of every so-many-th face that is open towards one side; how many there were.

    In units of voxels, from the grid's corner; `first` of them are left out, and the lowest slice
    goes on downwards.
    """
    shape = solid.shape
    found, kept = 0, 0
    for x in range(shape[0]):
        for y in range(shape[1]):
            for z in range(shape[2]):
                if not solid[x, y, z]:
                    continue
                a = x + (side if axis == 0 else 0)
                b = y + (side if axis == 1 else 0)
                c = max(z + (side if axis == 2 else 0), 0)
                if 0 <= a < shape[0] and 0 <= b < shape[1] and c < shape[2] and solid[a, b, c]:
                    continue
                if (found + first) % every == 0:
                    if kept < len(out):
                        out[kept, 0] = x + 0.5 + (0.5 * side if axis == 0 else 0.0)
                        out[kept, 1] = y + 0.5 + (0.5 * side if axis == 1 else 0.0)
                        out[kept, 2] = z + 0.5 + (0.5 * side if axis == 2 else 0.0)
                    kept += 1
                found += 1
    return found, kept
