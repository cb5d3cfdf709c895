"""Places on a round bed, which fills the box that its profile tells."""

from __future__ import annotations

import math
from collections.abc import Sequence


def kept_on(
    at_mm: Sequence[float],
    corner_mm: Sequence[float],
    size_mm: Sequence[float],
    inset_mm: float,
    *,
    to_edge: bool = False,
) -> tuple[float, float]:
    """A place, or the one in its direction from the middle that is so far inside the bed's edge.

    Parameters
    ----------
    corner_mm, size_mm
        Of the box around the bed: least X and Y, and how far it goes.
    to_edge
        It is taken there from within, too.
    """
    middle = [low + 0.5 * side for low, side in zip(corner_mm[:2], size_mm, strict=True)]
    radii = [0.5 * side - inset_mm for side in size_mm]
    towards = [(v - m) / r for v, m, r in zip(at_mm[:2], middle, radii, strict=True)]
    out = math.hypot(*towards)
    if out == 0.0 or (out <= 1.0 and not to_edge):
        return at_mm[0], at_mm[1]
    x, y = (m + r * t / out for m, r, t in zip(middle, radii, towards, strict=True))
    return x, y
