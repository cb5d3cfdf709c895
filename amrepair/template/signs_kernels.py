# mypy: disable-error-code="no-untyped-def"
"""Signs handed on within the blocks of a grid; compiled."""

from __future__ import annotations

from gcode.compiled import njit, prange


@njit(cache=True, nogil=True, parallel=True)
def spread(size, known, step):
    """Give neighbours the sign of a node whose distance is larger than the step, in place."""
    count, r = size.shape[0], size.shape[1]
    for b in prange(count):
        changed = True
        while changed:
            changed = False
            for i in range(r):
                for j in range(r):
                    for k in range(r):
                        sign = known[b, i, j, k]
                        if sign == 0 or size[b, i, j, k] <= step:
                            continue
                        for a in range(6):
                            x = i + (a == 0) - (a == 1)
                            y = j + (a == 2) - (a == 3)
                            z = k + (a == 4) - (a == 5)
                            if x < 0 or y < 0 or z < 0 or x >= r or y >= r or z >= r:
                                continue
                            if known[b, x, y, z] == 0:
                                known[b, x, y, z] = sign
                                changed = True
