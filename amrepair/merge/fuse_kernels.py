# mypy: disable-error-code="no-untyped-def"
"""Loops over points in cells: local planes, open sides, columns, moving least squares; compiled.

Points are sorted by cell; `start[c]` is the first of cell c, cells are numbered x-major in a box of
`shape` cells with one empty layer around it, so that neighbours need no bounds checks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from amrepair.arrays import Vector
from amrepair.eigen_kernels import least_axis
from amrepair.field.scales_kernels import median
from amrepair.observe.robust import MAD_TO_SIGMA
from gcode.compiled import njit, prange

# Most points that one fit looks at; denser clouds are thinned before.
MAX_NEAR = 2048
# The scans' own variance is taken off twice: at edges they differ by where their points fell.
NOISE_FACTOR = 2.0
LAST_BIT = 62
RAY_STEP = 0.5  # of a cell


class PointGrid(NamedTuple):
    """Cells that points are sorted by: corner, edge, how many, and where each one's begin."""

    low: Vector
    cell: float
    shape: Int[np.ndarray, " 3"]
    start: Int[np.ndarray, " cells1"]


class Sheet(NamedTuple):
    """Discs' radius; which are of a place's own sheet: how near, how steep, how high by chance."""

    disc: float
    own: float
    slope: float
    chance: float


class Rules(NamedTuple):
    """Of a fit: its radius, the noise, its rounds, the least points, and who is overruled, mm."""

    radius: float
    sigma: float
    rounds: int
    least_points: int
    outlier_sigmas: float
    outlier_mm: float


@njit(cache=True, nogil=True, parallel=True)
def local_planes(points, grid, radius):
    """(n, 3) unit normals of planes through the points within `radius`, (n,) least variances."""
    low, cell, shape, start = grid
    n = len(points)
    normals = np.zeros((n, 3))
    least = np.zeros(n)
    count = np.zeros(n, np.int64)
    limit = radius * radius
    for k in prange(n):
        ix = int((points[k, 0] - low[0]) / cell)
        iy = int((points[k, 1] - low[1]) / cell)
        iz = int((points[k, 2] - low[2]) / cell)
        m = 0
        sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
        for cx in range(ix - 1, ix + 2):
            for cy in range(iy - 1, iy + 2):
                first = (cx * shape[1] + cy) * shape[2] + iz - 1
                for q in range(start[first], start[first + 3]):
                    x = points[q, 0] - points[k, 0]
                    y = points[q, 1] - points[k, 1]
                    z = points[q, 2] - points[k, 2]
                    if x * x + y * y + z * z <= limit:
                        m += 1
                        sx += x
                        sy += y
                        sz += z
                        xx += x * x
                        xy += x * y
                        xz += x * z
                        yy += y * y
                        yz += y * z
                        zz += z * z
        count[k] = m
        mx, my, mz = sx / m, sy / m, sz / m
        least[k] = least_axis(
            xx / m - mx * mx, xy / m - mx * my, xz / m - mx * mz,
            yy / m - my * my, yz / m - my * mz, zz / m - mz * mz, normals[k],
        )  # fmt: skip
    return normals, least, count


@njit(cache=True, nogil=True)
def discs_of_cells(places, planes, radius, low, cell, shape):
    """Discs that reach into each cell: where each cell's begin, and their numbers."""
    start = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    discs = np.empty(0, np.int64)
    for turn in range(2):
        if turn == 1:
            start[1:] = np.cumsum(start[1:])
            discs = np.empty(start[-1], np.int64)
            used = start[:-1].copy()
        for k in range(len(places)):
            for a in range(3):
                half = radius * np.sqrt(max(1.0 - planes[k, a] * planes[k, a], 0.0))
                first[a] = int((places[k, a] - half - low[a]) / cell)
                last[a] = int((places[k, a] + half - low[a]) / cell)
            for x in range(first[0], last[0] + 1):
                for y in range(first[1], last[1] + 1):
                    for z in range(first[2], last[2] + 1):
                        c = (x * shape[1] + y) * shape[2] + z
                        if turn == 0:
                            start[c + 1] += 1
                        else:
                            discs[used[c]] = k
                            used[c] += 1
    return start, discs


@njit(cache=True, nogil=True, inline="always")
def _is_hit(k, d, q, looks, facing, directions, places, planes, sheet):
    """Whether the ray d of place k meets disc q, which is not of its own sheet."""
    x, y, z = (
        places[q, 0] - looks[k, 0],
        places[q, 1] - looks[k, 1],
        places[q, 2] - looks[k, 2],
    )
    slant = planes[q, 0] * directions[d, 0] + planes[q, 1] * directions[d, 1]
    slant += planes[q, 2] * directions[d, 2]
    if abs(slant) < 1e-6:
        return False
    t = (planes[q, 0] * x + planes[q, 1] * y + planes[q, 2] * z) / slant
    if t <= 0.0:
        return False
    u, v, w = t * directions[d, 0] - x, t * directions[d, 1] - y, t * directions[d, 2] - z
    if u * u + v * v + w * w > sheet.disc * sheet.disc:
        return False
    reach = np.sqrt(x * x + y * y + z * z)
    height = abs(x * facing[k, 0] + y * facing[k, 1] + z * facing[k, 2])
    return reach > sheet.own or height > max(sheet.slope * reach, sheet.chance)


@njit(cache=True, nogil=True, parallel=True)
def open_side(looks, facing, directions, places, planes, grid, discs, sheet):
    """(s, 3) sums of the directions in which a place sees far: toward the open side.

    A ray counts by how far it gets before a disc; one that leaves the box counts most.
    """
    low, cell, shape, start = grid
    s = len(looks)
    votes = np.zeros((s, 3))
    longest = np.sqrt(float(shape[0] ** 2 + shape[1] ** 2 + shape[2] ** 2))
    for k in prange(s):
        x0 = (looks[k, 0] - low[0]) / cell
        y0 = (looks[k, 1] - low[1]) / cell
        z0 = (looks[k, 2] - low[2]) / cell
        for d in range(len(directions)):
            t, weight, before = 0.0, 1.0, -1
            while weight == 1.0:
                ix = int(np.floor(x0 + t * directions[d, 0]))
                iy = int(np.floor(y0 + t * directions[d, 1]))
                iz = int(np.floor(z0 + t * directions[d, 2]))
                if min(ix, iy, iz) < 0 or ix >= shape[0] or iy >= shape[1] or iz >= shape[2]:
                    break
                c = (ix * shape[1] + iy) * shape[2] + iz
                if c != before:
                    for q in range(start[c], start[c + 1]):
                        if _is_hit(
                            k, d, discs[q], looks, facing, directions, places, planes, sheet
                        ):
                            weight = 0.02 * min(t / longest, 1.0)
                            break
                before = c
                t += RAY_STEP
            for a in range(3):
                votes[k, a] += weight * directions[d, a]
    return votes


@njit(inner=True, cache=True, nogil=True)
def _has(scan, q, places, normals, index, low, cell, near, facing):
    """Whether a scan has surface itself where a surfel of another lies."""
    ix = int(np.floor((places[q, 0] - low[0]) / cell))
    iy = int(np.floor((places[q, 1] - low[1]) / cell))
    iz = int(np.floor((places[q, 2] - low[2]) / cell))
    for x in range(max(ix - 1, 0), min(ix + 2, index.shape[1])):
        for y in range(max(iy - 1, 0), min(iy + 2, index.shape[2])):
            for z in range(max(iz - 1, 0), min(iz + 2, index.shape[3])):
                own = index[scan, x, y, z]
                if own < 0:
                    continue
                cosine = height = away = 0.0
                for a in range(3):
                    cosine += normals[q, a] * normals[own, a]
                    height += normals[q, a] * (places[own, a] - places[q, a])
                    away += (places[own, a] - places[q, a]) ** 2
                beside = away - height * height
                if cosine > facing and abs(height) <= near and beside <= 0.25 * cell * cell:
                    return True
    return False


@njit(cache=True, nogil=True, parallel=True)
def columns(places, normals, scan, index, low, cell, near, far, facing):
    """(s,) other scans that have surface here; that have it elsewhere along the normal; how far.

    What the scan has there, too, is another wall of the part, and no contradiction.
    `index` is (scans, x, y, z): number of the surfel of a scan in a cell, or −1.
    """
    s = len(places)
    scans = index.shape[0]
    support = np.zeros(s, np.int64)
    conflict = np.zeros(s, np.int64)
    apart = np.zeros(s)
    steps = int(np.ceil(2.0 * far / cell))
    for k in prange(s):
        for r in range(scans):
            if r == scan[k]:
                continue
            best, at = 1e30, -1
            for j in range(-steps, steps + 1):
                t = 0.5 * j * cell
                ix = int(np.floor((places[k, 0] + t * normals[k, 0] - low[0]) / cell))
                iy = int(np.floor((places[k, 1] + t * normals[k, 1] - low[1]) / cell))
                iz = int(np.floor((places[k, 2] + t * normals[k, 2] - low[2]) / cell))
                if (
                    ix < 0
                    or iy < 0
                    or iz < 0
                    or ix >= index.shape[1]
                    or iy >= index.shape[2]
                    or iz >= index.shape[3]
                ):
                    continue
                q = index[r, ix, iy, iz]
                if q < 0:
                    continue
                cosine = 0.0
                height = 0.0
                for a in range(3):
                    cosine += normals[k, a] * normals[q, a]
                    height += normals[k, a] * (places[q, a] - places[k, a])
                if cosine > facing and abs(height) < best:
                    best, at = abs(height), q
            if best <= near:
                support[k] += 1
            elif best <= far and not _has(
                scan[k], at, places, normals, index, low, cell, near, facing
            ):
                conflict[k] += 1
                apart[k] = max(apart[k], best)
    return support, conflict, apart


@njit(inner=True, cache=True, nogil=True)
def _gathered(place, points, normals, grid, radius, near, weight, height):
    """Points within a radius of a place: how many; their numbers, weights and signed heights."""
    ix = int(np.floor((place[0] - grid.low[0]) / grid.cell))
    iy = int(np.floor((place[1] - grid.low[1]) / grid.cell))
    iz = int(np.floor((place[2] - grid.low[2]) / grid.cell))
    shape, limit, m = grid.shape, radius * radius, 0
    if min(ix, iy, iz) < 1 or ix > shape[0] - 2 or iy > shape[1] - 2 or iz > shape[2] - 2:
        return 0
    for cx in range(ix - 1, ix + 2):
        for cy in range(iy - 1, iy + 2):
            first = (cx * shape[1] + cy) * shape[2] + iz - 1
            for q in range(grid.start[first], grid.start[first + 3]):
                x, y, z = place[0] - points[q, 0], place[1] - points[q, 1], place[2] - points[q, 2]
                d = x * x + y * y + z * z
                if d < limit and m < MAX_NEAR:
                    near[m] = q
                    weight[m] = (1.0 - d / limit) ** 4
                    height[m] = x * normals[q, 0] + y * normals[q, 1] + z * normals[q, 2]
                    m += 1
    return m


@njit(inner=True, cache=True, nogil=True)
def _each_alone(scan, weight, height, sigma, value, noise):
    """Mean height of each scan and its standard deviation, in place; NaN of fewer than 3 points.

    The deviation is of the scan's own scatter: at edges that is more than noise.
    """
    scans = len(value)
    total, number = np.zeros(scans), np.zeros(scans, np.int64)
    value[:], noise[:] = 0.0, 0.0
    for j in range(len(scan)):
        s = scan[j]
        total[s] += weight[j]
        value[s] += weight[j] * height[j]
        number[s] += 1
    for s in range(scans):
        value[s] = value[s] / total[s] if number[s] >= 3 else np.nan
    for j in range(len(scan)):
        s = scan[j]
        off = height[j] - value[s]
        noise[s] += weight[j] * weight[j] * (off * off + sigma * sigma)
    for s in range(scans):
        noise[s] = np.sqrt(noise[s]) / total[s] if number[s] >= 3 else np.nan


@njit(inner=True, cache=True, nogil=True)
def _overruled(value, noise, rules, banned):
    """Scans that differ from the median of all, in `banned`; how many were heard; the variance.

    That between the others, less what their noise makes; NaN where one alone is left.
    """
    scans, who = len(value), 0
    said = np.empty(scans)
    for s in range(scans):
        if not np.isnan(value[s]):
            said[who] = value[s]
            who += 1
    if who < 2:
        return who, np.nan
    middle = median(said, who)
    for s in range(who):
        said[s] = abs(said[s] - middle)
    scale = MAD_TO_SIGMA * median(said, who)
    kept, mean, variance = 0, 0.0, 0.0
    for s in range(scans):
        bound = max(rules.outlier_sigmas * max(scale, noise[s]), rules.outlier_mm)
        banned[s] = who >= 3 and abs(value[s] - middle) > bound
        kept += not (np.isnan(value[s]) or banned[s])
    if kept < 2:
        return who, np.nan
    for s in range(scans):
        if not (np.isnan(value[s]) or banned[s]):
            mean += value[s] / kept
    for s in range(scans):
        if not (np.isnan(value[s]) or banned[s]):
            chance = NOISE_FACTOR * noise[s] ** 2 * (kept - 1) / kept
            variance += (value[s] - mean) ** 2 - chance
    return who, variance / (kept - 1)


@njit(inner=True, cache=True, nogil=True)
def _together(near, weight, height, normals, radius, rounds):
    """Robust implicit moving least squares, which keep edges (Öztireli 2009)."""
    f = gx = gy = gz = 0.0
    for turn in range(rounds):
        top = bottom = ax = ay = az = 0.0
        for j in range(len(near)):
            q, w = near[j], weight[j]
            if turn > 0:
                off = (height[j] - f) / (0.5 * radius)
                x, y, z = normals[q, 0] - gx, normals[q, 1] - gy, normals[q, 2] - gz
                w *= np.exp(-off * off - (x * x + y * y + z * z) / 0.25)
            top += w * height[j]
            bottom += w
            ax, ay, az = ax + w * normals[q, 0], ay + w * normals[q, 1], az + w * normals[q, 2]
        if bottom < 1e-12:
            break
        f = top / bottom
        norm = max(np.sqrt(ax * ax + ay * ay + az * az), 1e-12)
        gx, gy, gz = ax / norm, ay / norm, az / norm
    return f


@njit(inner=True, cache=True, nogil=True)
def _at_node(place, points, normals, scan, scans, grid, rules):
    """Of one node, what `fused_nodes` returns."""
    near, weight, height = np.empty(MAX_NEAR, np.int64), np.empty(MAX_NEAR), np.empty(MAX_NEAR)
    m = _gathered(place, points, normals, grid, rules.radius, near, weight, height)
    if m < rules.least_points:
        return np.nan, np.nan, 0, np.int64(0)
    near, weight, height = near[:m], weight[:m], height[:m]
    whose = scan[near]
    value, noise, banned = np.empty(scans), np.empty(scans), np.zeros(scans, np.bool_)
    _each_alone(whose, weight, height, rules.sigma, value, noise)
    heard, excess = _overruled(value, noise, rules, banned)
    bits = np.int64(0)
    for s in range(scans):
        if banned[s]:
            bits |= np.int64(1) << min(s, LAST_BIT)
    for j in range(m):
        if banned[whose[j]]:
            weight[j] = 0.0
    return _together(near, weight, height, normals, rules.radius, rules.rounds), excess, heard, bits


@njit(cache=True, nogil=True, parallel=True)
def fused_nodes(nodes, points, normals, scan, scans, grid, rules):
    """Signed distance at nodes by robust moving least squares, and how far scans disagree.

    Returns (n,) f (NaN without support), (n,) variance between scans less what their noise makes
    (may be negative by chance; NaN where one scan alone decides), (n,) scans that were heard, (n,)
    scans that were overruled, a bit for each (the last bit for all beyond it).
    """
    n = len(nodes)
    field, excess = np.empty(n), np.empty(n)
    heard, overruled = np.empty(n, np.int64), np.empty(n, np.int64)
    for k in prange(n):
        field[k], excess[k], heard[k], overruled[k] = _at_node(
            nodes[k], points, normals, scan, scans, grid, rules
        )
    return field, excess, heard, overruled
