"""What is worth a repair: pieces of a deficit weighed together where they are one defect."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from amrepair.arrays import Box, Mask, Values
from amrepair.policy.options import USUAL_POLICY, PolicyOptions
from amrepair.regions import Label, Region


class Piece(NamedTuple):
    """What is weighed of a piece of a deficit.

    `skipped`: lines of the job are gone in it.
    """

    box_mm: Box
    volume_mm3: float
    skipped: bool

    @classmethod
    def of(cls, region: Region) -> Piece:
        """Of one that was measured."""
        return cls(np.asarray(region.box_mm), region.volume_mm3, region.skipped)


def defect_volumes(pieces: Sequence[Piece], options: PolicyOptions = USUAL_POLICY) -> Values:
    """(n,) volume of the defect that each piece belongs to, mm³; a crumb's is 0.

    Skipped beads that cross leave several pieces side by side: one defect. Those that rays went
    through have one cause, wherever they lie: the extruder slipped. Crumbs join nothing: what is
    below what a bead fills and, of lines far apart, below `line_mm3`.
    """
    volume = np.array([piece.volume_mm3 for piece in pieces])
    whole = np.zeros(len(volume))
    bead = np.flatnonzero(volume >= options.crumb_mm3)
    if len(bead) == 0:
        return whole
    box = np.stack([pieces[int(k)].box_mm for k in bead])
    low, high = box[:, 0], box[:, 1] + options.one_defect_mm
    near = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2)
    line = _skipped(pieces)[bead] & (volume[bead] >= options.line_mm3)
    near |= line[:, None] & line[None]
    groups, group = connected_components(csr_matrix(near), directed=False)
    whole[bead] = np.bincount(group, weights=volume[bead], minlength=groups)[group]
    return whole


def _skipped(pieces: Sequence[Piece]) -> Mask:
    return np.array([piece.skipped for piece in pieces], dtype=bool)


def worth_mending(pieces: Sequence[Piece], options: PolicyOptions = USUAL_POLICY) -> Mask:
    """(n,) pieces of a defect that is worth a repair; see `defect_volumes`."""
    least_mm3 = np.where(_skipped(pieces), options.least_skipped_mm3, options.least_mm3)
    return np.asarray(defect_volumes(pieces, options) >= least_mm3)


def to_fill(regions: Sequence[Region], options: PolicyOptions = USUAL_POLICY) -> tuple[Region, ...]:
    """Missing regions that are worth a repair: alone, or with those beside them."""
    missing = [region for region in regions if region.label is Label.MISSING]
    keep = worth_mending([Piece.of(region) for region in missing], options)
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
