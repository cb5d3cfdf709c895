"""Nearest points of a surface to places that move little: asked again only where they may differ.

It is exact. A place's nearest point stays the nearest while the place has moved by less than half
of what the next point lies farther off; and where no point was within a distance, none is nearer
than that less the move.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int
from scipy.spatial import cKDTree

from amrepair.arrays import Numbers, Points, Values

WIDER = 1.25  # asked so much farther than wanted: what is beyond may move a while, unasked


@dataclass(frozen=True, slots=True)
class KeptAnswers:
    """What a tree answered for some places, and for how long it holds.

    Attributes
    ----------
    reach_mm
        Points farther off are none.
    asked_mm
        (n, 3) where each place was when it was asked about.
    index
        (n,) its nearest point; the number of points where there is none.
    holds_mm
        (n,) that holds until it has moved so far.
    """

    tree: cKDTree
    reach_mm: float
    asked_mm: Points
    index: Numbers
    holds_mm: Values

    @classmethod
    def of(cls, tree: cKDTree, reach_mm: float, count: int) -> KeptAnswers:
        """Nothing yet, of so many places."""
        return cls(
            tree, reach_mm, np.zeros((count, 3)), np.full(count, tree.n), np.full(count, -1.0)
        )

    def nearest(self, places_mm: Points) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
        """(k,) numbers of the places with a point in reach, and (k,) those points'."""
        moved_mm = np.sqrt(((places_mm - self.asked_mm) ** 2).sum(axis=1))
        again = np.flatnonzero(moved_mm >= self.holds_mm)
        if len(again):
            wide_mm = WIDER * self.reach_mm
            distance, index = self.tree.query(
                places_mm[again], k=[1, 2], distance_upper_bound=wide_mm
            )
            first, second = np.minimum(distance, wide_mm).T
            none = index[:, 0] == self.tree.n
            self.asked_mm[again], self.index[again] = places_mm[again], index[:, 0]
            self.holds_mm[again] = np.where(none, wide_mm - self.reach_mm, 0.5 * (second - first))
        some = np.flatnonzero(self.index < self.tree.n)
        apart = places_mm[some] - self.tree.data[self.index[some]]
        some = some[(apart**2).sum(axis=1) < self.reach_mm**2]
        return some, self.index[some]
