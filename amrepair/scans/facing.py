"""Which way scanned points face: as the scan says, or as the points around them lie."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from amrepair.arrays import Numbers, Points
from amrepair.frames import box_of, in_box
from amrepair.scans.scan import Scan

MOST_AROUND = 100_000  # of a cloud without normals, among which neighbours are looked for
NEIGHBOURS_WITHIN_MM = 2.0  # and no farther around


def facing(scan: Scan, which: Numbers, *, neighbours: int) -> Points:
    """(k, 3) unit normals of some points, in the scan's frame.

    Outward where the scan has its own; else nobody knows which of a plane's sides is.

    Parameters
    ----------
    which
        (k,) indices of the points.
    neighbours
        Where the scan has no normals, so many of the nearest points tell the plane of each.
    """
    if scan.normals is not None or not len(which):
        return np.zeros((0, 3)) if scan.normals is None else scan.normals[which]
    low, high = box_of(scan.points_mm[which])
    within_mm = NEIGHBOURS_WITHIN_MM
    around = scan.points_mm[in_box(scan.points_mm, low - within_mm, high + within_mm)]
    around = around[:: -(-len(around) // MOST_AROUND)]
    near = cKDTree(around).query(
        scan.points_mm[which], k=range(1, min(neighbours, len(around)) + 1)
    )[1]
    apart = around[near] - around[near].mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))[1][:, :, 0]
