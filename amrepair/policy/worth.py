"""What is worth a repair: pieces of a deficit weighed together where they are one defect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from amrepair.arrays import Box, Mask, Values
from amrepair.policy.options import USUAL_POLICY, PolicyOptions
from amrepair.regions import Label, Region


def defect_volumes(
    boxes_mm: Sequence[Box],
    volumes_mm3: Sequence[float],
    skipped: Sequence[bool],
    options: PolicyOptions = USUAL_POLICY,
) -> Values:
    """Volume of the defect that each piece belongs to.

    Skipped beads that cross leave several pieces side by side: one defect. Those that rays went
    through have one cause, wherever they lie: the extruder slipped. Crumbs join nothing: what is
    below what a bead fills and, of lines far apart, below `line_mm3`.

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
    bead = np.flatnonzero(volume >= options.crumb_mm3)
    if len(bead) == 0:
        return whole
    box = np.stack([np.asarray(boxes_mm[int(k)]) for k in bead])
    low, high = box[:, 0], box[:, 1] + options.one_defect_mm
    near = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2)
    line = np.asarray(skipped, dtype=bool)[bead] & (volume[bead] >= options.line_mm3)
    near |= line[:, None] & line[None]
    groups, group = connected_components(csr_matrix(near), directed=False)
    whole[bead] = np.bincount(group, weights=volume[bead], minlength=groups)[group]
    return whole


def worth_mending(
    boxes_mm: Sequence[Box],
    volumes_mm3: Sequence[float],
    skipped: Sequence[bool],
    options: PolicyOptions = USUAL_POLICY,
) -> Mask:
    """(n,) pieces of a defect that is worth a repair; see `defect_volumes`."""
    least_mm3 = np.where(
        np.asarray(skipped, dtype=bool), options.least_skipped_mm3, options.least_mm3
    )
    return np.asarray(defect_volumes(boxes_mm, volumes_mm3, skipped, options) >= least_mm3)


def to_fill(regions: Sequence[Region], options: PolicyOptions = USUAL_POLICY) -> tuple[Region, ...]:
    """Missing regions that are worth a repair: alone, or with those beside them."""
    missing = [region for region in regions if region.label is Label.MISSING]
    keep = worth_mending(
        [r.box_mm for r in missing],
        [r.volume_mm3 for r in missing],
        [r.skipped for r in missing],
        options,
    )
    return tuple(region for region, kept in zip(missing, keep, strict=True) if kept)


def volume_mm3(regions: Sequence[Region]) -> float:
    """Volume of some regions together."""
    return float(sum(region.volume_mm3 for region in regions))


def too_much(
    regions: Sequence[Region], layer_mm: float, options: PolicyOptions = USUAL_POLICY
) -> tuple[Region, ...]:
    """Regions in excess that stand out."""
    return tuple(
        region
        for region in regions
        if region.label is Label.EXCESS
        and region.volume_mm3 >= options.least_excess_mm3
        and region.depth_mm >= options.excess_layers * layer_mm
    )
