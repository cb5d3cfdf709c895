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
