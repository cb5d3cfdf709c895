# mypy: disable-error-code="no-untyped-def"
"""Many poses at once on a coarse field: where to start each, and its way down; compiled.

A pose is a rotation and the place of the points' centroid; the points are about their centroid.
"""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange

CHOICES = 27  # low, middle, high along each axis
TRIM = 0.02  # of the points at each end of the box: outliers
DAMPING = 1e-4
WIDEST_TURN_RAD = 0.35  # of one step


@njit(cache=True, nogil=True, inline="always")
def nearest_node(x, y, z, origin, cell, values):
    """Distance at the node nearest to a point: enough to choose between places far apart."""
    i = min(max(int((x - origin[0]) / cell + 0.5), 0), values.shape[0] - 1)
    j = min(max(int((y - origin[1]) / cell + 0.5), 0), values.shape[1] - 1)
    k = min(max(int((z - origin[2]) / cell + 0.5), 0), values.shape[2] - 1)
    return values[i, j, k]


@njit(cache=True, nogil=True, inline="always")
def field_at(x, y, z, origin, cell, values):
    """Distance and its gradient by trilinear interpolation; beyond the grid, to its border."""
    gx, gy, gz = (x - origin[0]) / cell, (y - origin[1]) / cell, (z - origin[2]) / cell
    cx = min(max(gx, 0.0), values.shape[0] - 1.001)
    cy = min(max(gy, 0.0), values.shape[1] - 1.001)
    cz = min(max(gz, 0.0), values.shape[2] - 1.001)
    i, j, k = int(cx), int(cy), int(cz)
    u, v, w = cx - i, cy - j, cz - k
    a, b = values[i, j, k], values[i, j, k + 1]
    c, d = values[i, j + 1, k], values[i, j + 1, k + 1]
    e, f = values[i + 1, j, k], values[i + 1, j, k + 1]
    g, h = values[i + 1, j + 1, k], values[i + 1, j + 1, k + 1]
    ab, cd = a + (b - a) * w, c + (d - c) * w
    ef, gh = e + (f - e) * w, g + (h - g) * w
    front, back = ab + (cd - ab) * v, ef + (gh - ef) * v
    value = front + (back - front) * u
    dx, dy, dz = gx - cx, gy - cy, gz - cz
    away = dx * dx + dy * dy + dz * dz
    if away > 0.0:
        away = np.sqrt(away)
        return value + away * cell, dx / away, dy / away, dz / away
    sx = (back - front) / cell
    sy = ((cd - ab) * (1 - u) + (gh - ef) * u) / cell
    low = (b - a) * (1 - v) + (d - c) * v
    high = (f - e) * (1 - v) + (h - g) * v
    sz = (low * (1 - u) + high * u) / cell
    return value, sx, sy, sz


@njit(cache=True, nogil=True, parallel=True)
def starts(points, rotations, box, origin, cell, values, cap):
    """(k, 3) places: box on box, side on side or middle on middle, whichever fits best."""
    found = np.empty((len(rotations), 3))
    n = len(points)
    trim = int(TRIM * n)
    for k in prange(len(rotations)):
        turned = points @ rotations[k].T.copy()
        shifts = np.empty((3, 3))
        for a in range(3):
            along = np.sort(turned[:, a].copy())
            low, high = along[trim], along[n - 1 - trim]
            shifts[a, 0] = 0.5 * (box[0, a] + box[1, a] - low - high)
            shifts[a, 1] = box[0, a] - low
            shifts[a, 2] = box[1, a] - high
        best = np.inf
        for choice in range(CHOICES):
            px = shifts[0, choice % 3]
            py = shifts[1, (choice // 3) % 3]
            pz = shifts[2, choice // 9]
            total = 0.0
            for i in range(0, n, 2):
                f = nearest_node(
                    turned[i, 0] + px, turned[i, 1] + py, turned[i, 2] + pz, origin, cell, values
                )
                total += min(abs(f), cap)
                if total >= best:
                    break
            if total < best:
                best = total
                found[k, 0], found[k, 1], found[k, 2] = px, py, pz
    return found


@njit(cache=True, nogil=True)
def _solve(h, b):
    """Solve a symmetric positive system of six by Cholesky, in place."""
    for i in range(6):
        for j in range(i + 1):
            total = h[i, j]
            for k in range(j):
                total -= h[i, k] * h[j, k]
            if i == j:
                h[i, i] = np.sqrt(max(total, 1e-30))
            else:
                h[i, j] = total / h[j, j]
    for i in range(6):
        for k in range(i):
            b[i] -= h[i, k] * b[k]
        b[i] /= h[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            b[i] -= h[k, i] * b[k]
        b[i] /= h[i, i]


@njit(cache=True, nogil=True)
def _turn(r, x, y, z):
    """Turn a rotation further by an axis-angle vector, in place (Rodrigues)."""
    angle = np.sqrt(x * x + y * y + z * z)
    if angle < 1e-12:
        return
    x, y, z = x / angle, y / angle, z / angle
    s, c = np.sin(angle), 1.0 - np.cos(angle)
    for column in range(3):
        a, b, d = r[0, column], r[1, column], r[2, column]
        ca, cb, cd = y * d - z * b, z * a - x * d, x * b - y * a
        r[0, column] = a + s * ca + c * (y * cd - z * cb)
        r[1, column] = b + s * cb + c * (z * ca - x * cd)
        r[2, column] = d + s * cd + c * (x * cb - y * ca)


@njit(cache=True, nogil=True)
def _accumulate(points, r, p, origin, cell, values, scale, h, b):
    """Normal equations of the Geman–McClure loss at a pose."""
    h[:] = 0.0
    b[:] = 0.0
    jacobian = np.empty(6)
    square = scale * scale
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        tx = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z
        ty = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z
        tz = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
        f, gx, gy, gz = field_at(tx + p[0], ty + p[1], tz + p[2], origin, cell, values)
        weight = square / (f * f + square)
        weight *= weight
        jacobian[0] = ty * gz - tz * gy
        jacobian[1] = tz * gx - tx * gz
        jacobian[2] = tx * gy - ty * gx
        jacobian[3], jacobian[4], jacobian[5] = gx, gy, gz
        for m in range(6):
            wj = weight * jacobian[m]
            b[m] -= wj * f
            for q in range(m + 1):
                h[m, q] += wj * jacobian[q]


@njit(cache=True, nogil=True, parallel=True)
def descend(points, rotations, places, origin, cell, values, scales, cap):
    """Move every pose downhill, one Gauss–Newton step for each scale; in place.

    Returns (k,) the mean of |f|, each up to the cap.
    """
    scores = np.empty(len(rotations))
    reach = 0.0
    for i in range(len(points)):
        reach = max(reach, np.sqrt((points[i] ** 2).sum()))
    for k in prange(len(rotations)):
        r, p = rotations[k], places[k]
        h, b = np.empty((6, 6)), np.empty(6)
        for step in range(len(scales)):
            _accumulate(points, r, p, origin, cell, values, scales[step], h, b)
            turning = (h[0, 0] + h[1, 1] + h[2, 2]) / 3.0
            moving = (h[3, 3] + h[4, 4] + h[5, 5]) / 3.0
            for m in range(3):
                h[m, m] += DAMPING * turning + 1e-12
                h[m + 3, m + 3] += DAMPING * moving + 1e-12
            _solve(h, b)
            turn = np.sqrt(b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
            share = min(1.0, WIDEST_TURN_RAD / max(turn, 1e-12))
            shift = np.sqrt(b[3] ** 2 + b[4] ** 2 + b[5] ** 2)
            share = min(share, WIDEST_TURN_RAD * reach / max(shift, 1e-12))
            _turn(r, share * b[0], share * b[1], share * b[2])
            for a in range(3):
                p[a] += share * b[3 + a]
        total = 0.0
        for i in range(len(points)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            f = field_at(
                r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + p[0],
                r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + p[1],
                r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + p[2],
                origin,
                cell,
                values,
            )[0]
            total += min(abs(f), cap)
        scores[k] = total / len(points)
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
            turn = 0.0
            for a in range(3):
                for b in range(3):
                    turn += (rotations[k, a, b] - rotations[other, a, b]) ** 2
            shift = ((places[k] - places[other]) ** 2).sum()
            if turn * radius * radius / 3.0 + shift < limit:
                near = True
                break
        if near:
            continue
        kept[count] = k
        count += 1
        if count == most:
            break
    return kept[:count]
