# mypy: disable-error-code="no-untyped-def"
"""Two views moved until neither stands where the other saw through; compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from amrepair.align.pose_kernels import step_down
from amrepair.align.search_kernels import field_at
from amrepair.arrays import Points
from gcode.compiled import njit, prange

PAIR_DAMPING = 1e-3
WIDEST_PAIR_RAD = 0.3
PULL_FACING = 0.6  # cosine: surfaces that pull on each other, at least
DEEPEST_BEHIND = 2.0  # scales: deeper behind the other's surface nothing pulls
PULL = 0.5  # of surface that lies behind, beside what lies in free space


class Pair(NamedTuple):
    """Two views, in cells about their grids' middle: points, normals and field of each."""

    points: Points
    normals: Points
    others: Float[np.ndarray, "m 3"]
    other_normals: Float[np.ndarray, "m 3"]
    field: Float[np.ndarray, " k"]
    other_field: Float[np.ndarray, " k"]
    cells: int


@njit(inline="always", cache=True, nogil=True, error_model="numpy", fastmath=True)
def _row(place, gradient, f, weight, h, b, j):
    """One equation: f at a place about the turn's centre, and its gradient there."""
    (x, y, z), (gx, gy, gz) = place, gradient
    j[0], j[1], j[2] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
    j[3], j[4], j[5] = gx, gy, gz
    for i in range(6):
        w = weight * j[i]
        b[i] -= w * f
        for k in range(i + 1):
            h[i, k] += w * j[k]


@njit(inline="always", cache=True, nogil=True, error_model="numpy", fastmath=True)
def _weight(f, scale, along):
    """Of an equation: Geman–McClure; none where hidden surface faces another way or lies deep."""
    if f <= 0.0 and (f < -DEEPEST_BEHIND * scale or along < PULL_FACING):
        return 0.0
    w = scale * scale / (f * f + scale * scale)
    return w * w if f > 0.0 else PULL * w * w


@njit(inline="always", cache=True, nogil=True, error_model="numpy", fastmath=True)
def _both(pair, r, p, scale, cap, h, b, j):
    """Equations of both views at a pose; mean of what is in free space, and of what agrees.

    The other view's points move by (r, p) into the frame of the first one's.
    """
    points, normals, others, other_normals, field, other_field, cells = pair
    n, c = np.float32(cells), np.float32(0.5 * (cells - 1))
    for i in range(6):
        b[i] = 0.0
        for k in range(6):
            h[i, k] = 0.0
    free, agreed = 0.0, 0.0
    for q in range(others.shape[0]):
        u, v, w = others[q, 0], others[q, 1], others[q, 2]
        x = r[0, 0] * u + r[0, 1] * v + r[0, 2] * w
        y = r[1, 0] * u + r[1, 1] * v + r[1, 2] * w
        z = r[2, 0] * u + r[2, 1] * v + r[2, 2] * w
        f, gx, gy, gz = field_at(
            np.float32(x + p[0]) + c, np.float32(y + p[1]) + c, np.float32(z + p[2]) + c,
            field, n, n, n,
        )  # fmt: skip
        u, v, w = other_normals[q, 0], other_normals[q, 1], other_normals[q, 2]
        along = gx * (r[0, 0] * u + r[0, 1] * v + r[0, 2] * w)
        along += gy * (r[1, 0] * u + r[1, 1] * v + r[1, 2] * w)
        along += gz * (r[2, 0] * u + r[2, 1] * v + r[2, 2] * w)
        free += min(max(float(f), 0.0), cap)
        if abs(f) < scale and along > PULL_FACING:
            agreed += 1.0 - abs(f) / scale
        weight = _weight(float(f), scale, along)
        if weight > 0.0:
            _row((x, y, z), (float(gx), float(gy), float(gz)), float(f), weight, h, b, j)
    for q in range(points.shape[0]):
        # in the other's frame, where the other is at rest
        u, v, w = points[q, 0] - p[0], points[q, 1] - p[1], points[q, 2] - p[2]
        f, ex, ey, ez = field_at(
            np.float32(r[0, 0] * u + r[1, 0] * v + r[2, 0] * w) + c,
            np.float32(r[0, 1] * u + r[1, 1] * v + r[2, 1] * w) + c,
            np.float32(r[0, 2] * u + r[1, 2] * v + r[2, 2] * w) + c,
            other_field, n, n, n,
        )  # fmt: skip
        gx = r[0, 0] * ex + r[0, 1] * ey + r[0, 2] * ez
        gy = r[1, 0] * ex + r[1, 1] * ey + r[1, 2] * ez
        gz = r[2, 0] * ex + r[2, 1] * ey + r[2, 2] * ez
        along = gx * normals[q, 0] + gy * normals[q, 1] + gz * normals[q, 2]
        free += min(max(float(f), 0.0), cap)
        if abs(f) < scale and along > PULL_FACING:
            agreed += 1.0 - abs(f) / scale
        weight = _weight(float(f), scale, along)
        if weight > 0.0:
            _row((u, v, w), (-gx, -gy, -gz), float(f), weight, h, b, j)
    count = points.shape[0] + others.shape[0]
    return free / cap / count, agreed / count


@njit(cache=True, nogil=True, parallel=True, error_model="numpy", fastmath=True)
def reconcile(pair, rotations, places, scales, cap, reach):
    """Move every pose downhill, one Gauss–Newton step for each scale; in place.

    Returns (k, 2) the mean of what stands in free space, up to the cap and as its share, and of
    what agrees.
    """
    scores = np.empty((len(rotations), 2))
    for k in prange(len(rotations)):
        r, p = rotations[k], places[k]
        h, b, j = np.empty((6, 6)), np.empty(6), np.empty(6)
        for step in range(len(scales)):
            _both(pair, r, p, scales[step], cap, h, b, j)
            step_down(r, p, h, b, PAIR_DAMPING, 1e-9, WIDEST_PAIR_RAD, reach)
        scores[k, 0], scores[k, 1] = _both(pair, r, p, scales[-1], cap, h, b, j)
    return scores
