# mypy: disable-error-code="no-untyped-def"
"""Loops over points in cells: local planes, open sides, columns, moving least squares; compiled.

Points are sorted by cell; `start[c]` is the first of cell c, cells are numbered x-major in a box of
`shape` cells with one empty layer around it, so that neighbours need no bounds checks.
"""

from __future__ import annotations

import numpy as np

from amrepair.eigen_kernels import least_axis
from gcode.compiled import njit, prange

# Most points that one fit looks at; denser clouds are thinned before.
MAX_NEAR = 2048
# The scans' own variance is taken off twice: at edges they differ by where their points fell.
NOISE_FACTOR = 2.0
LAST_BIT = 62


@njit(cache=True, nogil=True, parallel=True)
def local_planes(points, low, cell, shape, start, radius):
    """(n, 3) unit normals of planes through the points within `radius`, (n,) least variances."""
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


@njit(cache=True, nogil=True, parallel=True)
def open_side(places, directions, occupied, low, cell, skip):
    """(s, 3) sums of the directions in which a place sees far: toward the open side.

    A ray counts by how far it gets before an occupied cell; one that leaves the box counts most.
    """
    s = len(places)
    votes = np.zeros((s, 3))
    step = 0.7
    longest = np.sqrt(
        float(occupied.shape[0] ** 2 + occupied.shape[1] ** 2 + occupied.shape[2] ** 2)
    )
    for k in prange(s):
        x0 = (places[k, 0] - low[0]) / cell
        y0 = (places[k, 1] - low[1]) / cell
        z0 = (places[k, 2] - low[2]) / cell
        for d in range(len(directions)):
            t = skip
            weight = 1.0
            while True:
                ix = int(np.floor(x0 + t * directions[d, 0]))
                iy = int(np.floor(y0 + t * directions[d, 1]))
                iz = int(np.floor(z0 + t * directions[d, 2]))
                if (
                    ix < 0
                    or iy < 0
                    or iz < 0
                    or ix >= occupied.shape[0]
                    or iy >= occupied.shape[1]
                    or iz >= occupied.shape[2]
                ):
                    break
                if occupied[ix, iy, iz]:
                    weight = 0.02 * min(t / longest, 1.0)
                    break
                t += step
            for a in range(3):
                votes[k, a] += weight * directions[d, a]
    return votes


@njit(cache=True, nogil=True, parallel=True)
def columns(places, normals, scan, index, low, cell, near, far, facing):
    """(s,) other scans that have surface here; that have it elsewhere along the normal; how far.

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
            best = 1e30
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
                    best = abs(height)
            if best <= near:
                support[k] += 1
            elif best <= far:
                conflict[k] += 1
                apart[k] = max(apart[k], best)
    return support, conflict, apart


@njit(cache=True, nogil=True, inline="always")
def _median(values, n):
    """Median of the first n values, which are sorted in place."""
    for i in range(1, n):
        v = values[i]
        j = i - 1
        while j >= 0 and values[j] > v:
            values[j + 1] = values[j]
            j -= 1
        values[j + 1] = v
    half = n // 2
    return values[half] if n % 2 else 0.5 * (values[half - 1] + values[half])


@njit(cache=True, nogil=True, parallel=True)
def fused_nodes(
    nodes, points, normals, scan, scans, low, cell, shape, start, radius, sigma, rounds,
    least_points, outlier_sigmas, outlier_mm,
):  # fmt: skip
    """Signed distance at nodes by robust moving least squares, and how far scans disagree.

    Returns (n,) f (NaN without support), (n,) variance between scans less what their noise makes
    (may be negative by chance; NaN where one scan alone decides), (n,) scans that were heard, (n,)
    scans that were overruled, a bit for each (the last bit for all beyond it).
    """
    n = len(nodes)
    field = np.full(n, np.nan)
    excess = np.full(n, np.nan)
    heard = np.zeros(n, np.int64)
    overruled = np.zeros(n, np.int64)
    limit = radius * radius
    for k in prange(n):
        ix = int(np.floor((nodes[k, 0] - low[0]) / cell))
        iy = int(np.floor((nodes[k, 1] - low[1]) / cell))
        iz = int(np.floor((nodes[k, 2] - low[2]) / cell))
        if (
            ix < 1
            or iy < 1
            or iz < 1
            or ix > shape[0] - 2
            or iy > shape[1] - 2
            or iz > shape[2] - 2
        ):
            continue
        near = np.empty(MAX_NEAR, np.int64)
        weight = np.empty(MAX_NEAR)
        height = np.empty(MAX_NEAR)
        m = 0
        for cx in range(ix - 1, ix + 2):
            for cy in range(iy - 1, iy + 2):
                first = (cx * shape[1] + cy) * shape[2] + iz - 1
                for q in range(start[first], start[first + 3]):
                    x = nodes[k, 0] - points[q, 0]
                    y = nodes[k, 1] - points[q, 1]
                    z = nodes[k, 2] - points[q, 2]
                    d = x * x + y * y + z * z
                    if d < limit and m < MAX_NEAR:
                        near[m] = q
                        weight[m] = (1.0 - d / limit) ** 4
                        height[m] = x * normals[q, 0] + y * normals[q, 1] + z * normals[q, 2]
                        m += 1
        if m < least_points:
            continue
        # what each scan says alone
        total = np.zeros(scans)
        square = np.zeros(scans)
        value = np.zeros(scans)
        number = np.zeros(scans, np.int64)
        for j in range(m):
            s = scan[near[j]]
            total[s] += weight[j]
            value[s] += weight[j] * height[j]
            number[s] += 1
        said = np.empty(scans)
        who = 0
        for s in range(scans):
            if number[s] >= 3:
                value[s] /= total[s]
                said[who] = value[s]
                who += 1
        # variance of each scan's mean, from its own scatter: at edges more than noise
        for j in range(m):
            s = scan[near[j]]
            off = height[j] - value[s]
            square[s] += weight[j] * weight[j] * (off * off + sigma * sigma)
        for s in range(scans):
            if number[s] >= 3:
                square[s] = np.sqrt(square[s]) / total[s]
        heard[k] = who
        banned = np.zeros(scans, np.bool_)
        if who >= 2:
            middle = _median(said, who)
            for s in range(who):
                said[s] = abs(said[s] - middle)
            scale = 1.4826 * _median(said, who)
            kept = 0
            for s in range(scans):
                if number[s] < 3:
                    continue
                noise = square[s]
                bound = max(outlier_sigmas * max(scale, noise), outlier_mm)
                if who >= 3 and abs(value[s] - middle) > bound:
                    banned[s] = True
                else:
                    kept += 1
            for s in range(scans):
                if banned[s]:
                    overruled[k] |= np.int64(1) << min(s, LAST_BIT)
            if kept >= 2:
                mean = 0.0
                for s in range(scans):
                    if number[s] >= 3 and not banned[s]:
                        mean += value[s] / kept
                variance = 0.0
                for s in range(scans):
                    if number[s] >= 3 and not banned[s]:
                        noise = square[s]
                        variance += (value[s] - mean) ** 2 - NOISE_FACTOR * noise**2 * (
                            kept - 1
                        ) / kept
                excess[k] = variance / (kept - 1)
        # together: robust implicit moving least squares, which keeps edges (Öztireli 2009)
        f = 0.0
        gx = gy = gz = 0.0
        for turn in range(rounds):
            top = 0.0
            bottom = 0.0
            ax = ay = az = 0.0
            for j in range(m):
                q = near[j]
                if banned[scan[q]]:
                    continue
                w = weight[j]
                if turn > 0:
                    off = (height[j] - f) / (0.5 * radius)
                    x = normals[q, 0] - gx
                    y = normals[q, 1] - gy
                    z = normals[q, 2] - gz
                    w *= np.exp(-off * off - (x * x + y * y + z * z) / 0.25)
                top += w * height[j]
                bottom += w
                ax += w * normals[q, 0]
                ay += w * normals[q, 1]
                az += w * normals[q, 2]
            if bottom < 1e-12:
                break
            f = top / bottom
            norm = max(np.sqrt(ax * ax + ay * ay + az * az), 1e-12)
            gx, gy, gz = ax / norm, ay / norm, az / norm
        field[k] = f
    return field, excess, heard, overruled
