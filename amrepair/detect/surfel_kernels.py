"""Loops over occupied cells and range images: compiled, no policy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def neighbour_table(keys: Any, stride_x: int, stride_y: int) -> Any:
    """(s, 27) index of the cell at each offset, −1 where it is empty.

    `keys` are sorted cell numbers ix·stride_x + iy·stride_y + iz. For one offset the sought keys
    rise with the cell, so one pointer per offset walks the list once.
    """
    n = keys.shape[0]
    table = np.full((n, 27), -1, np.int32)
    column = 0
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                offset = dx * stride_x + dy * stride_y + dz
                j = 0
                for i in range(n):
                    want = keys[i] + offset
                    while j < n and keys[j] < want:
                        j += 1
                    if j == n:
                        break
                    if keys[j] == want:
                        table[i, column] = j
                column += 1
    return table


@njit(cache=True, nogil=True)
def neighbour_sums(table: Any, values: Any) -> Any:
    """(s, c) sums of `values` over each cell and its neighbours."""
    n, channels = table.shape[0], values.shape[1]
    out = np.zeros((n, channels))
    for i in range(n):
        for k in range(table.shape[1]):
            j = table[i, k]
            if j >= 0:
                for c in range(channels):
                    out[i, c] += values[j, c]
    return out


@njit(cache=True, nogil=True)
def cell_sums(order: Any, start: Any, points: Any, deviation: Any) -> Any:
    """(s, 11) per cell: Σx Σy Σz Σf Σxx Σyy Σzz Σxy Σxz Σyz Σff about the cell's first point."""
    n = start.shape[0] - 1
    out = np.zeros((n, 11))
    for i in range(n):
        for k in range(start[i], start[i + 1]):
            p = order[k]
            x, y, z, f = points[p, 0], points[p, 1], points[p, 2], deviation[p]
            out[i, 0] += x
            out[i, 1] += y
            out[i, 2] += z
            out[i, 3] += f
            out[i, 4] += x * x
            out[i, 5] += y * y
            out[i, 6] += z * z
            out[i, 7] += x * y
            out[i, 8] += x * z
            out[i, 9] += y * z
            out[i, 10] += f * f
    return out


@njit(cache=True, nogil=True)
def fill_range_image(row: Any, column: Any, depth: Any, extra: Any, shape: Any) -> Any:
    """Nearest-surface mean depth per pixel, and the mean of `extra` over the same points.

    Two passes: the least depth of each pixel, then the mean of what lies within a millimetre of
    it, so that a pixel which straddles an edge keeps the near side.
    """
    near = np.full((shape[0], shape[1]), np.inf)
    for i in range(row.shape[0]):
        near[row[i], column[i]] = min(near[row[i], column[i]], depth[i])
    total = np.zeros((shape[0], shape[1]))
    side = np.zeros((shape[0], shape[1]))
    count = np.zeros((shape[0], shape[1]))
    for i in range(row.shape[0]):
        r, c = row[i], column[i]
        if depth[i] <= near[r, c] + 1.0:
            total[r, c] += depth[i]
            side[r, c] += extra[i]
            count[r, c] += 1.0
    for r in range(shape[0]):
        for c in range(shape[1]):
            if count[r, c] > 0:
                near[r, c] = total[r, c] / count[r, c]
                side[r, c] /= count[r, c]
    return near, side


@njit(cache=True, nogil=True)
def close_pinholes(depth: Any, extra: Any, least: int) -> Any:
    """Give an empty pixel the median of its neighbours where at least `least` of eight have one."""
    rows, columns = depth.shape
    out, side = depth.copy(), extra.copy()
    seen = np.empty(8)
    for r in range(rows):
        for c in range(columns):
            if np.isfinite(depth[r, c]):
                continue
            n, total = 0, 0.0
            for dr in range(-1, 2):
                for dc in range(-1, 2):
                    rr, cc = r + dr, c + dc
                    if 0 <= rr < rows and 0 <= cc < columns and np.isfinite(depth[rr, cc]):
                        seen[n] = depth[rr, cc]
                        total += extra[rr, cc]
                        n += 1
            if n >= least:
                out[r, c] = np.median(seen[:n])
                side[r, c] = total / n
    return out, side


@njit(cache=True, nogil=True)
def smooth_depth(depth: Any, limit: float) -> Any:
    """Mean over 3×3 of what lies within `limit` of the centre: noise falls, edges stay."""
    rows, columns = depth.shape
    out = depth.copy()
    for r in range(rows):
        for c in range(columns):
            here = depth[r, c]
            if not np.isfinite(here):
                continue
            total, n = 0.0, 0
            for dr in range(-1, 2):
                for dc in range(-1, 2):
                    rr, cc = r + dr, c + dc
                    if 0 <= rr < rows and 0 <= cc < columns and abs(depth[rr, cc] - here) <= limit:
                        # both sides of a pair or neither: a lone side would tilt a slope
                        r2, c2 = r - dr, c - dc
                        if (
                            0 <= r2 < rows
                            and 0 <= c2 < columns
                            and abs(depth[r2, c2] - here) <= limit
                        ):
                            total += depth[rr, cc]
                            n += 1
            if n > 0:
                out[r, c] = total / n
    return out


@njit(cache=True, nogil=True)
def look_up_depth(depth: Any, low: Any, extra: Any, u: Any, v: Any, blend: float) -> Any:
    """Depth at (row, column) places: bilinear where the four agree within `blend`, else nearest.

    Returns (depth, least depth of the 3×3 around, extra); −inf where there is no data.
    """
    n = u.shape[0]
    rows, columns = depth.shape
    out = np.full(n, -np.inf)
    least = np.full(n, -np.inf)
    side = np.zeros(n)
    for i in range(n):
        r, c = int(np.round(u[i])), int(np.round(v[i]))
        if r < 0 or c < 0 or r >= rows or c >= columns or not np.isfinite(depth[r, c]):
            continue
        out[i] = depth[r, c]
        least[i] = low[r, c]
        side[i] = extra[r, c]
        r0, c0 = int(np.floor(u[i])), int(np.floor(v[i]))
        if r0 < 0 or c0 < 0 or r0 + 1 >= rows or c0 + 1 >= columns:
            continue
        a, b = depth[r0, c0], depth[r0, c0 + 1]
        p, q = depth[r0 + 1, c0], depth[r0 + 1, c0 + 1]
        top, bottom = max(a, b, p, q), min(a, b, p, q)
        if np.isfinite(top) and top - bottom <= blend:
            fu, fv = u[i] - r0, v[i] - c0
            out[i] = (a * (1 - fv) + b * fv) * (1 - fu) + (p * (1 - fv) + q * fv) * fu
    return out, least, side


@njit(cache=True, nogil=True)
def least_of_nine(depth: Any) -> Any:
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
