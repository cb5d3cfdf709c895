"""LZF decompression, as point clouds of kind `binary_compressed` use it."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def lzf_decompress(data: Any, size: int) -> Any:
    """`size` bytes out of an LZF stream; an array shorter than `size` says that it is corrupt.

    A control byte below 32 announces that many + 1 literals; else its top three bits (7: and the
    next byte) + 2 are a length and the rest with the next byte a distance back, less one.
    """
    out = np.zeros(size, np.uint8)
    i, o, n = 0, 0, data.shape[0]
    while i < n:
        control = int(data[i])
        i += 1
        if control < 32:
            count = control + 1
            if i + count > n or o + count > size:
                return out[:o]
            for _ in range(count):
                out[o] = data[i]
                o += 1
                i += 1
            continue
        length = control >> 5
        if length == 7:
            if i >= n:
                return out[:o]
            length += int(data[i])
            i += 1
        if i >= n:
            return out[:o]
        back = o - ((control & 31) << 8) - int(data[i]) - 1
        i += 1
        length += 2
        if back < 0 or o + length > size:
            return out[:o]
        for _ in range(length):
            out[o] = out[back]
            o += 1
            back += 1
    return out[:o]
