"""Sites gathered into cells, and how many independent observations each cell is worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from amrepair.arrays import Numbers, Points, Values
from amrepair.frames import cells_of, unit_vectors

REACH_LENGTHS = 3.0  # exp(-3): what lies farther shares 5 % of its error and is left out
SPLITS = 4  # 2⁴ blocks: a sixteenth of the surface is more than most regions of defects

HALF_SLACK = 1e-12  # of a running sum: two halves are alike up to its rounding


@dataclass(frozen=True, slots=True)
class Cells:
    """What was observed, by cell.

    Attributes
    ----------
    place_mm, normal
        (n, 3) mean place and unit normal.
    deviation_mm
        (n,) weighted median of the deviations.
    view
        (n,) which view saw it.
    share
        (n,) how many independent observations it is worth, 0 to 1.
    """

    place_mm: Points
    normal: Points
    deviation_mm: Values
    view: Numbers
    share: Values


def gather(
    place_mm: Points,
    normal: Points,
    deviation_mm: Values,
    weight: Values,
    view: Numbers,
    *,
    side_mm: float,
    correlation_mm: float,
) -> Cells:
    """Return one observation a cell, view and side that the surface faces."""
    facing = np.argmax(np.abs(normal), axis=1)
    facing = facing + 3 * (normal[np.arange(len(normal)), facing] < 0)
    box = cells_of(place_mm, place_mm.min(axis=0), side_mm)
    sizes = (*(box.max(axis=0) + 1), 6, int(view.max()) + 1)
    key = np.ravel_multi_index((*box.T, facing, view), sizes)
    order = np.lexsort((deviation_mm, key))
    key, weight = key[order], weight[order]
    first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    total = np.add.reduceat(weight, first)
    reached = np.cumsum(weight)
    half = reached[first] - weight[first] + total / 2
    slack = HALF_SLACK * reached[-1]
    low, high = (np.searchsorted(reached, half + side) for side in (-slack, slack))
    by_weight = np.add.reduceat(weight[:, None] * place_mm[order], first) / total[:, None]
    facing_to = unit_vectors(np.add.reduceat(weight[:, None] * normal[order], first))
    seen_by = view[order][first]
    known = np.minimum(total / np.median(total), 1.0)  # few points: less is known
    return Cells(
        place_mm=by_weight,
        normal=facing_to,
        deviation_mm=(deviation_mm[order][low] + deviation_mm[order][high]) / 2,
        view=seen_by,
        share=known * independent_share(by_weight, seen_by, correlation_mm),
    )


def independent_share(place_mm: Points, view: Numbers, correlation_mm: float) -> Values:
    """Say how many independent observations each is worth among its neighbours.

    Errors of one view correlate by exp(−r / correlation_mm); a crowd whose correlations sum up
    to k says as much as one observation in k (effective sample size, Cressie 1993, 1.3).
    """
    together = np.ones(len(place_mm))
    if correlation_mm > 0:
        for k in np.unique(view):
            own = np.flatnonzero(view == k)
            tree = cKDTree(place_mm[own])
            pair = tree.query_pairs(REACH_LENGTHS * correlation_mm, output_type="ndarray")
            a, b = own[pair[:, 0]], own[pair[:, 1]]
            alike = np.exp(-np.linalg.norm(place_mm[a] - place_mm[b], axis=1) / correlation_mm)
            together += np.bincount(a, alike, len(together)) + np.bincount(b, alike, len(together))
    return 1 / together


def blocks(place_mm: Points) -> Numbers:
    """Return 2⁴ blocks of about as many places each, by halving the longest side."""
    block = np.zeros(len(place_mm), np.int64)
    for _ in range(SPLITS):
        after = block * 2
        for k in range(int(block.max()) + 1):
            own = np.flatnonzero(block == k)
            if len(own) < 2:
                continue
            axis = int(np.argmax(np.ptp(place_mm[own], axis=0)))
            order = own[np.argsort(place_mm[own, axis], kind="stable")]
            after[order[len(order) // 2 :]] += 1
        block = after
    return block
