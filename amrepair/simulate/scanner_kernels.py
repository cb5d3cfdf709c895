# mypy: disable-error-code="no-untyped-def"
"""Rays against columns: first hits, and the surface as a sensor of finite resolution sees it.

A ray walks the grid (Amanatides and Woo, 1987) over a flat map of the world. The first hit is then
moved along its ray to where the solid share of a small box (three columns wide, `2·half_z` high)
is one half: the sensor's spot. A plane of any slope stays where it is, on average over the
columns' staircase; edges are rounded by about half the box.
"""

from __future__ import annotations

import numpy as np

from amrepair.simulate.columns_kernels import TOUCH_MM
from gcode.compiled import njit, prange

HALF_COLUMNS = 1.5  # half the spot's width, in columns
SEARCH_MM = 0.4  # how far along its ray a hit may move: the diagonal of the spot
BISECTIONS = 7  # 0.8 mm / 2^7 = 0.006 mm
BED, PART = 1, 2


@njit(inner=True, cache=True)
def share_solid(offsets, spans, ny, nx, x0, y0, cell, half_z, x, y, z):
    """Solid share of the box around a point; the bed is solid."""
    gx, gy = (x - x0) / cell, (y - y0) / cell
    low, high = z - half_z, z + half_z
    bed = min(max(0.0 - low, 0.0), 2 * half_z)
    total = 0.0
    for iy in range(int(np.floor(gy - HALF_COLUMNS)), int(np.floor(gy + HALF_COLUMNS)) + 1):
        wy = min(iy + 1.0, gy + HALF_COLUMNS) - max(float(iy), gy - HALF_COLUMNS)
        for ix in range(int(np.floor(gx - HALF_COLUMNS)), int(np.floor(gx + HALF_COLUMNS)) + 1):
            wx = min(ix + 1.0, gx + HALF_COLUMNS) - max(float(ix), gx - HALF_COLUMNS)
            length = bed
            if 0 <= iy < ny and 0 <= ix < nx:
                column = iy * nx + ix
                for m in range(offsets[column + 1] - 1, offsets[column] - 1, -1):
                    if spans[m, 1] <= low:
                        break
                    length += max(0.0, min(spans[m, 1], high) - max(spans[m, 0], low, 0.0))
            total += wx * wy * length
    return total / (4 * HALF_COLUMNS * HALF_COLUMNS * 2 * half_z)


@njit(inner=True, cache=True)
def first_hit(offsets, spans, top, z_top, x0, y0, cell, s, dx, dy, dz):
    """Parameter t of the first hit from s, by (dx, dy, dz) to the bed, and what it is."""
    ny, nx = top.shape
    t_in, t_out = 0.0, 1.0
    if s[2] > z_top:
        t_in = (z_top - s[2]) / dz
    for axis in range(2):  # clip to the window
        d = dx if axis == 0 else dy
        low = x0 if axis == 0 else y0
        high = low + (nx if axis == 0 else ny) * cell
        if d == 0.0:
            if s[axis] < low or s[axis] >= high:
                return 1.0, BED
            continue
        ta, tb = (low - s[axis]) / d, (high - s[axis]) / d
        t_in, t_out = max(t_in, min(ta, tb)), min(t_out, max(ta, tb))
    if t_in >= t_out:
        return 1.0, BED
    x, y = s[0] + t_in * dx, s[1] + t_in * dy
    ix = min(max(int((x - x0) / cell), 0), nx - 1)
    iy = min(max(int((y - y0) / cell), 0), ny - 1)
    step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    grow_x = cell / abs(dx) if dx != 0.0 else np.inf
    grow_y = cell / abs(dy) if dy != 0.0 else np.inf
    next_x = (x0 + (ix + (step_x > 0)) * cell - s[0]) / dx if dx != 0.0 else np.inf
    next_y = (y0 + (iy + (step_y > 0)) * cell - s[1]) / dy if dy != 0.0 else np.inf
    t = t_in
    while True:
        leave = min(next_x, next_y, t_out)
        z_enter, z_leave = s[2] + t * dz, s[2] + leave * dz
        if z_leave <= top[iy, ix]:
            column = iy * nx + ix
            for m in range(offsets[column + 1] - 1, offsets[column] - 1, -1):
                if spans[m, 1] < z_leave:
                    break
                if spans[m, 0] <= z_enter + TOUCH_MM:
                    if spans[m, 1] >= z_enter:
                        return t, PART
                    return (spans[m, 1] - s[2]) / dz, PART
        if leave >= t_out:
            return 1.0, BED
        t = leave
        if next_x <= next_y:
            ix += step_x
            next_x += grow_x
        else:
            iy += step_y
            next_y += grow_y
        if ix < 0 or iy < 0 or ix >= nx or iy >= ny:
            return 1.0, BED


# Rays are numbers, not arrays: with arrays in their loops these two took thrice as long to compile.
@njit(cache=True, parallel=True)
def cast(offsets, spans, top, x0, y0, cell, half_z, sensor, targets):
    """Hits (n, 3), outward unit normals (n, 3) and kinds (n,) of rays from a sensor to the bed."""
    n = len(targets)
    ny, nx = top.shape
    points = np.zeros((n, 3))
    normals = np.zeros((n, 3))
    kinds = np.zeros(n, dtype=np.int64)
    z_top = top.max() + 1e-6
    sx, sy, sz = sensor[0], sensor[1], sensor[2]
    for r in prange(n):
        dx, dy, dz = targets[r, 0] - sx, targets[r, 1] - sy, targets[r, 2] - sz
        t, kinds[r] = first_hit(offsets, spans, top, z_top, x0, y0, cell, sensor, dx, dy, dz)
        if kinds[r] == BED:
            points[r, 0], points[r, 1], points[r, 2] = targets[r, 0], targets[r, 1], targets[r, 2]
            normals[r, 2] = 1.0
            continue
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / length, dy / length, dz / length
        reach = t * length
        near, far = reach - SEARCH_MM, reach + SEARCH_MM
        x, y, z = sx + near * dx, sy + near * dy, sz + near * dz
        outside = share_solid(offsets, spans, ny, nx, x0, y0, cell, half_z, x, y, z)
        x, y, z = sx + far * dx, sy + far * dy, sz + far * dz
        inside = share_solid(offsets, spans, ny, nx, x0, y0, cell, half_z, x, y, z)
        if outside < 0.5 < inside:
            for _ in range(BISECTIONS):
                reach = 0.5 * (near + far)
                x, y, z = sx + reach * dx, sy + reach * dy, sz + reach * dz
                if share_solid(offsets, spans, ny, nx, x0, y0, cell, half_z, x, y, z) < 0.5:
                    near = reach
                else:
                    far = reach
            reach = 0.5 * (near + far)
        x, y, z = sx + reach * dx, sy + reach * dy, sz + reach * dz
        points[r, 0], points[r, 1], points[r, 2] = x, y, z
        size = 0.0
        for axis in range(3):
            ax, ay = (cell if axis == 0 else 0.0), (cell if axis == 1 else 0.0)
            az = half_z if axis == 2 else 0.0
            x, y, z = points[r, 0] + ax, points[r, 1] + ay, points[r, 2] + az
            plus = share_solid(offsets, spans, ny, nx, x0, y0, cell, half_z, x, y, z)
            x, y, z = x - 2 * ax, y - 2 * ay, z - 2 * az
            minus = share_solid(offsets, spans, ny, nx, x0, y0, cell, half_z, x, y, z)
            normals[r, axis] = (minus - plus) / (ax + ay + az)
            size += normals[r, axis] ** 2
        size = np.sqrt(size)
        if size > 0.0:
            for axis in range(3):
                normals[r, axis] /= size
        else:
            normals[r, 0], normals[r, 1], normals[r, 2] = -dx, -dy, -dz
    return points, normals, kinds


@njit(cache=True, parallel=True)
def unhidden(offsets, spans, top, x0, y0, cell, eye, points, tolerance):
    """Whether a second eye, above everything, sees points (n, 3) of the surface as well."""
    n = len(points)
    seen = np.zeros(n, dtype=np.bool_)
    z_top = top.max() + 1e-6
    ex, ey, ez = eye[0], eye[1], eye[2]
    for r in prange(n):
        wx, wy, wz = points[r, 0] - ex, points[r, 1] - ey, points[r, 2] - ez
        far = ez / -wz
        dx, dy, dz = ex + wx * far - ex, ey + wy * far - ey, ez + wz * far - ez
        t, _ = first_hit(offsets, spans, top, z_top, x0, y0, cell, eye, dx, dy, dz)
        reach = t * np.sqrt(dx * dx + dy * dy + dz * dz)
        seen[r] = reach >= np.sqrt(wx * wx + wy * wy + wz * wz) - tolerance
    return seen
