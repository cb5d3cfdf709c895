"""How much of a surface faces each way, and how much of that was seen; for `turning`."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def area_by_way(vectors: Any, seen: Any, ways: Any, alike: float) -> Any:
    """(d, 2) area that faces each way to within a cosine: all of it, and what was seen.

    `vectors` (m, 3) are normals times area, `ways` (d, 3) unit vectors.
    """
    out = np.zeros((len(ways), 2))
    for i in range(len(vectors)):
        x, y, z = vectors[i, 0], vectors[i, 1], vectors[i, 2]
        area = np.sqrt(x * x + y * y + z * z)
        for d in range(len(ways)):
            if x * ways[d, 0] + y * ways[d, 1] + z * ways[d, 2] > alike * area:
                out[d, 0] += area
                if seen[i]:
                    out[d, 1] += area
    return out


@njit(cache=True, nogil=True)
def signs_from_neighbours(start: Any, beside: Any, normal: Any) -> Any:
    """(q,) 1 or -1, so that normals agree from neighbour to neighbour, breadth first.

    `start` and `beside` are the rows of a symmetric sparse matrix.
    """
    sign = np.zeros(len(normal))
    queue = np.empty(len(normal), np.int64)
    for first in range(len(normal)):
        if sign[first] != 0.0:
            continue
        sign[first], queue[0], done, known = 1.0, first, 0, 1
        while done < known:
            j = queue[done]
            done += 1
            for at in range(start[j], start[j + 1]):
                k = beside[at]
                if sign[k] == 0.0:
                    cosine = 0.0
                    for a in range(3):
                        cosine += normal[k, a] * normal[j, a]
                    sign[k] = sign[j] if cosine >= 0.0 else -sign[j]
                    queue[known] = k
                    known += 1
    return sign
