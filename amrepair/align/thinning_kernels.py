# mypy: disable-error-code="no-untyped-def"
"""The first point of each voxel, and an order in which near points follow each other; compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit

_FIRST, _SECOND, _THIRD = 73_856_093, 19_349_663, 83_492_791  # Teschner et al. 2003


@njit(cache=True, nogil=True)
def first_of_voxels(points, low, voxel, most, slots, chosen):
    """How many voxels hold points, up to `most` + 1; their first points go to `chosen`.

    `slots` is a table of a power of two, larger than `most`; numbers of points, −1 where free.
    """
    slots[:] = -1
    mask = len(slots) - 1
    found = 0
    for i in range(len(points)):
        x = int((points[i, 0] - low[0]) / voxel)
        y = int((points[i, 1] - low[1]) / voxel)
        z = int((points[i, 2] - low[2]) / voxel)
        slot = ((x * _FIRST) ^ (y * _SECOND) ^ (z * _THIRD)) & mask
        known = False
        while slots[slot] >= 0:
            other = chosen[slots[slot]]
            if (
                int((points[other, 0] - low[0]) / voxel) == x
                and int((points[other, 1] - low[1]) / voxel) == y
                and int((points[other, 2] - low[2]) / voxel) == z
            ):
                known = True
                break
            slot = (slot + 1) & mask
        if known:
            continue
        if found == most:
            return found + 1
        slots[slot] = found
        chosen[found] = i
        found += 1
    return found


@njit(inner=True, cache=True, nogil=True)
def _spread_bits(v):
    """The 21 low bits of a number, two zeros after each."""
    v = (v | (v << 32)) & 0x1F00000000FFFF
    v = (v | (v << 16)) & 0x1F0000FF0000FF
    v = (v | (v << 8)) & 0x100F00F00F00F00F
    v = (v | (v << 4)) & 0x10C30C30C30C30C3
    return (v | (v << 2)) & 0x1249249249249249


@njit(cache=True, nogil=True)
def morton_keys(points, low, edge, bits):
    """(n,) numbers of the cubes that hold the points, along a Z-order curve (Morton 1966).

    Of `bits` along each axis, 21 at most.
    """
    keys = np.zeros(len(points), np.int64)
    most = (1 << bits) - 1
    for n in range(len(points)):
        for a in range(3):
            cell = min(int((points[n, a] - low[a]) / edge), most)
            keys[n] |= _spread_bits(cell) << a
    return keys
