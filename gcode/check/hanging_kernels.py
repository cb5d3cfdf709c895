# mypy: disable-error-code="no-untyped-def"
"""What holds beads along moves, over a height field that grows by what is laid; compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit
from gcode.surfaces.standing_kernels import across_row, columns_of, height_over, rows_of

IN_AIR, ON_FLOOR, HELD_FAST = 0, 1, 2
FREE_END, TOO_LONG, BENT = 1, 2, 3
SAME_PASS_MM = 0.015  # lower than this passes do not lie: what is laid now holds nothing beside it


@njit(inner=True, cache=True, nogil=True)
def top_of(stands, newest, iy, ix, z):
    """How high a column is for a bead at a height: what its own pass has laid does not count."""
    if newest[iy, ix] <= z - SAME_PASS_MM:
        return max(stands[iy, ix], newest[iy, ix])
    return stands[iy, ix]


@njit(inner=True, cache=True, nogil=True)
def hold_at(stands, newest, loose, near, x, y, z, origin, cell, deep, drop):
    """What holds a bead at a place: something beside or below it, the floor alone, or nothing."""
    ny, nx = stands.shape
    cx, cy = int(np.floor((x - origin[0]) / cell)), int(np.floor((y - origin[1]) / cell))
    found = IN_AIR
    for n in range(len(near)):
        iy, ix = cy + near[n, 0], cx + near[n, 1]
        inside = iy >= 0 and ix >= 0 and iy < ny and ix < nx
        top = top_of(stands, newest, iy, ix, z) if inside else 0.0  # beyond it lies the bed
        if top >= z - deep:
            if not (inside and loose[iy, ix]):
                return HELD_FAST
            found = ON_FLOOR
        elif n == 0 and top >= z - drop:
            found = ON_FLOOR
    return found


@njit(inner=True, cache=True, nogil=True)
def lay(stands, newest, loose, a, b, half, fell, origin, cell):
    """A bead as what stands there from the next pass on; what fell holds nothing."""
    ny, nx = stands.shape
    first, last = rows_of(a[1], b[1], half, origin[1], cell, ny)
    for iy in range(first, last):
        y = origin[1] + (iy + 0.5) * cell
        x_low, x_high = across_row(a[0], a[1], b[0], b[1], half, y)
        for ix in range(*columns_of(x_low, x_high, origin[0], cell, nx)):
            x = origin[0] + (ix + 0.5) * cell
            z = height_over(a[0], a[1], a[2], b[0], b[1], b[2], half, x, y)
            if z > newest[iy, ix] + SAME_PASS_MM:
                stands[iy, ix] = max(stands[iy, ix], newest[iy, ix])
                newest[iy, ix] = z
            loose[iy, ix] |= fell and stands[iy, ix] < z - SAME_PASS_MM


@njit(cache=True, nogil=True)
def follow(start, end, laid, half, stands, origin, cell, near, limits):
    """Which moves end a stretch over air that is not as it must be.

    Parameters: (n, 3) start and end, (n,) whether plastic is laid and half its width; the field
    (ny, nx) of what stands there, which is raised; (c, 2) rows and columns of what is beside a
    bead, its own first; limits: how deep below the tip something holds it, how deep it lies on the
    floor, the longest stretch over air, its shortest chord over its length, up to which length that
    is not asked, how far a bead may hang from one end, mm between samples.
    Returns (n,) what is wrong, 0 where nothing is, and (n,) how long the stretch is.
    """
    n = len(laid)
    deep, drop, longest, straight, bends, tip, step = limits
    wrong, length = np.zeros(n, np.int64), np.zeros(n)
    newest = np.full(stands.shape, -np.inf)
    loose = np.zeros(stands.shape, np.bool_)
    hangs, held_before, held_first, run, x0, y0 = False, False, False, 0.0, 0.0, 0.0
    for k in range(n):
        dx, dy, dz = end[k, 0] - start[k, 0], end[k, 1] - start[k, 1], end[k, 2] - start[k, 2]
        long = np.hypot(dx, dy)
        follows = k > 0 and laid[k - 1] and laid[k]
        follows = follows and np.abs(start[k] - end[k - 1]).max() < 1e-6
        if not follows:
            if hangs and run > tip:
                wrong[k - 1], length[k - 1] = FREE_END, run
            hangs, held_before = False, False
        if not laid[k] or long < 1e-9:
            continue
        fell = True
        count = int(np.ceil(long / step))
        for i in range(count + 1):
            t = i / count
            x, y, z = start[k, 0] + t * dx, start[k, 1] + t * dy, start[k, 2] + t * dz
            hold = hold_at(stands, newest, loose, near, x, y, z, origin, cell, deep, drop)
            fell = fell and hold == ON_FLOOR
            if hold == IN_AIR:
                if not hangs:
                    hangs, run, x0, y0, held_first = True, 0.0, x, y, held_before
                elif i > 0:
                    run += long / count
                continue
            if hangs:
                chord = np.hypot(x - x0, y - y0)
                if not (held_first and hold == HELD_FAST):
                    if run > tip:
                        wrong[k], length[k] = FREE_END, run
                elif run > bends and chord < straight * run:
                    wrong[k], length[k] = BENT, run
                elif run > longest:
                    wrong[k], length[k] = TOO_LONG, run
            hangs, held_before = False, hold == HELD_FAST
        lay(stands, newest, loose, start[k], end[k], half[k], fell, origin, cell)
    if hangs and run > tip:
        wrong[n - 1], length[n - 1] = FREE_END, run
    return wrong, length
