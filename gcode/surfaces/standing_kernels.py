"""What beads stand as, cell by cell: the loops of `standing`; compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


@njit(inner=True, cache=True, nogil=True)
def across_row(ax: float, ay: float, bx: float, by: float, half: float, y: float) -> Any:
    """From where to where on a row at `y` lies within `half` of a stretch from a to b.

    Nothing does: the first is greater than the second. What does is convex: the ends' discs, and
    the strip between them.
    """
    low, high = np.inf, -np.inf
    for x, off in ((ax, y - ay), (bx, y - by)):
        if abs(off) <= half:
            wide = np.sqrt(half * half - off * off)
            low, high = min(low, x - wide), max(high, x + wide)
    dx, dy = bx - ax, by - ay
    length = np.hypot(dx, dy)
    if length <= 0.0:
        return low, high
    # the strip's four corners: where its edges cross the row
    nx, ny = -dy / length * half, dx / length * half
    for px, py, qx, qy in (
        (ax + nx, ay + ny, bx + nx, by + ny),
        (ax - nx, ay - ny, bx - nx, by - ny),
        (ax + nx, ay + ny, ax - nx, ay - ny),
        (bx + nx, by + ny, bx - nx, by - ny),
    ):
        if min(py, qy) <= y <= max(py, qy) and py != qy:
            x = px + (y - py) * (qx - px) / (qy - py)
            low, high = min(low, x), max(high, x)
    return low, high


@njit(inner=True, cache=True, nogil=True)
def height_over(
    ax: float,
    ay: float,
    az: float,
    bx: float,
    by: float,
    bz: float,
    half: float,
    x: float,
    y: float,
) -> float:
    """How high a bead stands over a place: its nozzle's greatest height within `half` of it."""
    dx, dy, dz = bx - ax, by - ay, bz - az
    square = dx * dx + dy * dy
    if square <= 0.0:
        return max(az, bz)
    along = ((x - ax) * dx + (y - ay) * dy) / square
    ox, oy = x - ax - along * dx, y - ay - along * dy
    more = np.sqrt(max(half * half - ox * ox - oy * oy, 0.0) / square)
    upward = along + more if dz >= 0.0 else along - more
    return az + dz * min(max(upward, 0.0), 1.0)


@njit(cache=True, nogil=True)
def raise_by_beads(z: Any, start: Any, end: Any, half: Any, low: Any, cell: float) -> None:
    """Raise heights (ny, nx) to what beads from `start` to `end` (n, 3) stand as.

    Each is `half` (n,) wide to a side; `low` is the corner of the cells.
    """
    ny, nx = z.shape
    for k in range(len(half)):
        ax, ay, az = start[k, 0], start[k, 1], start[k, 2]
        bx, by, bz = end[k, 0], end[k, 1], end[k, 2]
        first, last = rows_of(ay, by, half[k], low[1], cell, ny)
        for iy in range(first, last):
            y = low[1] + (iy + 0.5) * cell
            x_low, x_high = across_row(ax, ay, bx, by, half[k], y)
            for ix in range(*columns_of(x_low, x_high, low[0], cell, nx)):
                x = low[0] + (ix + 0.5) * cell
                z[iy, ix] = max(z[iy, ix], height_over(ax, ay, az, bx, by, bz, half[k], x, y))


@njit(inner=True, cache=True, nogil=True)
def rows_of(ay: float, by: float, half: float, low: float, cell: float, ny: int) -> Any:
    """First row whose middle a bead may cover, and the one after the last."""
    return columns_of(min(ay, by) - half, max(ay, by) + half, low, cell, ny)


@njit(inner=True, cache=True, nogil=True)
def columns_of(x_low: float, x_high: float, low: float, cell: float, nx: int) -> Any:
    """First cell whose middle lies between, and the one after the last."""
    if x_low > x_high:
        return 0, 0
    first = int(np.ceil((x_low - low) / cell - 0.5 - 1e-9))
    last = int(np.floor((x_high - low) / cell - 0.5 + 1e-9))
    return max(first, 0), min(last + 1, nx)
