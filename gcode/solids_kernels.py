"""Places that are the same, by a table of what was seen so far; compiled, for `solids`."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def first_of_each(places: Any) -> tuple[Any, Any]:
    """(m,) first of each of the different (n, 3) whole numbers, and (n,) which of them each is."""
    size = 8
    while size < 2 * len(places):
        size *= 2
    slots = np.full(size, -1, np.int64)
    first, same = np.empty(len(places), np.int64), np.empty(len(places), np.int64)
    count = 0
    for i in range(len(places)):
        # odd numbers without pattern: products spread over all bits of a key
        key = np.uint64(places[i, 0]) * np.uint64(0x9E3779B97F4A7C15)
        key ^= np.uint64(places[i, 1]) * np.uint64(0xC2B2AE3D27D4EB4F)
        key ^= key >> np.uint64(29)
        key ^= np.uint64(places[i, 2]) * np.uint64(0x165667B19E3779F9)
        key *= np.uint64(0x9E3779B97F4A7C15)
        slot = np.int64(key >> np.uint64(32)) & (size - 1)
        while True:
            k = slots[slot]
            if k < 0:
                slots[slot] = count
                first[count] = i
                same[i] = count
                count += 1
                break
            j = first[k]
            if (
                places[j, 0] == places[i, 0]
                and places[j, 1] == places[i, 1]
                and places[j, 2] == places[i, 2]
            ):
                same[i] = k
                break
            slot = (slot + 1) & (size - 1)
    return first[:count].copy(), same
