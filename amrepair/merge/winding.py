"""The winding number of what stands there: which side of a scanned surface a point is on.

A closed surface of oriented patches answers 1 inside and 0 outside, and something between where it
has a hole. It needs no rays, and no patch beside the point (Barill et al. 2018, "Fast winding
numbers for soups and clouds", eqs. 4 to 7, first order).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from amrepair.align.thinning_kernels import morton_keys
from amrepair.arrays import Mask, Points, Values
from amrepair.merge import winding_kernels as kernels

LEAF_MM = 1.5
CODE_BITS = 21  # leaves along each axis: as many as fit into one number
# A node is one dipole beyond this many of its radii (Barill et al. use 2).
BETA = 2.0
# A patch of area a, seen from beside, is a disc: below this share of √a it is not a point.
SOFT_RATIO = 0.35


@dataclass(frozen=True, slots=True)
class Shell:
    """Oriented patches in an octree.

    Attributes
    ----------
    place_mm
        (n, 3) centres, in the tree's order.
    vector_mm2
        (n, 3) outward normals times area.
    """

    place_mm: Points
    vector_mm2: Points
    _soft2: Values
    _child: Int[np.ndarray, "k 2"]
    _centre: Float[np.ndarray, "k 3"]
    _total: Float[np.ndarray, "k 3"]
    _radius: Float[np.ndarray, " k"]
    _leaf: Bool[np.ndarray, " k"]
    _root: tuple[int, int]

    @classmethod
    def of(cls, place_mm: Points, vector_mm2: Points) -> Shell:
        """Build the tree over patches."""
        area = np.linalg.norm(vector_mm2, axis=1)
        low = place_mm.min(axis=0) if len(place_mm) else np.zeros(3)
        code = morton_keys(np.ascontiguousarray(place_mm), low, LEAF_MM, CODE_BITS)
        order = np.argsort(code, kind="stable")
        code = code[order]
        place, vector = place_mm[order], np.ascontiguousarray(vector_mm2[order])
        weight = np.maximum(area[order], 1e-12)
        child, centre, total, radius = [], [], [], []
        leaf: list[Mask] = []
        below_place, below_weight = place, weight
        below_vector, below_radius = vector, np.zeros(len(place))
        below_start = 0
        while len(code):
            first = np.flatnonzero(np.r_[True, code[1:] != code[:-1]])
            end = np.r_[first[1:], len(code)]
            w, c, t, r = kernels.joined(
                first, end, below_place, below_weight, below_vector, below_radius
            )
            child.append(np.stack([first, end], axis=1) + below_start)
            centre.append(c)
            total.append(t)
            radius.append(r)
            leaf.append(np.full(len(first), len(leaf) == 0))
            # the next level joins these nodes
            below_start = sum(len(c) for c in centre[:-1])
            below_place, below_weight, below_vector, below_radius = c, w, t, r
            code = code[first] >> 3
            if len(first) <= 8:
                break
        if not centre:
            empty = np.zeros((0, 3))
            return cls(place, vector, area, np.zeros((0, 2), np.int64), empty, empty,
                       np.zeros(0), np.zeros(0, bool), (0, 0))  # fmt: skip
        count = sum(len(c) for c in centre)
        return cls(
            place_mm=np.ascontiguousarray(place),
            vector_mm2=vector,
            _soft2=(SOFT_RATIO**2) * area[order],
            _child=np.concatenate(child),
            _centre=np.concatenate(centre),
            _total=np.concatenate(total),
            _radius=np.concatenate(radius),
            _leaf=np.concatenate(leaf),
            _root=(count - len(centre[-1]), count),
        )

    def winding(self, points_mm: Float[np.ndarray, "q 3"]) -> Float[np.ndarray, " q"]:
        """(q,) 1 inside, 0 outside."""
        if len(self.place_mm) == 0 or len(points_mm) == 0:
            return np.zeros(len(points_mm))
        return np.asarray(
            kernels.windings(
                np.ascontiguousarray(points_mm), self.place_mm, self.vector_mm2, self._soft2,
                self._child, self._centre, self._total, self._radius, np.array(self._root),
                self._leaf, BETA,
            )
        )  # fmt: skip
