"""What is worth a repair: pieces of a deficit weighed together where they are one defect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from amrepair.deficit.compute import BEAD_MM3

# Heat beside the wound must be worth it: the stop has been made for the scan. It is a bead 11 mm
# long, half of the least that skipped lines leave; clean prints show less (`bench_clean.py`).
MIN_REPAIR_MM3 = 1.0
# Lines that rays went through are surer than a shallow hollow, and what a line lacks is never less
# than some of its length: 2 mm of one of 0.4 × 0.2 mm. A clean look's crumbs, up to 0.17 mm³ each
# and 0.9 mm³ together where a printed layer's lines lie rough, are below.
LINE_MM3, MIN_SKIPPED_MM3 = 0.15, 0.6
# What lies this near to a defect belongs to it.
ONE_DEFECT_MM = 1.0


def defect_volumes(
    boxes_mm: Sequence[Float[np.ndarray, "2 3"]],
    volumes_mm3: Sequence[float],
    skipped: Sequence[bool],
) -> Float[np.ndarray, " n"]:
    """Volume of the defect that each piece belongs to.

    Skipped beads that cross leave several pieces side by side: one defect. Those that rays went
    through have one cause, wherever they lie: the extruder slipped. Crumbs join nothing: what is
    below what a bead fills and, of lines far apart, below `LINE_MM3`.

    Parameters
    ----------
    boxes_mm, volumes_mm3
        Box and volume of each piece.
    skipped
        Whether lines of the job are gone in it.

    Returns
    -------
    numpy.ndarray
        (n,) mm³; a crumb's is 0.
    """
    volume = np.asarray(volumes_mm3, dtype=np.float64)
    whole = np.zeros(len(volume))
    bead = np.flatnonzero(volume >= BEAD_MM3)
    if len(bead) == 0:
        return whole
    box = np.stack([np.asarray(boxes_mm[int(k)]) for k in bead])
    low, high = box[:, 0], box[:, 1] + ONE_DEFECT_MM
    near = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2)
    line = np.asarray(skipped, dtype=bool)[bead] & (volume[bead] >= LINE_MM3)
    near |= line[:, None] & line[None]
    groups, group = connected_components(csr_matrix(near), directed=False)
    whole[bead] = np.bincount(group, weights=volume[bead], minlength=groups)[group]
    return whole


def worth_mending(
    boxes_mm: Sequence[Float[np.ndarray, "2 3"]],
    volumes_mm3: Sequence[float],
    skipped: Sequence[bool],
) -> Bool[np.ndarray, " n"]:
    """(n,) pieces of a defect that is worth a repair; see `defect_volumes`.

    Of lines that are gone that is one of `MIN_SKIPPED_MM3`, of anything else of `MIN_REPAIR_MM3`.
    """
    least_mm3 = np.where(np.asarray(skipped, dtype=bool), MIN_SKIPPED_MM3, MIN_REPAIR_MM3)
    return np.asarray(defect_volumes(boxes_mm, volumes_mm3, skipped) >= least_mm3)
