"""In which order beads are laid, and where loops begin.

Nearest next within an island; a loop's seam goes to an inward corner, the nearest to the seam of
the layer below, or else to the nearest corner or point, so that seams line up.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gcode.slicing import order_kernels as kernels
from gcode.slicing.beads import Bead
from gcode.slicing.options import PartOptions


def seamed(bead: Bead, aim_mm: Float[np.ndarray, " 2"], options: PartOptions) -> Bead:
    """A loop that begins at its seam, near the seam below; an open bead as it is."""
    if not bead.closed:
        return bead
    x, y = float(aim_mm[0]), float(aim_mm[1])
    corner = options.corner_rad, options.inward_mm, options.other_mm
    return bead.started_at(int(kernels.seam_at(bead.xy_mm[:-1], x, y, *corner)))


def nearest_first(beads: list[Bead], start_mm: Float[np.ndarray, " 2"]) -> list[Bead]:
    """Greedy order: the next bead is the one whose end is nearest; loops begin where they do."""
    heads = np.array([bead.xy_mm[0] for bead in beads]).reshape(-1, 2)
    tails = np.array([bead.xy_mm[-1] for bead in beads]).reshape(-1, 2)
    closed = np.array([bead.closed for bead in beads], dtype=bool)
    x, y = float(start_mm[0]), float(start_mm[1])
    order, backward = kernels.nearest_next(heads, tails, closed, x, y)
    return [
        beads[k].reversed() if turned else beads[k]
        for k, turned in zip(order.tolist(), backward.tolist(), strict=True)
    ]
