"""Other pieces on the plate: what goes on beyond the part's reach and does not touch the part."""

from __future__ import annotations

import numpy as np

from amrepair.arrays import Mask, Points, Values
from amrepair.field.groups import GROUP_MM, group_points
from amrepair.observe.options import BackgroundOptions


def other_pieces(
    points_mm: Points, f_mm: Values, keep: Mask, low_z_mm: float, options: BackgroundOptions
) -> Mask:
    """(n,) points within reach of the part that hang together with a piece beyond it alone.

    A blob on the part touches it. A copy beside it does not, and only the near side of the copy
    lies within `most_excess_mm`: told as excess, it would be a sheet that ends in mid-air.

    Parameters
    ----------
    points_mm, f_mm, keep
        (n, 3) in the template's frame, distance to it, and whether a point is no background.
    low_z_mm
        The part's lowest plane: what lies below its band is the bed, which all pieces touch.
    """
    found = np.zeros(len(points_mm), bool)
    beyond = (f_mm > options.most_excess_mm) & (points_mm[:, 2] > low_z_mm + options.band_mm)
    beyond &= f_mm <= options.most_excess_mm + 2.0 * GROUP_MM
    near = keep & (f_mm > options.band_mm)
    if not beyond.any() or not near.any():
        return found
    which = np.flatnonzero(beyond | near)
    piece = group_points(points_mm[which])
    goes_on, touches = (np.bincount(piece, each[which]) > 0 for each in (beyond, f_mm <= GROUP_MM))
    found[which] = (goes_on & ~touches)[piece]
    return found & keep
