"""In which order beads are laid, and where loops begin.

Nearest next within an island; a loop's seam goes to its sharpest inward corner, or else to the
corner nearest to the seam of the layer below, so that seams line up.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gcode.slicing.beads import Bead

CORNER_RAD = 0.6  # turns sharper than this hide a seam


def seam_index(
    loop: Float[np.ndarray, "n 2"], aim_mm: Float[np.ndarray, " 2"], *, inward: bool = True
) -> int:
    """Vertex of an open-ended loop (first point not repeated) at which to begin.

    Parameters
    ----------
    aim_mm
        Where the seam should be near (the seam below).
    """
    ahead = np.roll(loop, -1, axis=0) - loop
    behind = loop - np.roll(loop, 1, axis=0)
    turn = np.arctan2(
        behind[:, 0] * ahead[:, 1] - behind[:, 1] * ahead[:, 0], (behind * ahead).sum(axis=1)
    )
    distance = np.hypot(*(loop - aim_mm).T)
    # millimetres that a corner is worth: an inward one hides the seam best
    worth = np.where(turn < -CORNER_RAD, 3.0 if inward else 1.5, 0.0)
    worth = np.where(turn > CORNER_RAD, 1.5, worth)
    return int(np.argmin(distance - worth))


def nearest_first(
    beads: list[Bead], start_mm: Float[np.ndarray, " 2"], *, keep_seams: bool = False
) -> list[Bead]:
    """Greedy order: the next bead is the one whose end is nearest; loops open there."""
    left = list(range(len(beads)))
    out: list[Bead] = []
    here = np.asarray(start_mm, float)
    heads = np.array([bead.xy_mm[0] for bead in beads]).reshape(-1, 2)
    tails = np.array([bead.xy_mm[-1] for bead in beads]).reshape(-1, 2)
    alive = np.ones(len(beads), bool)
    while left:
        to_head = np.where(alive, ((heads - here) ** 2).sum(axis=1), np.inf)
        to_tail = np.where(alive, ((tails - here) ** 2).sum(axis=1), np.inf)
        i = int(np.argmin(np.minimum(to_head, to_tail)))
        bead = beads[i]
        if bead.closed:
            if not keep_seams:
                ring = bead.xy_mm[:-1]
                bead = bead.started_at(int(np.argmin(((ring - here) ** 2).sum(axis=1))))
        elif to_tail[i] < to_head[i]:
            bead = bead.reversed()
        out.append(bead)
        here = bead.xy_mm[-1]
        alive[i] = False
        left.pop()
    return out
