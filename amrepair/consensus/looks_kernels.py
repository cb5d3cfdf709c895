# mypy: disable-error-code="no-untyped-def"
"""Places held against a range image; compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def seen_through(points, normals, asked, sensor, axes, distance, pixel, first, least, outside,
                 within, edge_on, found):  # fmt: skip
    """Say of the places asked about whether the sensor saw through them; in `found`.

    `normals` is empty, or of surface there: what stands edge-on to the rays may be there unseen.
    """
    scale = distance / pixel
    rows, columns = least.shape
    has_normals = len(normals) > 0
    for q in prange(len(asked)):
        k = asked[q]
        x, y, z = points[k, 0] - sensor[0], points[k, 1] - sensor[1], points[k, 2] - sensor[2]
        reach = np.sqrt(x * x + y * y + z * z)
        if has_normals:
            along = abs(x * normals[k, 0] + y * normals[k, 1] + z * normals[k, 2])
            if along <= edge_on * reach:
                found[k] = False
                continue
        depth = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
        if depth <= 1e-6 * distance:
            found[k] = False  # behind the sensor nobody looked
            continue
        u = int(np.floor((axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z) / depth * scale))
        v = int(np.floor((axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z) / depth * scale))
        u -= first[0]
        v -= first[1]
        i, j = min(max(u, 0), rows - 1), min(max(v, 0), columns - 1)
        beyond = max(abs(u - i), abs(v - j))
        beside = (outside[i + 1, j + 1] + beyond) * pixel * reach / distance
        found[k] = beside > within or (
            beyond == 0 and np.isfinite(least[i, j]) and reach < least[i, j] - within
        )
