# mypy: disable-error-code="no-untyped-def"
"""Plastic of beads in cells, and what of it finds no room behind a wall: loops, compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange

# Plastic over room from which there is a wall: a line of 0.15 mm, averaged over 0.6 mm.
WALL_RATIO = 0.25


@njit(cache=True, nogil=True)
def plastic(start, end, section, width, corner, cell, ny, nx):
    """(ny, nx) volume that beads lay in each cell, and the width of the widest of them there.

    A bead is a rectangle seen from above, `width` across; all of it is counted, in points of half
    a cell along it and an eighth across.
    """
    found, widest = np.zeros((ny, nx)), np.zeros((ny, nx))
    for k in range(len(section)):
        dx, dy = end[k, 0] - start[k, 0], end[k, 1] - start[k, 1]
        dz = end[k, 2] - start[k, 2]
        flat = np.sqrt(dx * dx + dy * dy)
        volume = section[k] * np.sqrt(flat * flat + dz * dz)
        along = max(1, int(np.ceil(flat / (0.5 * cell))))
        across = max(1, int(np.ceil(width[k] / (0.125 * cell))))
        part = volume / (along * across)
        ux, uy = (dx / flat, dy / flat) if flat > 1e-9 else (1.0, 0.0)
        aside = ((np.arange(across) + 0.5) / across - 0.5) * width[k]
        for i in range(along):
            t = (i + 0.5) / along
            x, y = start[k, 0] + t * dx, start[k, 1] + t * dy
            for j in range(across):
                ix = int(np.floor((x - aside[j] * uy - corner[0]) / cell))
                iy = int(np.floor((y + aside[j] * ux - corner[1]) / cell))
                if 0 <= ix < nx and 0 <= iy < ny:
                    found[iy, ix] += part
                    widest[iy, ix] = max(widest[iy, ix], width[k])
    return found, widest


@njit(cache=True, nogil=True)
def averaged(field, over):
    """(ny, nx) mean over so many cells each way, an odd number; nothing lies outside.

    Sums run along columns and rows, as those of `scipy.ndimage.uniform_filter`, to the last bit,
    without an array between them.
    """
    ny, nx = field.shape
    half = over // 2
    out = np.empty((ny, nx), np.float32)
    down, along, none = np.zeros(nx), np.zeros(nx + over), np.zeros(nx)
    for y in range(min(half + 1, ny)):
        down += field[y]
    for y in range(ny):
        if y > 0:
            new = field[y + half] if y + half < ny else none
            old = field[y - half - 1] if y > half else none
            for x in range(nx):
                down[x] += new[x] - old[x]
        for x in range(nx):
            along[half + x] = down[x] / over
        total = 0.0
        for x in range(over):
            total += along[x]
        out[y, 0] = total / over
        for x in range(1, nx):
            total += along[x + over - 1] - along[x - 1]
            out[y, x] = total / over
    return out


@njit(cache=True, nogil=True, inline="always")
def _at(field, gx, gy):
    """Between cell middles; 0 outside of the grid."""
    ny, nx = field.shape
    ix, iy = int(np.floor(gx)), int(np.floor(gy))
    if ix < 0 or iy < 0 or ix >= nx - 1 or iy >= ny - 1:
        return 0.0
    tx, ty = gx - ix, gy - iy
    return (
        field[iy, ix] * (1 - tx) * (1 - ty)
        + field[iy, ix + 1] * tx * (1 - ty)
        + field[iy + 1, ix] * (1 - tx) * ty
        + field[iy + 1, ix + 1] * tx * ty
    )


@njit(cache=True, nogil=True, parallel=True)
def at(field, corner, cell, place):
    """(q,) of a field at places."""
    out = np.empty(len(place))
    for k in prange(len(place)):
        out[k] = _at(
            field, (place[k, 0] - corner[0]) / cell - 0.5, (place[k, 1] - corner[1]) / cell - 0.5
        )
    return out


@njit(inner=True, cache=True, nogil=True)
def _without_room(fill, widest, corner, cell, x, y, ux, uy, flow, beside, reach):
    """Along one line inwards: most plastic without room, what of it is outside, first, widest."""
    ny, nx = fill.shape
    step = 0.5 * cell
    total, most, outside, first, wide = 0.0, 0.0, 0.0, -1.0, 0.0
    for i in range(-int(np.ceil(beside / step)), int(np.ceil(reach / step))):
        s = (i + 0.5) * step
        gx, gy = (x + s * ux - corner[0]) / cell - 0.5, (y + s * uy - corner[1]) / cell - 0.5
        f = _at(fill, gx, gy)
        if first < 0.0 and f >= WALL_RATIO:
            # averaged, a wall's edge shows a quarter of it so far before itself
            first = max(s + (0.5 - WALL_RATIO) * beside, 0.0)
        total += (flow * f - (1.0 if s > 0.0 else 0.0)) * step
        if s > 0.5 * beside:
            most = max(most, total)
        elif s < 0.0:
            outside = total
        if abs(s) < beside:
            ix, iy = int(np.floor(gx + 0.5)), int(np.floor(gy + 0.5))
            if 0 <= ix < nx and 0 <= iy < ny:
                wide = max(wide, widest[iy, ix])
    # averaging alone puts an eighth of its width of a full wall outside
    return most, max(outside - 0.125 * beside, 0.0), first, wide


@njit(cache=True, nogil=True, parallel=True)
def pushed_out(fill, widest, corner, cell, place, inward, flow, beside, reach, share):
    """How far out a wall may be pushed, and how far back its first plastic is, mm.

    `fill` is averaged over `beside`. From so far outside of the wall inwards, the plastic laid
    (times `flow`) less the room there is (1 inside, 0 outside) adds up; the most that it comes to
    on the way is what finds no room anywhere before the free side. It goes aside, too: the worst
    of three lines counts. The outermost bead gives way by no more than a `share` of its width,
    which is told by place. Where there is no wall (`WALL_RATIO`) it is `reach` away.
    """
    pushed, back = np.zeros(len(place)), np.zeros(len(place))
    for k in prange(len(place)):
        ux, uy = inward[k, 0], inward[k, 1]
        for side in (-1.0, 0.0, 1.0):
            most, outside, first, wide = _without_room(
                fill, widest, corner, cell, place[k, 0] - side * beside * uy,
                place[k, 1] + side * beside * ux, ux, uy, flow, beside, reach,
            )  # fmt: skip
            pushed[k] = max(pushed[k], min(most, outside + share[k] * wide))
            if side == 0.0 and (first < 0.0 or first > cell):
                back[k] = first if first >= 0.0 else reach
    return pushed, back
