"""Points in beads; compiled, for `skipped`."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit, prange


@njit(cache=True, nogil=True, parallel=True)
def in_beads(points: Any, start: Any, end: Any, width: Any, height: Any) -> Any:
    """(p,) whether a point lies in any bead: beside its line no farther than half its width.

    A bead hangs below its line, `start` to `end` (n, 3), by its height.
    """
    found = np.zeros(len(points), np.bool_)
    for p in prange(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        for n in range(len(start)):
            if z > max(start[n, 2], end[n, 2]) or z < min(start[n, 2], end[n, 2]) - height[n]:
                continue
            dx, dy = end[n, 0] - start[n, 0], end[n, 1] - start[n, 1]
            ax, ay = x - start[n, 0], y - start[n, 1]
            share = (ax * dx + ay * dy) / max(dx * dx + dy * dy, 1e-12)
            share = min(max(share, 0.0), 1.0)
            if np.hypot(ax - share * dx, ay - share * dy) <= 0.5 * width[n]:
                found[p] = True
                break
    return found
