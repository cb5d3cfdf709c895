# mypy: disable-error-code="no-untyped-def"
"""Many poses at once on a coarse field: where to start each, and its way down; compiled.

A pose is a rotation and the place of the points' centroid; the points, (3, n) in single precision,
are about their centroid. Lengths are in cells of the field, from its first node on; `values` is its
nodes in one row.
"""

from __future__ import annotations

import numpy as np

from amrepair.align.pose_kernels import step_down
from gcode.compiled import njit, prange

LEAST_ALONG, MOST_ALONG = 3, 8  # places along an axis
TRIM = 0.02  # of the points at each end of the box: outliers
SEARCH_DAMPING = 1e-4
WIDEST_SEARCH_RAD = 0.35  # of one step
SHORTEST = np.float32(1e-9)  # nothing is divided by less

# What runs in vectors of single precision stores nothing but sums and branches nowhere; numbers of
# nodes are computed as floats, which are exact below 2²⁴.


@njit(inner=True, cache=True, nogil=True)
def _trimmed(along, trim, ends):
    """The lowest and the highest but `trim` at each end, without sorting all of them."""
    ends[0], ends[1] = np.inf, -np.inf
    low, high = np.full(trim + 1, np.inf), np.full(trim + 1, -np.inf)
    for n in range(len(along)):
        value = along[n]
        if value < low[trim]:
            m = trim
            while m > 0 and low[m - 1] > value:
                low[m] = low[m - 1]
                m -= 1
            low[m] = value
        if value > high[trim]:
            m = trim
            while m > 0 and high[m - 1] < value:
                high[m] = high[m - 1]
                m -= 1
            high[m] = value
    ends[0], ends[1] = low[trim], high[trim]


@njit(inline="always", cache=True, nogil=True, error_model="numpy", fastmath=True)
def _at_nodes(turned, px, py, pz, values, shape, cap):
    """Sum of |f|, each up to the cap, at the nodes nearest to the points moved by p.

    Enough to choose between places far apart.
    """
    half, none, most = np.float32(0.5), np.float32(0.0), np.float32(cap)
    ny, nz = np.float32(shape[1]), np.float32(shape[2])
    tx, ty, tz = np.float32(shape[0] - 1), np.float32(shape[1] - 1), np.float32(shape[2] - 1)
    px, py, pz = np.float32(px) + half, np.float32(py) + half, np.float32(pz) + half
    total = none
    for n in range(turned.shape[1]):
        i = np.floor(min(max(turned[0, n] + px, none), tx))
        j = np.floor(min(max(turned[1, n] + py, none), ty))
        k = np.floor(min(max(turned[2, n] + pz, none), tz))
        total += min(abs(values[np.uint32((i * ny + j) * nz + k)]), most)
    return total


@njit(cache=True, nogil=True, parallel=True, error_model="numpy", fastmath=True)
def starts(points, rotations, box, values, shape, cap, gap, most):
    """(k, most, 3) the places that fit best, box in box: from side on side to side on side.

    Along each axis three places are tried, or more where they would be farther than `gap` apart.
    """
    found = np.empty((len(rotations), most, 3))
    n = points.shape[1]
    trim = int(TRIM * n)
    for k in prange(len(rotations)):
        r = rotations[k]
        turned = np.empty((3, n), np.float32)
        ends, low, pace = np.empty(2), np.empty(3), np.empty(3)
        count = np.empty(3, np.int64)
        for a in range(3):
            for m in range(n):
                turned[a, m] = (
                    r[a, 0] * points[0, m] + r[a, 1] * points[1, m] + r[a, 2] * points[2, m]
                )
            _trimmed(turned[a], trim, ends)
            low[a] = box[0, a] - ends[0]
            way = box[1, a] - ends[1] - low[a]
            count[a] = max(LEAST_ALONG, min(MOST_ALONG, 1 + int(np.ceil(abs(way) / gap))))
            pace[a] = way / (count[a] - 1)
        every_other = turned[:, ::2].copy()
        scores = np.full(most, np.inf)
        for i in range(count[0]):
            for j in range(count[1]):
                for m in range(count[2]):
                    px, py, pz = low[0] + i * pace[0], low[1] + j * pace[1], low[2] + m * pace[2]
                    total = _at_nodes(every_other, px, py, pz, values, shape, cap)
                    at = most
                    while at > 0 and scores[at - 1] > total:
                        at -= 1
                    if at == most:
                        continue
                    for other in range(most - 1, at, -1):
                        scores[other] = scores[other - 1]
                        found[k, other] = found[k, other - 1]
                    scores[at] = total
                    found[k, at, 0], found[k, at, 1], found[k, at, 2] = px, py, pz
    return found


@njit(inline="always", cache=True, nogil=True, error_model="numpy", fastmath=True)
def field_at(x, y, z, values, nx, ny, nz):
    """f and its gradient at a place: trilinear; beyond the grid, as its border has it.

    Numbers of nodes are given as floats. Inlined, so a gradient that is not asked costs nothing.
    """
    none, one, edge = np.float32(0.0), np.float32(1.0), np.float32(1.001)
    unit, row, plane = np.uint32(1), np.uint32(nz), np.uint32(ny * nz)
    cx = min(max(x, none), nx - edge)
    cy = min(max(y, none), ny - edge)
    cz = min(max(z, none), nz - edge)
    i, j, k = np.floor(cx), np.floor(cy), np.floor(cz)
    at = np.uint32((i * ny + j) * nz + k)
    u, v, w = cx - i, cy - j, cz - k
    a, c = values[at], values[at + row]
    e, g = values[at + plane], values[at + plane + row]
    da, dc = values[at + unit] - a, values[at + row + unit] - c
    de, dg = values[at + plane + unit] - e, values[at + plane + row + unit] - g
    ab, cd, ef, gh = a + da * w, c + dc * w, e + de * w, g + dg * w
    front, back = ab + (cd - ab) * v, ef + (gh - ef) * v
    low, high = da + (dc - da) * v, de + (dg - de) * v
    dx, dy, dz = x - cx, y - cy, z - cz
    away = np.sqrt(dx * dx + dy * dy + dz * dz)
    inside = away <= none
    by = one / (away if away > SHORTEST else one)
    gx = back - front if inside else dx * by
    gy = (cd - ab) + (gh - ef - cd + ab) * u if inside else dy * by
    gz = low + (high - low) * u if inside else dz * by
    return front + (back - front) * u + away, gx, gy, gz


@njit(inline="always", cache=True, nogil=True, error_model="numpy", fastmath=True)
def _between_nodes(points, r, p, values, shape, cap):
    """Sum of |f|, each up to the cap."""
    most, total = np.float32(cap), np.float32(0.0)
    nx, ny, nz = np.float32(shape[0]), np.float32(shape[1]), np.float32(shape[2])
    r00, r01, r02 = np.float32(r[0, 0]), np.float32(r[0, 1]), np.float32(r[0, 2])
    r10, r11, r12 = np.float32(r[1, 0]), np.float32(r[1, 1]), np.float32(r[1, 2])
    r20, r21, r22 = np.float32(r[2, 0]), np.float32(r[2, 1]), np.float32(r[2, 2])
    px, py, pz = np.float32(p[0]), np.float32(p[1]), np.float32(p[2])
    for n in range(points.shape[1]):
        x, y, z = points[0, n], points[1, n], points[2, n]
        tx = r00 * x + r01 * y + r02 * z + px
        ty = r10 * x + r11 * y + r12 * z + py
        tz = r20 * x + r21 * y + r22 * z + pz
        total += min(abs(field_at(tx, ty, tz, values, nx, ny, nz)[0]), most)
    return total


@njit(cache=True, nogil=True, parallel=True, error_model="numpy", fastmath=True)
def misfits(points, rotations, places, values, shape, cap):
    """(k,) the mean of |f|, each up to the cap, in every pose."""
    found = np.empty(len(rotations))
    for k in prange(len(rotations)):
        total = _between_nodes(points, rotations[k], places[k], values, shape, cap)
        found[k] = total / points.shape[1]
    return found


@njit(inline="always", cache=True, nogil=True, error_model="numpy", fastmath=True)
def _accumulate(points, r, p, values, shape, scale, cap, h, b):
    """Normal equations of the Geman–McClure loss at a pose, and the sum of |f| up to the cap."""
    square, most, total = np.float32(scale * scale), np.float32(cap), np.float32(0.0)
    nx, ny, nz = np.float32(shape[0]), np.float32(shape[1]), np.float32(shape[2])
    r00, r01, r02 = np.float32(r[0, 0]), np.float32(r[0, 1]), np.float32(r[0, 2])
    r10, r11, r12 = np.float32(r[1, 0]), np.float32(r[1, 1]), np.float32(r[1, 2])
    r20, r21, r22 = np.float32(r[2, 0]), np.float32(r[2, 1]), np.float32(r[2, 2])
    px, py, pz = np.float32(p[0]), np.float32(p[1]), np.float32(p[2])
    # one name for each sum: what is stored in an array keeps the loop from being vectors
    b0 = b1 = b2 = b3 = b4 = b5 = h00 = h10 = h11 = h20 = h21 = h22 = np.float32(0.0)
    h30 = h31 = h32 = h33 = h40 = h41 = h42 = h43 = h44 = np.float32(0.0)
    h50 = h51 = h52 = h53 = h54 = h55 = np.float32(0.0)
    for n in range(points.shape[1]):
        x, y, z = points[0, n], points[1, n], points[2, n]
        tx = r00 * x + r01 * y + r02 * z
        ty = r10 * x + r11 * y + r12 * z
        tz = r20 * x + r21 * y + r22 * z
        x, y, z = tx + px, ty + py, tz + pz
        f, gx, gy, gz = field_at(x, y, z, values, nx, ny, nz)
        total += min(abs(f), most)
        weight = square / (f * f + square)
        weight *= weight
        rx, ry, rz = ty * gz - tz * gy, tz * gx - tx * gz, tx * gy - ty * gx
        ux, uy, uz = weight * rx, weight * ry, weight * rz
        vx, vy, vz = weight * gx, weight * gy, weight * gz
        b0, b1, b2 = b0 - ux * f, b1 - uy * f, b2 - uz * f
        b3, b4, b5 = b3 - vx * f, b4 - vy * f, b5 - vz * f
        h00, h10, h11 = h00 + ux * rx, h10 + uy * rx, h11 + uy * ry
        h20, h21, h22 = h20 + uz * rx, h21 + uz * ry, h22 + uz * rz
        h30, h31, h32 = h30 + vx * rx, h31 + vx * ry, h32 + vx * rz
        h40, h41, h42 = h40 + vy * rx, h41 + vy * ry, h42 + vy * rz
        h50, h51, h52 = h50 + vz * rx, h51 + vz * ry, h52 + vz * rz
        h33, h43, h44 = h33 + vx * gx, h43 + vy * gx, h44 + vy * gy
        h53, h54, h55 = h53 + vz * gx, h54 + vz * gy, h55 + vz * gz
    b[0], b[1], b[2], b[3], b[4], b[5] = b0, b1, b2, b3, b4, b5
    h[0, 0], h[1, 0], h[1, 1], h[2, 0], h[2, 1], h[2, 2] = h00, h10, h11, h20, h21, h22
    h[3, 0], h[3, 1], h[3, 2], h[3, 3] = h30, h31, h32, h33
    h[4, 0], h[4, 1], h[4, 2], h[4, 3], h[4, 4] = h40, h41, h42, h43, h44
    h[5, 0], h[5, 1], h[5, 2], h[5, 3], h[5, 4], h[5, 5] = h50, h51, h52, h53, h54, h55
    return total


@njit(cache=True, nogil=True, parallel=True, error_model="numpy", fastmath=True)
def descend(points, rotations, places, values, shape, scales, cap):
    """Move every pose downhill, one Gauss–Newton step for each scale; in place.

    Returns (k,) the mean of |f|, each up to the cap.
    """
    scores = np.empty(len(rotations))
    reach = 0.0
    for i in range(points.shape[1]):
        # by hand: an expression on arrays would be a task for all threads, point by point
        x, y, z = points[0, i], points[1, i], points[2, i]
        reach = max(reach, np.sqrt(x * x + y * y + z * z))
    for k in prange(len(rotations)):
        r, p = rotations[k], places[k]
        h, b = np.empty((6, 6)), np.empty(6)
        total = np.float32(0.0)
        for step in range(len(scales) + 1):  # it is inlined once: at the end, the sum counts alone
            scale = scales[min(step, len(scales) - 1)]
            total = _accumulate(points, r, p, values, shape, scale, cap, h, b)
            if step < len(scales):
                step_down(r, p, h, b, SEARCH_DAMPING, 1e-12, WIDEST_SEARCH_RAD, reach)
        scores[k] = total / points.shape[1]
    return scores


@njit(cache=True, nogil=True)
def peaks(order, rotations, places, radius, apart, most):
    """Numbers of the poses that lie apart from all better ones, best first.

    `order` is by score; two poses differ by how far they move points at a radius, root mean square.
    """
    kept = np.empty(most, np.int64)
    count = 0
    limit = apart * apart
    for k in order:
        near = False
        for m in range(count):
            other = kept[m]
            turned = 0.0
            for a in range(3):
                for b in range(3):
                    turned += (rotations[k, a, b] - rotations[other, a, b]) ** 2
            shift = ((places[k] - places[other]) ** 2).sum()
            if turned * radius * radius / 3.0 + shift < limit:
                near = True
                break
        if near:
            continue
        kept[count] = k
        count += 1
        if count == most:
            break
    return kept[:count]
