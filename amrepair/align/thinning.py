"""Fewer points, evenly over space."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from amrepair.align.thinning_kernels import first_of_voxels, morton_keys
from amrepair.arrays import Numbers, Points
from amrepair.frames import box_of

MOST_THINNED = 200_000
THINNING_ROUNDS, CLOSE_ENOUGH = 12, 0.95
ORDER_BITS = 7  # 128 cubes along the longest side


def thin_out(points_mm: Points, count: int, rng: np.random.Generator) -> Float[np.ndarray, "m 3"]:
    """About `count` points, never more: one of each voxel, chosen by the generator."""
    if len(points_mm) <= count:
        return np.array(points_mm, dtype=np.float64)
    order = rng.permutation(len(points_mm))[: max(MOST_THINNED, count)]
    shuffled = np.ascontiguousarray(points_mm.take(order, axis=0), dtype=np.float64)
    low, high = box_of(shuffled)
    extent_mm = float((high - low).max())
    slots = np.empty(1 << int(np.ceil(np.log2(2 * count + 2))), dtype=np.int64)
    chosen = np.empty(count, dtype=np.int64)
    best = chosen[:0]
    # between a voxel that leaves too many and one that leaves enough; voxels of a surface grow in
    # number with the inverse square of their edge
    small, large = extent_mm / 1e5, extent_mm
    voxel_mm = max(extent_mm / np.sqrt(2.0 * count), 1e-9)
    for _ in range(THINNING_ROUNDS):
        found = int(first_of_voxels(shuffled, low, voxel_mm, count, slots, chosen))
        if found > count:
            small = voxel_mm
            voxel_mm = min(1.5 * voxel_mm, float(np.sqrt(small * large)))
            continue
        if found > len(best):
            best = chosen[:found].copy()
        if found >= CLOSE_ENOUGH * count:
            break
        large = voxel_mm
        guess = voxel_mm * np.sqrt((found + 1) / count)
        voxel_mm = float(guess if small < guess else np.sqrt(small * large))
    if not len(best):
        return shuffled[:count]
    return np.ascontiguousarray(shuffled[np.sort(best)])


@dataclass(frozen=True, slots=True)
class Thinned:
    """A cloud, and thinner ones of it, each made once: from the thinnest that has enough points.

    Attributes
    ----------
    points_mm
        (n, 3) in any frame.
    """

    points_mm: Points
    rng: np.random.Generator
    _made: dict[int, Float[np.ndarray, "_m 3"]] = field(default_factory=dict)

    def to(self, count: int) -> Float[np.ndarray, "m 3"]:
        """About `count` points, never more, in an order in which near ones follow each other."""
        if count not in self._made:
            enough = [made for most, made in self._made.items() if most > 2 * count]
            source = min(enough, key=len, default=self.points_mm)
            self._made[count] = in_order(thin_out(source, count, self.rng))
        return self._made[count]


def in_order(points_mm: Points) -> Points:
    """The points so that near ones follow each other: a field is asked in half the time."""
    return np.ascontiguousarray(points_mm[order_of(points_mm)])


def order_of(points_mm: Points) -> Numbers:
    """(n,) numbers of the points in an order in which near ones follow each other."""
    low, high = box_of(points_mm)
    edge_mm = max(float((high - low).max()), 1e-9) / (1 << ORDER_BITS)
    keys = morton_keys(np.ascontiguousarray(points_mm), low, edge_mm, ORDER_BITS)
    return np.asarray(np.argsort(keys, kind="stable"))
