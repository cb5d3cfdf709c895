# mypy: disable-error-code="no-untyped-def"
"""Columns beside walls, held against planes through the walls' own points; for `walls`."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit

# Around a column, so many cells: as high as what stands there; on which side of it that is.
AROUND_CELLS, SIDE_CELLS = 2, 3
LEAST_WALL_POINTS = 8
# Millimetres of height per cell away: what is steeper is another surface.
STEEPEST_CELL_MM = 0.15
# No farther off a plane's ends may be told to lie on two sides of a column's middle: three standard
# deviations of the mean of some twenty points.
EVEN_ENDS_MM = 0.03


@njit(cache=True, nogil=True)
def plane_of(x, y, iy, ix, high, low, start, points, reach, radius):
    """(7,) of the points within a radius and two heights: mean, normal and spread along it.

    `points` (n, 3) are sorted by cell, `start` (ny, nx + 1) says where those of each cell begin.
    Spread is infinite where there are too few, or they are all on one line.
    """
    ny, nx = start.shape[0], start.shape[1] - 1
    found = np.zeros(7)
    found[6] = np.inf
    mean, second = np.zeros(3), np.zeros((3, 3))
    count = 0
    for row in range(max(iy - reach, 0), min(iy + reach + 1, ny)):
        for k in range(start[row, max(ix - reach, 0)], start[row, min(ix + reach + 1, nx)]):
            a, b, c = points[k, 0] - x, points[k, 1] - y, points[k, 2]
            if a * a + b * b > radius * radius or c > high or c < low:
                continue
            count += 1
            at = np.array((a, b, c - high))
            for m in range(3):
                mean[m] += at[m]
                for n in range(3):
                    second[m, n] += at[m] * at[n]
    if count < LEAST_WALL_POINTS:
        return found
    mean /= count
    for m in range(3):
        for n in range(3):
            second[m, n] = second[m, n] / count - mean[m] * mean[n]
    values, vectors = np.linalg.eigh(second)
    found[0], found[1], found[2] = x + mean[0], y + mean[1], high + mean[2]
    found[3:6] = vectors[:, 0]
    if values[1] > (0.25 * radius) ** 2:
        found[6] = np.sqrt(max(values[0], 0.0))
    return found


@njit(cache=True, nogil=True)
def sharpened(
    z, iy, ix, start, points, origin, cell, radius, below_top, over_foot, most_spread, most_slant
):
    """(q,) heights of the columns asked about, (q,) `iy` and `ix`.

    A column whose middle lies inside the plane of the wall beside it, at its top and at its foot,
    is as high as what stands around; outside, as low. Where a plane through it is upright but for
    its own error, the wall's middle decides.
    """
    ny, nx = z.shape
    out = np.empty(len(iy))
    reach = int(np.ceil(radius / cell))
    for q in range(len(iy)):
        i, j = iy[q], ix[q]
        out[q] = z[i, j]
        high, low = -np.inf, np.inf
        for row in range(max(i - AROUND_CELLS, 0), min(i + AROUND_CELLS + 1, ny)):
            for column in range(max(j - AROUND_CELLS, 0), min(j + AROUND_CELLS + 1, nx)):
                high, low = max(high, z[row, column]), min(low, z[row, column])
        x, y = origin[0] + (j + 0.5) * cell, origin[1] + (i + 0.5) * cell
        plane = plane_of(
            x, y, i, j, high - below_top, low + over_foot, start, points, reach, radius
        )
        if plane[6] > most_spread or abs(plane[5]) > most_slant:
            continue
        # from what is high towards what is low
        middle = 0.5 * (high + low)
        way, count = np.zeros((2, 2)), np.zeros(2)
        for row in range(max(i - SIDE_CELLS, 0), min(i + SIDE_CELLS + 1, ny)):
            for column in range(max(j - SIDE_CELLS, 0), min(j + SIDE_CELLS + 1, nx)):
                side = 1 if z[row, column] > middle else 0
                count[side] += 1
                way[side, 0] += column
                way[side, 1] += row
        if count[0] == 0 or count[1] == 0:
            continue
        gx, gy = way[0] / count[0] - way[1] / count[1]
        along = plane[3] * gx + plane[4] * gy
        if abs(along) < 0.5 * np.hypot(gx, gy):
            continue
        turn = 1.0 if along > 0 else -1.0
        level = plane[3] * (x - plane[0]) + plane[4] * (y - plane[1])
        at_top = turn * (level + plane[5] * (high - plane[2]))
        at_foot = turn * (level + plane[5] * (low - plane[2]))
        if (at_top > 0) != (at_foot > 0):
            if max(abs(at_top), abs(at_foot)) > EVEN_ENDS_MM:
                continue
            at_top = turn * level
        if (at_top > 0) == (z[i, j] <= middle):
            continue
        found = False
        for row in range(max(i - 1, 0), min(i + 2, ny)):
            for column in range(max(j - 1, 0), min(j + 2, nx)):
                if (z[row, column] <= middle) == (at_top > 0):
                    out[q] = max(out[q], z[row, column]) if found else z[row, column]
                    found = True
        if not found:
            out[q] = low if at_top > 0 else high
    return out


@njit(cache=True, nogil=True)
def extended(z, iy, ix, sound, reach, least, spread):
    """(q,) heights of the columns asked about, on planes through what is sound around each.

    `iy`, `ix` (q,); `sound` (ny, nx): columns that a plane goes through, within `reach` cells and
    no steeper than `STEEPEST_CELL_MM` from the one asked about. −∞ where there are fewer than
    `least`, or they are farther from their plane than `spread` on average.
    """
    ny, nx = z.shape
    out = np.full(len(iy), -np.inf)
    for q in range(len(iy)):
        i, j = iy[q], ix[q]
        second, first, square = np.zeros((3, 3)), np.zeros(3), 0.0
        for row in range(max(i - reach, 0), min(i + reach + 1, ny)):
            for column in range(max(j - reach, 0), min(j + reach + 1, nx)):
                away = np.hypot(row - i, column - j)
                off = z[row, column] - z[i, j]
                if (
                    not sound[row, column]
                    or away > reach
                    or abs(off) > STEEPEST_CELL_MM * (away + 1.0)
                ):
                    continue
                at = np.array((1.0, float(row - i), float(column - j)))
                for m in range(3):
                    first[m] += at[m] * off
                    for n in range(3):
                        second[m, n] += at[m] * at[n]
                square += off * off
        count = second[0, 0]
        if count < least or abs(np.linalg.det(second)) < count:
            continue
        plane = np.linalg.solve(second, first)
        if square - plane @ first <= spread * spread * count:
            out[q] = z[i, j] + plane[0]
    return out
