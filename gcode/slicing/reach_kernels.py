"""Whether the nozzle may be all along straight pieces, for `patch_beads`; compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def free_along(
    start: Any, end: Any, shares: Any, free: Any, origin: Any, cell: float, rounding: float
) -> Any:
    """(m,) whether all of the places asked about are free, outside the cells too.

    `start`, `end` (m, 2): pieces; `shares` (k,): where along them to ask; `free` (ny, nx) with its
    corner and cell. Each place counts as the four that rounding may make of it.
    """
    ny, nx = free.shape
    ok = np.ones(len(start), dtype=np.bool_)
    for piece in range(len(start)):
        for share in shares:
            x = start[piece, 0] + (end[piece, 0] - start[piece, 0]) * share
            y = start[piece, 1] + (end[piece, 1] - start[piece, 1]) * share
            for dx in (-rounding, rounding):
                ix = int(np.floor((x + dx - origin[0]) / cell))
                if ix < 0 or ix >= nx:
                    continue
                for dy in (-rounding, rounding):
                    iy = int(np.floor((y + dy - origin[1]) / cell))
                    if 0 <= iy < ny and not free[iy, ix]:
                        ok[piece] = False
            if not ok[piece]:
                break
    return ok
