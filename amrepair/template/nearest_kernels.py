# mypy: disable-error-code="no-untyped-def"
"""A tree of boxes over triangles, and the nearest point on them; compiled.

References
----------
C. Ericson, Real-Time Collision Detection, 2005, section 5.1.5 (nearest point of a triangle).
"""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange

LEAF = 4  # triangles
DEEP = 64  # of the stack: halves of any mesh that fits into memory
TINY_AREA = 1e-300  # of triangles without area
WITHIN, UPRIGHT_TRIANGLE = 1e-6, 0.99  # of a triangle's weights; the cosine from its normal
PLANE_SLACK_MM = 1e-6  # of a distance to a plane, and more
TOGETHER = 256  # points by one thread; each starts from the triangle of the one before


@njit(cache=True, nogil=True)
def build(corners):
    """Order of the triangles, and the nodes: boxes, first child, first and last triangle."""
    n = len(corners)
    centre = np.empty((n, 3))
    for i in range(n):
        for a in range(3):
            centre[i, a] = (corners[i, 0, a] + corners[i, 1, a] + corners[i, 2, a]) / 3.0
    order = np.arange(n)
    most = max(1, 2 * n)
    low, high = np.empty((most, 3)), np.empty((most, 3))
    child = np.full(most, -1, np.int64)
    first, last = np.zeros(most, np.int64), np.zeros(most, np.int64)
    last[0] = n
    count, k = 1, 0
    while k < count:
        middle_low, middle_high = np.full(3, np.inf), np.full(3, -np.inf)
        low[k, :], high[k, :] = np.inf, -np.inf
        for i in order[first[k] : last[k]]:
            for a in range(3):
                for c in range(3):
                    low[k, a] = min(low[k, a], corners[i, c, a])
                    high[k, a] = max(high[k, a], corners[i, c, a])
                middle_low[a] = min(middle_low[a], centre[i, a])
                middle_high[a] = max(middle_high[a], centre[i, a])
        if last[k] - first[k] > LEAF:
            axis = np.argmax(middle_high - middle_low)
            mine = order[first[k] : last[k]].copy()
            order[first[k] : last[k]] = mine[np.argsort(centre[mine, axis])]
            half = (first[k] + last[k]) // 2
            child[k] = count
            first[count], last[count] = first[k], half
            first[count + 1], last[count + 1] = half, last[k]
            count += 2
        k += 1
    return order, low[:count], high[:count], child[:count], first[:count], last[:count]


@njit(cache=True, nogil=True, inline="always")
def _box2(x, y, z, low, high, k):
    """Squared distance to a node's box."""
    dx = max(low[k, 0] - x, 0.0, x - high[k, 0])
    dy = max(low[k, 1] - y, 0.0, y - high[k, 1])
    dz = max(low[k, 2] - z, 0.0, z - high[k, 2])
    return dx * dx + dy * dy + dz * dz


@njit(inner=True, cache=True, nogil=True)
def _on_triangle(px, py, pz, t):
    """Squared distance to a triangle (3, 3), and the weights of its second and third corner."""
    ux, uy, uz = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    vx, vy, vz = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
    ax, ay, az = px - t[0, 0], py - t[0, 1], pz - t[0, 2]
    bx, by, bz = px - t[1, 0], py - t[1, 1], pz - t[1, 2]
    cx, cy, cz = px - t[2, 0], py - t[2, 1], pz - t[2, 2]
    d1, d2 = ux * ax + uy * ay + uz * az, vx * ax + vy * ay + vz * az
    d3, d4 = ux * bx + uy * by + uz * bz, vx * bx + vy * by + vz * bz
    d5, d6 = ux * cx + uy * cy + uz * cz, vx * cx + vy * cy + vz * cz
    s = w = 0.0
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        pass
    elif d3 >= 0.0 and d4 <= d3:
        s = 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s = d1 / max(d1 - d3, TINY_AREA)
    elif d6 >= 0.0 and d5 <= d6:
        w = 1.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / max(d2 - d6, TINY_AREA)
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / max((d4 - d3) + (d5 - d6), TINY_AREA)
        s = 1.0 - w
    else:
        total = max(va + vb + vc, TINY_AREA)
        s, w = vb / total, vc / total
    dx = ax - s * ux - w * vx
    dy = ay - s * uy - w * vy
    dz = az - s * uz - w * vz
    return dx * dx + dy * dy + dz * dz, s, w


@njit(inner=True, cache=True, nogil=True)
def _above(x, y, z, t, size):
    """1 before a triangle, −1 behind it, 0 where its normal is no normal of the nearest point."""
    ux, uy, uz = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    vx, vy, vz = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    long = np.sqrt(nx * nx + ny * ny + nz * nz)
    high = nx * (x - t[0, 0]) + ny * (y - t[0, 1]) + nz * (z - t[0, 2])
    if abs(high) < UPRIGHT_TRIANGLE * size * long:
        return 0
    return 1 if high > 0.0 else -1


@njit(cache=True, nogil=True, inline="always")
def _plane2(x, y, z, upright, t):
    """Squared distance to a triangle's plane, which none of its points is nearer than."""
    high = upright[0] * (x - t[0, 0]) + upright[1] * (y - t[0, 1]) + upright[2] * (z - t[0, 2])
    far = max(abs(high) - PLANE_SLACK_MM, 0.0)
    return far * far


@njit(cache=True, nogil=True, parallel=True)
def nearest(points, sure, upright, corners, low, high, child, first, last):
    """(n,) distance, (n,) number of the nearest triangle in the tree's order, (n, 3) its point.

    And (n,) −1 inside, 1 outside where that point is within the triangle; 0 on an edge or a corner.
    """
    n = len(points)
    size, which, place = np.empty(n), np.zeros(n, np.int64), np.empty((n, 3))
    side = np.zeros(n, np.int8)
    for part in prange((n + TOGETHER - 1) // TOGETHER):
        stack, far2 = np.empty(DEEP, np.int64), np.empty(DEEP)
        best = 0
        for i in range(part * TOGETHER, min(n, (part + 1) * TOGETHER)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            best2, s, w = _on_triangle(x, y, z, corners[best])
            stack[0], far2[0], top = 0, _box2(x, y, z, low, high, 0), 1
            while top > 0:
                top -= 1
                if far2[top] >= best2:
                    continue
                k = stack[top]
                if child[k] < 0:
                    for t in range(first[k], last[k]):
                        if _plane2(x, y, z, upright[t], corners[t]) >= best2:
                            continue
                        here2, a, b = _on_triangle(x, y, z, corners[t])
                        if here2 < best2:
                            best2, best, s, w = here2, t, a, b
                    continue
                one, other = child[k], child[k] + 1
                one2 = _box2(x, y, z, low, high, one)
                other2 = _box2(x, y, z, low, high, other)
                if one2 < other2:  # the nearer one on top
                    one, other, one2, other2 = other, one, other2, one2
                stack[top], far2[top] = one, one2
                stack[top + 1], far2[top + 1] = other, other2
                top += 2
            size[i], which[i] = np.sqrt(best2), best
            t = corners[best]
            for a in range(3):
                place[i, a] = t[0, a] + s * (t[1, a] - t[0, a]) + w * (t[2, a] - t[0, a])
            if sure[best] and s > WITHIN and w > WITHIN and s + w < 1.0 - WITHIN:
                side[i] = _above(x, y, z, t, size[i])
    return size, which, place, side


@njit(cache=True, nogil=True, inline="always")
def _ray_meets_box(start, one_over, low, high, k):
    """Whether a ray passes a node's box."""
    near, far = 0.0, np.inf
    for a in range(3):
        one = (low[k, a] - start[a]) * one_over[a]
        other = (high[k, a] - start[a]) * one_over[a]
        near = max(near, min(one, other))
        far = min(far, max(one, other))
    return near <= far


@njit(inner=True, cache=True, nogil=True)
def _ray_meets_triangle(start, way, t):
    """Whether a ray passes through a triangle (Möller and Trumbore 1997)."""
    ux, uy, uz = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    vx, vy, vz = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
    px = way[1] * vz - way[2] * vy
    py = way[2] * vx - way[0] * vz
    pz = way[0] * vy - way[1] * vx
    volume = ux * px + uy * py + uz * pz
    if volume == 0.0:
        return False
    sx, sy, sz = start[0] - t[0, 0], start[1] - t[0, 1], start[2] - t[0, 2]
    s = (sx * px + sy * py + sz * pz) / volume
    if s < 0.0 or s > 1.0:
        return False
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    w = (way[0] * qx + way[1] * qy + way[2] * qz) / volume
    if w < 0.0 or s + w > 1.0:
        return False
    return (vx * qx + vy * qy + vz * qz) / volume > 0.0


@njit(cache=True, nogil=True, parallel=True)
def crossed_odd(points, way, corners, low, high, child, first, last):
    """(n,) whether a ray from each point passes through an odd number of triangles."""
    n = len(points)
    odd = np.zeros(n, np.bool_)
    one_over = 1.0 / way
    for part in prange((n + TOGETHER - 1) // TOGETHER):
        stack = np.empty(DEEP, np.int64)
        for i in range(part * TOGETHER, min(n, (part + 1) * TOGETHER)):
            start = points[i]
            stack[0], top = 0, 1
            while top > 0:
                top -= 1
                k = stack[top]
                if not _ray_meets_box(start, one_over, low, high, k):
                    continue
                if child[k] >= 0:
                    stack[top], stack[top + 1] = child[k], child[k] + 1
                    top += 2
                    continue
                for t in range(first[k], last[k]):
                    if _ray_meets_triangle(start, way, corners[t]):
                        odd[i] = not odd[i]
    return odd
