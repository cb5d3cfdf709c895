"""Acceptance: which missing pieces are worth a repair, and which excess is too much.

A piece alone may be too small to count while it belongs to a larger defect. Pieces are therefore
grouped into defects first, and it is the volume of the whole defect that decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from amrepair.arrays import Box, Mask, Values
from amrepair.policy.options import DEFAULT_POLICY, PolicyOptions
from amrepair.regions import Label, Region


class Piece(NamedTuple):
    """One connected piece of missing material, as far as acceptance needs to know it.

    `skipped` says that whole lines of the job are missing in it.
    """

    box_mm: Box
    volume_mm3: float
    skipped: bool

    @classmethod
    def of(cls, region: Region) -> Piece:
        """From a measured region."""
        return cls(np.asarray(region.box_mm), region.volume_mm3, region.skipped)


def defect_volumes(pieces: Sequence[Piece], options: PolicyOptions = DEFAULT_POLICY) -> Values:
    """(n,) volume of the defect that each piece belongs to, mm³.

    Pieces within `one_defect_mm` of each other are one defect: crossing lines that were skipped
    leave several side by side. Pieces in which lines were skipped are one defect wherever they lie,
    since the slipping extruder is their common cause. A piece smaller than `crumb_mm3` belongs to
    no defect and gets 0; a skipped line smaller than `line_mm3` is not joined to distant ones.
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


def worth_mending(pieces: Sequence[Piece], options: PolicyOptions = DEFAULT_POLICY) -> Mask:
    """(n,) whether each piece belongs to a defect that is worth a repair (see `defect_volumes`)."""
    least_mm3 = np.where(_skipped(pieces), options.least_skipped_mm3, options.least_mm3)
    return np.asarray(defect_volumes(pieces, options) >= least_mm3)


def to_fill(
    regions: Sequence[Region], options: PolicyOptions = DEFAULT_POLICY
) -> tuple[Region, ...]:
    """The missing regions that are worth a repair, alone or together with others near them."""
    missing = [region for region in regions if region.label is Label.MISSING]
    keep = worth_mending([Piece.of(region) for region in missing], options)
    return tuple(region for region, kept in zip(missing, keep, strict=True) if kept)


def volume_mm3(regions: Sequence[Region]) -> float:
    """The summed volume of some regions."""
    return float(sum(region.volume_mm3 for region in regions))


def too_much(
    regions: Sequence[Region], layer_mm: float, options: PolicyOptions = DEFAULT_POLICY
) -> tuple[Region, ...]:
    """The regions of excess that are large and high enough to matter."""
    return tuple(
        region
        for region in regions
        if region.label is Label.EXCESS
        and region.volume_mm3 >= options.least_excess_mm3
        and region.depth_mm >= options.excess_layers * layer_mm
    )
