"""The cheapest labelling of voxels as solid or empty: a minimum cut."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Mask, Numbers, Points, Values
from amrepair.field import cut_kernels as kernels
from amrepair.field.space import VoxelGrid

# Capacities are whole numbers of this share of a nat; none is larger than that many.
UNIT_NATS, MOST_NATS = 0.01, 1e4


@dataclass(frozen=True, slots=True)
class Facets:
    """Where two voxels meet of which one is to be labelled: numbers, axis, middle.

    `one` lies before `other` on the axis; −1 is a voxel that is known to be empty.
    """

    one: Numbers
    other: Numbers
    axis: Numbers
    middle_mm: Points
    on_template: Mask


def facets_of(grid: VoxelGrid) -> Facets:
    """All facets of the voxels to be labelled, but for those on the box's own faces."""
    found = []
    for axis in range(3):
        first = tuple(slice(None, -1 if k == axis else None) for k in range(3))
        second = tuple(slice(1 if k == axis else None, None) for k in range(3))
        one, other = grid.number[first], grid.number[second]
        at = np.nonzero((one >= 0) | (other >= 0))
        middle_mm = grid.low_mm + (np.stack(at, axis=1) + 0.5) * grid.voxel_mm
        middle_mm[:, axis] += 0.5 * grid.voxel_mm
        surface = (grid.f_mm[first][at] < 0) != (grid.f_mm[second][at] < 0)
        found.append((one[at], other[at], np.full(len(at[0]), axis), middle_mm, surface))
    return Facets(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


@dataclass(frozen=True, slots=True)
class MinimumCut:
    """The cheapest labelling of voxels, a minimum cut; and those of other prices from there on.

    Of equally cheap ones that with the most solid: empty is what still reaches what is empty for
    certain once no more flow fits (Ford & Fulkerson 1956).

    Attributes
    ----------
    facets, nats
        Where two voxels meet, (k, 2) of each the price of `one` solid alone, and of `other` alone.
    told
        (v,) of each voxel that is empty.
    beside
        (v, 6) voxels before and behind on each axis, −1 where there is none.
    given
        (v,) what flow was to fit from what is solid or, negative, to what is empty, `UNIT_NATS`.
    fits, ends
        What still does: (v, 6) to each of them, (v,) from what is solid or to what is empty.
    empty
        (v,) whether each voxel is.
    """

    facets: Facets
    nats: Float[np.ndarray, "k 2"]
    told: Values
    beside: Int[np.ndarray, "v 6"]
    given: Numbers
    fits: Int[np.ndarray, "v 6"]
    ends: Numbers
    empty: Mask

    @classmethod
    def of(cls, facets: Facets, nats: Float[np.ndarray, "k 2"], told: Values) -> MinimumCut:
        """By what it costs where voxels meet, and what is told of each."""
        whole = facets.one, facets.other, facets.axis, _in_units(nats), len(told)
        beside, fits = kernels.joined(*whole)
        given = _in_units(told - _beyond(facets, nats, len(told)))
        ends = given.copy()
        empty = kernels.flow(beside, fits, ends) == kernels.EMPTY
        return cls(facets, nats, told, beside, given, fits, ends, empty)

    def dearer(self, nats: Float[np.ndarray, "k 2"], told: Values) -> MinimumCut:
        """The same where no surface costs less and some costs more: what flows goes on flowing."""
        facets, count = self.facets, len(told)
        more = _in_units(nats) - _in_units(self.nats)
        fits = self.fits + kernels.joined(facets.one, facets.other, facets.axis, more, count)[1]
        given = _in_units(told - _beyond(facets, nats, count))
        ends = self.ends + given - self.given
        empty = kernels.flow(self.beside, fits, ends) == kernels.EMPTY
        return replace(self, nats=nats, told=told, given=given, fits=fits, ends=ends, empty=empty)

    def surface_nats(self, empty: Mask) -> float:
        """What the surface of a labelling costs."""
        solid = np.append(~empty, False)
        one, other = solid[self.facets.one], solid[self.facets.other]
        return float(self.nats[one & ~other, 0].sum() + self.nats[other & ~one, 1].sum())


def _beyond(facets: Facets, nats: Float[np.ndarray, "k 2"], count: int) -> Values:
    """(v,) what a voxel costs that is solid where nothing is beyond it.

    What lies beyond is empty: solid ends here.
    """
    beyond = np.zeros(count)
    for mine, none, k in ((facets.one, facets.other, 0), (facets.other, facets.one, 1)):
        edge = (mine >= 0) & (none < 0)
        beyond += np.bincount(mine[edge], nats[edge, k], minlength=count)
    return beyond


def _in_units(nats: Float[np.ndarray, "*shape"]) -> Int[np.ndarray, "*shape"]:
    """Whole numbers of `UNIT_NATS`."""
    return np.round(np.clip(nats, -MOST_NATS, MOST_NATS) / UNIT_NATS).astype(np.int32)
