# mypy: disable-error-code="no-untyped-def"
"""Range images: directions, pixels, slopes. Loops over points and pixels, compiled, no policy."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange


@njit(cache=True, nogil=True)
def mean_seen_by(points, index, sensor):
    """How many points a sensor saw, and their mean."""
    count = 0
    total = np.zeros(3)
    for i in range(len(index)):
        if index[i] == sensor:
            count += 1
            for a in range(3):
                total[a] += points[i, a]
    return count, total / max(count, 1)


@njit(cache=True, nogil=True)
def directions(points, index, sensor, origin, axes, count):
    """(m, 3) of a sensor's points: tangents right and up, distance; those ahead of it."""
    out = np.empty((count, 3))
    m = 0
    for i in range(len(index)):
        if index[i] != sensor:
            continue
        x, y, z = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        ahead = x * axes[2, 0] + y * axes[2, 1] + z * axes[2, 2]
        if ahead <= 1e-6:
            continue
        out[m, 0] = (x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2]) / ahead
        out[m, 1] = (x * axes[1, 0] + y * axes[1, 1] + z * axes[1, 2]) / ahead
        out[m, 2] = np.sqrt(x * x + y * y + z * z)
        m += 1
    return out[:m]


@njit(cache=True, nogil=True)
def fill(directions, low, pixel, rows, columns):
    """Mean distance of the nearest surface in each pixel; inf where nothing was seen.

    Two passes: the least distance of each pixel, then the mean of what lies within a millimetre
    of it, so that a pixel which straddles an edge keeps the near side.
    """
    near = np.full((rows, columns), np.inf)
    for i in range(len(directions)):
        c = int(np.floor((directions[i, 0] - low[0]) / pixel + 0.5))
        r = int(np.floor((directions[i, 1] - low[1]) / pixel + 0.5))
        near[r, c] = min(near[r, c], directions[i, 2])
    total = np.zeros((rows, columns))
    count = np.zeros((rows, columns))
    for i in range(len(directions)):
        c = int(np.floor((directions[i, 0] - low[0]) / pixel + 0.5))
        r = int(np.floor((directions[i, 1] - low[1]) / pixel + 0.5))
        if directions[i, 2] <= near[r, c] + 1.0:
            total[r, c] += directions[i, 2]
            count[r, c] += 1.0
    for r in range(rows):
        for c in range(columns):
            if count[r, c] > 0:
                near[r, c] = total[r, c] / count[r, c]
    return near


@njit(cache=True, nogil=True)
def close_pinholes(depth, least):
    """Give an empty pixel the median of its neighbours where at least `least` of eight have one."""
    rows, columns = depth.shape
    out = depth.copy()
    seen = np.empty(8)
    for r in range(rows):
        for c in range(columns):
            if np.isfinite(depth[r, c]):
                continue
            n = 0
            for rr in range(max(r - 1, 0), min(r + 2, rows)):
                for cc in range(max(c - 1, 0), min(c + 2, columns)):
                    if np.isfinite(depth[rr, cc]):
                        seen[n] = depth[rr, cc]
                        n += 1
            if n >= least:
                out[r, c] = np.median(seen[:n])
    return out


@njit(cache=True, nogil=True)
def smooth(depth, limit):
    """Mean over 3×3 of what lies within `limit` of the centre: noise falls, edges stay."""
    rows, columns = depth.shape
    out = depth.copy()
    for r in range(rows):
        for c in range(columns):
            here = depth[r, c]
            if not np.isfinite(here):
                continue
            total, n = here, 1
            # both sides of a pair or neither: a lone side would tilt a slope
            for k in range(4):
                dr, dc = (0, 1, 1, 1)[k], (1, -1, 0, 1)[k]
                r1, c1, r2, c2 = r + dr, c + dc, r - dr, c - dc
                if r1 >= rows or r2 < 0 or min(c1, c2) < 0 or max(c1, c2) >= columns:
                    continue
                a, b = depth[r1, c1], depth[r2, c2]
                if abs(a - here) <= limit and abs(b - here) <= limit:
                    total += a + b
                    n += 2
            out[r, c] = total / n
    return out


@njit(cache=True, nogil=True)
def least_of_nine(depth):
    """Least of the 3×3 around each pixel; −inf where any of them has no data."""
    rows, columns = depth.shape
    out = np.full((rows, columns), -np.inf)
    for r in range(1, rows - 1):
        for c in range(1, columns - 1):
            lowest = np.inf
            whole = True
            for dr in range(-1, 2):
                for dc in range(-1, 2):
                    d = depth[r + dr, c + dc]
                    if not np.isfinite(d):
                        whole = False
                    lowest = min(lowest, d)
            if whole:
                out[r, c] = lowest
    return out


@njit(cache=True, nogil=True)
def incidence(depth, low, pixel, blend):
    """|cos| between ray and surface per pixel, from differences that stay on one surface.

    1 where the differences cross an edge: there the depth itself is the better measure.
    """
    rows, columns = depth.shape
    out = np.ones((rows, columns))
    for r in range(1, rows - 1):
        ty = low[1] + pixel * r
        for c in range(1, columns - 1):
            if not np.isfinite(depth[r, c]):
                continue
            tx = low[0] + pixel * c
            left, right = depth[r, c - 1], depth[r, c + 1]
            down, up = depth[r - 1, c], depth[r + 1, c]
            # what was not seen counts as at the sensor itself: an edge
            zl = left / np.sqrt(1 + (tx - pixel) ** 2 + ty**2) if np.isfinite(left) else 0.0
            zr = right / np.sqrt(1 + (tx + pixel) ** 2 + ty**2) if np.isfinite(right) else 0.0
            zd = down / np.sqrt(1 + tx**2 + (ty - pixel) ** 2) if np.isfinite(down) else 0.0
            zu = up / np.sqrt(1 + tx**2 + (ty + pixel) ** 2) if np.isfinite(up) else 0.0
            if abs(zr - zl) >= 2 * blend or abs(zu - zd) >= 2 * blend:
                continue
            ax = zr * (tx + pixel) - zl * (tx - pixel)
            ay, az = (zr - zl) * ty, zr - zl
            bx, bz = (zu - zd) * tx, zu - zd
            by = zu * (ty + pixel) - zd * (ty - pixel)
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            norm = np.sqrt(nx * nx + ny * ny + nz * nz)
            if norm > 0:
                length = np.sqrt(1 + tx * tx + ty * ty)
                out[r, c] = abs(nx * tx + ny * ty + nz) / (norm * length)
    return out


@njit(cache=True, nogil=True, parallel=True)
def look_up(
    points, sensor, axes, low, pixel, depth, least, cosine, blend, flattest, best, cautious
):
    """Raise `best` and `cautious` to how far the points lie in front of what a sensor saw.

    Depth is bilinear where the four pixels agree within `blend`, else the nearest one's; measured
    across the seen surface, whose cosine counts from `flattest` on. Where the sensor saw nothing
    along that line nothing is raised.
    """
    rows, columns = depth.shape
    for i in prange(len(points)):
        x, y, z = points[i, 0] - sensor[0], points[i, 1] - sensor[1], points[i, 2] - sensor[2]
        ahead = x * axes[2, 0] + y * axes[2, 1] + z * axes[2, 2]
        if ahead <= 1e-6:
            continue
        u = ((x * axes[1, 0] + y * axes[1, 1] + z * axes[1, 2]) / ahead - low[1]) / pixel
        v = ((x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2]) / ahead - low[0]) / pixel
        if not (-0.5 <= u <= rows - 0.5 and -0.5 <= v <= columns - 0.5):
            continue
        r, c = int(np.round(u)), int(np.round(v))
        if r >= rows or c >= columns or not np.isfinite(depth[r, c]):
            continue
        seen = depth[r, c]
        r0, c0 = int(np.floor(u)), int(np.floor(v))
        if r0 >= 0 and c0 >= 0 and r0 + 1 < rows and c0 + 1 < columns:
            a, b = depth[r0, c0], depth[r0, c0 + 1]
            p, q = depth[r0 + 1, c0], depth[r0 + 1, c0 + 1]
            top, bottom = max(a, b, p, q), min(a, b, p, q)
            if np.isfinite(top) and top - bottom <= blend:
                fu, fv = u - r0, v - c0
                seen = (a * (1 - fv) + b * fv) * (1 - fu) + (p * (1 - fv) + q * fv) * fu
        distance = np.sqrt(x * x + y * y + z * z)
        across = max(cosine[r, c], flattest)
        best[i] = max(best[i], (seen - distance) * across)
        cautious[i] = max(cautious[i], (least[r, c] - distance) * across)


@njit(cache=True, nogil=True)
def crossings(points, index, sensors, height, top, corner, cell, marked):
    """Points below `top` whose rays cross a height in marked cells, seen from above; and where."""
    number, place = np.empty(len(points), np.int64), np.empty((len(points), 2))
    found = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        sensor = sensors[index[i]]
        if z >= top or sensor[2] <= z:
            continue
        back = (height - z) / (sensor[2] - z)
        x, y = x + back * (sensor[0] - x), y + back * (sensor[1] - y)
        u, v = int(np.floor((x - corner[0]) / cell)), int(np.floor((y - corner[1]) / cell))
        if 0 <= u < marked.shape[0] and 0 <= v < marked.shape[1] and marked[u, v]:
            number[found], place[found, 0], place[found, 1] = i, x, y
            found += 1
    return number[:found].copy(), place[:found].copy()
