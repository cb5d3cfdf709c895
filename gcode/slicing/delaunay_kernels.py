"""Delaunay triangles of points in the plane, one by one with flips; compiled, for `medial`.

Points that follow each other along a contour lie near each other: first every 2^k-th is put in,
then those between, each looked for from the one before it. A walk is a few steps long, and so is a
row of flips. qhull takes six times as long for a few hundred points.

References
----------
C. Lawson, "Software for C1 surface interpolation", Mathematical Software III (1977): flips.
O. Devillers, S. Pion, M. Teillaud, "Walking in a triangulation", IJFCS 13 (2002).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit

# The triangle around all points reaches out so many of their extents: triangles within with a
# circle smaller than that are the points' own.
FAR_CIRCLE = 1e3
MOST_WALK_STEPS = 10_000


@njit(cache=True, nogil=True, inline="always")
def turn(xy: Any, a: int, b: int, c: int) -> float:
    """Twice the area of a triangle, positive anticlockwise."""
    return (xy[b, 0] - xy[a, 0]) * (xy[c, 1] - xy[a, 1]) - (xy[b, 1] - xy[a, 1]) * (
        xy[c, 0] - xy[a, 0]
    )


@njit(cache=True, nogil=True, inline="always")
def in_circle(xy: Any, a: int, b: int, c: int, d: int) -> bool:
    """Whether `d` lies in the circle through an anticlockwise triangle."""
    ax, ay = xy[a, 0] - xy[d, 0], xy[a, 1] - xy[d, 1]
    bx, by = xy[b, 0] - xy[d, 0], xy[b, 1] - xy[d, 1]
    cx, cy = xy[c, 0] - xy[d, 0], xy[c, 1] - xy[d, 1]
    aa, bb, cc = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    return bool(
        ax * (by * cc - bb * cy) - ay * (bx * cc - bb * cx) + aa * (bx * cy - by * cx) > 0.0
    )


@njit(inner=True, cache=True, nogil=True)
def found_at(xy: Any, corners: Any, across: Any, p: int, begin: int, count: int) -> int:
    """The triangle that holds a point, by a walk from another one."""
    t = begin
    for step in range(MOST_WALK_STEPS):
        moved = False
        for k in range(3):
            side = (k + step) % 3  # another side first each time: no walk goes round for ever
            a, b = corners[t, (side + 1) % 3], corners[t, (side + 2) % 3]
            if across[t, side] >= 0 and turn(xy, a, b, p) < 0.0:
                t = across[t, side]
                moved = True
                break
        if not moved:
            return t
    for t in range(count):
        if (
            turn(xy, corners[t, 0], corners[t, 1], p) >= 0.0
            and turn(xy, corners[t, 1], corners[t, 2], p) >= 0.0
            and turn(xy, corners[t, 2], corners[t, 0], p) >= 0.0
        ):
            return t
    return begin


@njit(inner=True, cache=True, nogil=True)
def joined_to(across: Any, t: int, old: int, new: int) -> None:
    """Triangle `t` lies beside `new` where it lay beside `old`."""
    if t >= 0:
        for k in range(3):
            if across[t, k] == old:
                across[t, k] = new
                return


@njit(inner=True, cache=True, nogil=True)
def put_in(xy: Any, corners: Any, across: Any, at: Any, p: int, t: int, count: int) -> None:
    """Split the triangle that holds a point in three, and flip until no circle holds another."""
    a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
    to_a, to_b, to_c = across[t, 0], across[t, 1], across[t, 2]
    one, two = count, count + 1
    # the new point is the first corner of each; across from it lies what lay outside
    corners[t, 0], corners[t, 1], corners[t, 2] = p, b, c
    corners[one, 0], corners[one, 1], corners[one, 2] = p, c, a
    corners[two, 0], corners[two, 1], corners[two, 2] = p, a, b
    across[t, 0], across[t, 1], across[t, 2] = to_a, one, two
    across[one, 0], across[one, 1], across[one, 2] = to_b, two, t
    across[two, 0], across[two, 1], across[two, 2] = to_c, t, one
    joined_to(across, to_b, t, one)
    joined_to(across, to_c, t, two)
    at[p], at[a], at[b], at[c] = t, one, two, t
    stack = np.empty(64, np.int64)
    stack[0], stack[1], stack[2] = t, one, two
    n = 3
    for _ in range(MOST_WALK_STEPS):
        if n == 0:
            break
        n -= 1
        s = stack[n]
        other = across[s, 0]
        if other < 0:
            continue
        k = 0
        while across[other, k] != s:
            k += 1
        q = corners[other, k]
        if not in_circle(xy, corners[s, 0], corners[s, 1], corners[s, 2], q):
            continue
        # p, u, v and q, v, u become p, u, q and p, q, v
        u, v = corners[s, 1], corners[s, 2]
        beyond_u, beyond_v = across[other, (k + 1) % 3], across[other, (k + 2) % 3]
        by_v = across[s, 1]
        corners[s, 2] = q
        corners[other, 0], corners[other, 1], corners[other, 2] = p, q, v
        across[s, 0], across[s, 1] = beyond_u, other
        across[other, 0], across[other, 1], across[other, 2] = beyond_v, by_v, s
        joined_to(across, beyond_u, other, s)
        joined_to(across, by_v, s, other)
        at[u], at[v], at[q], at[p] = s, other, s, s
        if n + 2 > len(stack):
            larger = np.empty(2 * len(stack), np.int64)
            larger[:n] = stack[:n]
            stack = larger
        stack[n], stack[n + 1] = s, other
        n += 2


@njit(cache=True, nogil=True)
def triangles(points: Any) -> tuple[Any, Any]:
    """(t, 3) anticlockwise corners, and (t, 3) the triangle across from each, −1 where is none.

    Of the triangles along the hull those with huge circles may lack. No two points are the same,
    and no four lie on one circle.
    """
    m = len(points)
    none = np.empty((0, 3), np.int64)
    if m < 3:
        return none, none
    low = np.array((points[:, 0].min(), points[:, 1].min()))
    high = np.array((points[:, 0].max(), points[:, 1].max()))
    middle, extent = 0.5 * (low + high), max(high[0] - low[0], high[1] - low[1])
    xy = np.empty((m + 3, 2))
    for i in range(m):
        xy[i, 0], xy[i, 1] = points[i, 0] - middle[0], points[i, 1] - middle[1]
    for k in range(3):
        angle = 2.0 * np.pi * k / 3.0 + 0.1
        xy[m + k, 0], xy[m + k, 1] = (
            FAR_CIRCLE * extent * np.cos(angle),
            FAR_CIRCLE * extent * np.sin(angle),
        )
    corners, across = np.empty((2 * m + 4, 3), np.int64), np.full((2 * m + 4, 3), -1, np.int64)
    at = np.zeros(m + 3, np.int64)
    corners[0, 0], corners[0, 1], corners[0, 2] = m, m + 1, m + 2
    count = 1
    step = 1
    while 2 * step < m:
        step *= 2
    first = True
    while step > 0:
        begin = 0 if first else step
        for p in range(begin, m, step if first else 2 * step):
            near = at[p - step] if p >= step else 0
            t = found_at(xy, corners, across, p, near, count)
            put_in(xy, corners, across, at, p, t, count)
            count += 2
        first = False
        step //= 2
    number = np.full(count, -1, np.int64)
    kept = 0
    for t in range(count):
        if corners[t, 0] < m and corners[t, 1] < m and corners[t, 2] < m:
            number[t] = kept
            kept += 1
    own, beside = np.empty((kept, 3), np.int64), np.empty((kept, 3), np.int64)
    for t in range(count):
        if number[t] >= 0:
            for k in range(3):
                own[number[t], k] = corners[t, k]
                beside[number[t], k] = number[across[t, k]] if across[t, k] >= 0 else -1
    return own, beside
