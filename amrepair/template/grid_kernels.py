# mypy: disable-error-code="no-untyped-def"
"""Distances from triangles to the nodes of a grid: exact near them, carried outward; compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit

NOBODY = -1


@njit(cache=True, nogil=True, inline="always")
def _squared(px, py, pz, a, ab, ac, dots):
    """Squared distance of a point to a triangle (C. Ericson, Real-Time Collision Detection, 5.1.5).

    `dots` is ab·ab, ab·ac, ac·ac.
    """
    x, y, z = px - a[0], py - a[1], pz - a[2]
    d1 = ab[0] * x + ab[1] * y + ab[2] * z
    d2 = ac[0] * x + ac[1] * y + ac[2] * z
    aa, mid, cc = dots[0], dots[1], dots[2]
    d3, d4 = d1 - aa, d2 - mid
    d5, d6 = d1 - mid, d2 - cc
    vc = d1 * d4 - d3 * d2
    vb = d5 * d2 - d1 * d6
    va = d3 * d6 - d5 * d4
    if d1 <= 0.0 and d2 <= 0.0:
        v, w = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v, w = d1 / (d1 - d3) if d1 > d3 else 0.0, 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w = 0.0, d2 / (d2 - d6) if d2 > d6 else 0.0
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        total = (d4 - d3) + (d5 - d6)
        w = (d4 - d3) / total if total > 0.0 else 0.0
        v = 1.0 - w
    else:
        total = va + vb + vc
        v, w = (vb / total, vc / total) if total > 0.0 else (0.0, 0.0)
    x -= v * ab[0] + w * ac[0]
    y -= v * ab[1] + w * ac[1]
    z -= v * ab[2] + w * ac[2]
    return x * x + y * y + z * z


@njit(cache=True, nogil=True)
def near_triangles(corner, ab, ac, dots, origin, cell, shape, band):
    """(x, y, z) squared distances, and which triangle, at nodes within `band` of one; else inf."""
    squared = np.full(shape, np.inf)
    which = np.full(shape, NOBODY, np.int32)
    low = np.empty(3, np.int64)
    high = np.empty(3, np.int64)
    normal = np.empty(3)
    limit = band * band
    for t in range(len(corner)):
        a = corner[t]
        for k in range(3):
            least = a[k] + min(0.0, ab[t, k], ac[t, k]) - band
            most = a[k] + max(0.0, ab[t, k], ac[t, k]) + band
            low[k] = max(0, int(np.ceil((least - origin[k]) / cell)))
            high[k] = min(shape[k] - 1, int(np.floor((most - origin[k]) / cell)))
            i, j = (k + 1) % 3, (k + 2) % 3
            normal[k] = ab[t, i] * ac[t, j] - ab[t, j] * ac[t, i]
        reach = band * np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        for i in range(low[0], high[0] + 1):
            x = origin[0] + i * cell
            for j in range(low[1], high[1] + 1):
                y = origin[1] + j * cell
                height = normal[0] * (x - a[0]) + normal[1] * (y - a[1])
                for k in range(low[2], high[2] + 1):
                    z = origin[2] + k * cell
                    if abs(height + normal[2] * (z - a[2])) > reach:
                        continue  # farther from its plane
                    found = _squared(x, y, z, a, ab[t], ac[t], dots[t])
                    if found <= limit and found < squared[i, j, k]:
                        squared[i, j, k] = found
                        which[i, j, k] = t
    return squared, which


@njit(cache=True, nogil=True)
def carry(squared, which, fixed, corner, ab, ac, dots, origin, cell, sx, sy, sz):
    """One sweep: nodes take the nearest of the triangles of those swept before them.

    (x, y, z) arrays are changed in place; nodes that are `fixed` stay. `sx, sy, sz` are ±1.
    """
    nx, ny, nz = squared.shape
    seen = np.empty(7, np.int32)
    for m in range(nx):
        i = m if sx > 0 else nx - 1 - m
        for n in range(ny):
            j = n if sy > 0 else ny - 1 - n
            for o in range(nz):
                k = o if sz > 0 else nz - 1 - o
                if fixed[i, j, k]:
                    continue
                known = 0
                for step in range(1, 8):
                    p = i - (sx if step & 1 else 0)
                    q = j - (sy if step & 2 else 0)
                    r = k - (sz if step & 4 else 0)
                    if p < 0 or p >= nx or q < 0 or q >= ny or r < 0 or r >= nz:
                        continue
                    t = which[p, q, r]
                    if t == NOBODY or t == which[i, j, k]:
                        continue
                    again = False
                    for s in range(known):
                        again |= seen[s] == t
                    if again:
                        continue
                    seen[known] = t
                    known += 1
                    found = _squared(
                        origin[0] + i * cell, origin[1] + j * cell, origin[2] + k * cell,
                        corner[t], ab[t], ac[t], dots[t],
                    )  # fmt: skip
                    if found < squared[i, j, k]:
                        squared[i, j, k] = found
                        which[i, j, k] = t


@njit(cache=True, nogil=True)
def shared_nodes(cells, block_of, fine):
    """Nodes of finer blocks in those cells, numbered; what blocks share has one number.

    Returns (b, (fine + 1)**3) the number of each block's nodes, x-major, and (k,) where among all
    of them each number stands first. `block_of` is a cell's number in `cells`, or −1.
    """
    side, blocks, count = fine + 1, len(cells), 0
    number = np.full((blocks, side**3), -1, np.int64)
    first = np.empty(blocks * side**3, np.int64)
    inner = np.empty(3, np.int64)
    for b in range(blocks):
        for node in range(side**3):
            inner[0], inner[1], inner[2] = node // side**2, node // side % side, node % side
            # the other blocks at this node lie one cell on, along each axis at whose end it is
            for beside in range(1, 8):
                there, same = -1, 0
                x, y, z = cells[b, 0], cells[b, 1], cells[b, 2]
                for a in range(3):
                    here = inner[a]
                    if beside >> a & 1:
                        if 0 < here < fine:
                            there = -2
                            break
                        step = -1 if here == 0 else 1
                        here = fine - here
                        if a == 0:
                            x += step
                        elif a == 1:
                            y += step
                        else:
                            z += step
                    same = same * side + here
                if there == -2 or min(x, y, z) < 0:
                    continue
                if x >= block_of.shape[0] or y >= block_of.shape[1] or z >= block_of.shape[2]:
                    continue
                at = block_of[x, y, z]
                if 0 <= at < b:
                    number[b, node] = number[at, same]
                    break
            if number[b, node] < 0:
                number[b, node] = count
                first[count] = b * side**3 + node
                count += 1
    return number, first[:count]
