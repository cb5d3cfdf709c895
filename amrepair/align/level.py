"""Level surfaces in a scan, as tops of layers: a print may stop at any height; its walls stay."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int
from scipy.spatial import cKDTree

from amrepair.align.options import LevelOptions
from amrepair.arrays import Points


def is_level(
    points_mm: Points, which: Int[np.ndarray, " k"], options: LevelOptions
) -> Bool[np.ndarray, " k"]:
    """(k,) which of some points lie on a level surface, as the tops of layers.

    Parameters
    ----------
    points_mm
        (n, 3) in a frame whose Z is up.
    which
        (k,) numbers of the points that are asked for.
    """
    count = min(options.neighbours, len(points_mm))
    near = points_mm[cKDTree(points_mm).query(points_mm[which], k=[*range(1, count + 1)])[1]]
    near = near - near.mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
    return np.asarray(np.abs(normal[:, 2]) >= np.cos(np.deg2rad(options.steepest_deg)))
