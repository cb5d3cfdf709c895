# mypy: disable-error-code="no-untyped-def"
"""Columns beside walls, held against planes through the walls' own points; for `walls`."""

from __future__ import annotations

from typing import Any, NamedTuple

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
# Of a radius: the middle of the points that tell a floor lies no farther off the column's.
OFF_MIDDLE = 0.4


class PointsByCell(NamedTuple):
    """Points sorted by the cells of a grid: `points` (n, 3), and where those of each cell begin.

    `start` (ny, nx + 1) says that by row. Kernels unpack it.
    """

    start: Any
    points: Any


@njit(inner=True, cache=True, nogil=True)
def plane_of(x, y, iy, ix, high, low, cloud, reach, radius):
    """(7,) of the points within a radius and two heights: mean, normal and spread along it.

    Spread is infinite where there are too few, or they are all on one line.
    """
    start, points = cloud
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


@njit(inner=True, cache=True, nogil=True)
def ends_around(z, gone, i, j):
    """Highest and lowest of what stands around a column, and of that the lowest in what is gone."""
    ny, nx = z.shape
    high, low, foot = -np.inf, np.inf, np.inf
    for row in range(max(i - SIDE_CELLS, 0), min(i + SIDE_CELLS + 1, ny)):
        for column in range(max(j - SIDE_CELLS, 0), min(j + SIDE_CELLS + 1, nx)):
            if gone[row, column]:
                foot = min(foot, z[row, column])
            if max(abs(row - i), abs(column - j)) <= AROUND_CELLS:
                high, low = max(high, z[row, column]), min(low, z[row, column])
    return high, low, max(foot, low)


@njit(inner=True, cache=True, nogil=True)
def way_down(z, gone, i, j, middle, into_gone):
    """(2,) from what is higher than `middle` around a column to what is lower, columns and rows.

    With `into_gone`, only to that of it which something is missing from; zero where there is none.
    """
    ny, nx = z.shape
    way, count = np.zeros((2, 2)), np.zeros(2)
    for row in range(max(i - SIDE_CELLS, 0), min(i + SIDE_CELLS + 1, ny)):
        for column in range(max(j - SIDE_CELLS, 0), min(j + SIDE_CELLS + 1, nx)):
            side = 1 if z[row, column] > middle else 0
            if side == 0 and into_gone and not gone[row, column]:
                continue
            count[side] += 1
            way[side, 0] += column
            way[side, 1] += row
    if count[0] == 0 or count[1] == 0:
        return np.zeros(2)
    return way[0] / count[0] - way[1] / count[1]


@njit(cache=True, nogil=True)
def sharpened(
    z, gone, iy, ix, seen, broken, origin, cell, radius, below_top, over_foot, most_spread,
    most_slant,
):  # fmt: skip
    """(q,) heights of the columns asked about, (q,) `iy` and `ix`.

    A column whose middle lies inside the plane of the wall beside it, at its top and at its foot,
    is as high as what stands around; outside, as low. Where a plane through it is upright but for
    its own error, the wall's middle decides. `broken` are those of the points `seen` that lie on
    what broke: of a thin wall both faces are near, and only one of them bounds what is gone.
    """
    ny, nx = z.shape
    out = np.empty(len(iy))
    reach = int(np.ceil(radius / cell))
    for q in range(len(iy)):
        i, j = iy[q], ix[q]
        out[q] = z[i, j]
        high, low, foot = ends_around(z, gone, i, j)
        x, y = origin[0] + (j + 0.5) * cell, origin[1] + (i + 0.5) * cell
        top = high - below_top
        plane = plane_of(x, y, i, j, top, foot + over_foot, broken, reach, radius)
        is_broken = plane[6] <= most_spread and abs(plane[5]) <= most_slant
        if is_broken:
            low = foot
        else:
            plane = plane_of(x, y, i, j, top, low + over_foot, seen, reach, radius)
            if plane[6] > most_spread or abs(plane[5]) > most_slant:
                continue
        middle = 0.5 * (high + low)
        gx, gy = way_down(z, gone, i, j, middle, is_broken)
        along = plane[3] * gx + plane[4] * gy
        if abs(along) < 0.5 * np.hypot(gx, gy) or along == 0:
            continue
        turn = 1.0 if along > 0 else -1.0
        level = plane[3] * (x - plane[0]) + plane[4] * (y - plane[1])
        at_top = turn * (level + plane[5] * (high - plane[2]))
        at_foot = turn * (level + plane[5] * (low - plane[2]))
        if (at_top > 0) != (at_foot > 0):
            if not is_broken and max(abs(at_top), abs(at_foot)) > EVEN_ENDS_MM:
                continue
            at_top = turn * level
        if (at_top > 0) == (z[i, j] <= middle) or (is_broken and at_top <= 0 and not gone[i, j]):
            continue  # it is so already; or it lies beyond a thin wall
        found = False
        for row in range(max(i - 1, 0), min(i + 2, ny)):
            for column in range(max(j - 1, 0), min(j + 2, nx)):
                there = z[row, column]
                if (there <= middle) == (at_top > 0) and there >= low:
                    out[q] = max(out[q], there) if found else there
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


@njit(cache=True, nogil=True)
def floors(z, iy, ix, seen, origin, cell, radius, band, most_spread, steepest):
    """(q,) heights of the columns asked about, on planes through the points around each.

    Points within `radius` of a column's middle tell its floor if they lie around it, no farther
    from their plane than `most_spread` on average, and no more than `band` lower or higher than it
    is told to be, further as their distance. A column beside something higher keeps its height.
    """
    start, points = seen
    ny, nx = z.shape
    out = np.empty(len(iy))
    reach = int(np.ceil(radius / cell))
    far = band + radius
    for q in range(len(iy)):
        i, j = iy[q], ix[q]
        out[q] = z[i, j]
        x, y = origin[0] + (j + 0.5) * cell, origin[1] + (i + 0.5) * cell
        second, first, square, highest = np.zeros((3, 3)), np.zeros(3), 0.0, -np.inf
        for row in range(max(i - reach, 0), min(i + reach + 1, ny)):
            for k in range(start[row, max(j - reach, 0)], start[row, min(j + reach + 1, nx)]):
                a, b, off = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z[i, j]
                if a * a + b * b > radius * radius or off < -far:
                    continue
                highest = max(highest, off)
                at = np.array((1.0, a, b))
                for m in range(3):
                    first[m] += at[m] * off
                    for n in range(3):
                        second[m, n] += at[m] * at[n]
                square += off * off
        count = second[0, 0]
        aside = np.hypot(second[0, 1], second[0, 2])
        if count < LEAST_WALL_POINTS or highest > far or aside > OFF_MIDDLE * radius * count:
            continue
        if abs(np.linalg.det(second / count)) < (EVEN_ENDS_MM * radius) ** 2:
            continue  # they are on one line
        plane = np.linalg.solve(second, first)
        slope = np.hypot(plane[1], plane[2])
        if slope > steepest or abs(plane[0]) > band:
            continue
        along = most_spread * most_spread * (1.0 + slope * slope)
        if square - plane @ first <= along * (count - 3.0):
            out[q] = z[i, j] + plane[0]
    return out


@njit(inner=True, cache=True, nogil=True)
def nearest_over(cloud, x, y, i, j, over, under, reach, within):
    """How far from a place the nearest point between two heights lies, up to `within`."""
    start, points = cloud
    ny, nx = start.shape[0], start.shape[1] - 1
    nearest = within
    for row in range(max(i - reach, 0), min(i + reach + 1, ny)):
        for k in range(start[row, max(j - reach, 0)], start[row, min(j + reach + 1, nx)]):
            if over < points[k, 2] < under:
                nearest = min(nearest, np.hypot(points[k, 0] - x, points[k, 1] - y))
    return nearest


@njit(cache=True, nogil=True)
def carved(z, gone, may, seen, broken, origin, cell, over_foot, clear, spacing, least, reach, most):
    """(ny, nx) heights without what no point lies on, from what is gone inwards, column by column.

    A column beside a lower one that is gone would show a wall, as wide as it is far to the next
    point that is higher, and half a disc of its top. Where `least` points are expected there, one
    in `spacing`², and none lies, while broken surface lies within `reach` behind it, it is as low
    as that one. Nothing goes on through a wall: no point lies `clear` of the lower column. `may`
    says which columns are asked about; and `most` is how deep it goes, in columns.
    """
    ny, nx = z.shape
    z, gone, within = z.copy(), gone.copy(), reach * cell
    for _ in range(most):
        lower = z.copy()
        for i in range(1, ny - 1):
            for j in range(1, nx - 1):
                if not may[i, j]:
                    continue
                foot = z[i, j] - over_foot
                for a, b in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
                    if not gone[a, b] or z[a, b] >= foot:
                        continue
                    x, y = origin[0] + (b + 0.5) * cell, origin[1] + (a + 0.5) * cell
                    over = z[a, b] + over_foot
                    if nearest_over(seen, x, y, a, b, over, np.inf, 2, clear) >= clear:
                        foot = z[a, b]
                high = z[i, j] - foot - over_foot
                if high <= 0.0:
                    continue
                x, y = origin[0] + (j + 0.5) * cell, origin[1] + (i + 0.5) * cell
                over = foot + over_foot
                away = nearest_over(seen, x, y, i, j, over, np.inf, reach, within)
                if (2.0 * high + 0.5 * np.pi * away) * away < least * spacing * spacing:
                    continue
                top = z[i, j] - over_foot
                if nearest_over(broken, x, y, i, j, over, top, reach, np.inf) <= within:
                    lower[i, j] = foot
        went = lower < z
        if not went.any():
            break
        gone |= went
        z = lower
    return z
