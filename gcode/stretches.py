"""Stretches of a sequence over which something holds; and pieces of segments, in their order."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int


def stretches_of(holds: Bool[np.ndarray, " n"]) -> list[tuple[int, int]]:
    """First place of each stretch of true, and the one after its last.

    Examples
    --------
    >>> import numpy as np
    >>> from gcode.stretches import stretches_of
    >>> stretches_of(np.array([True, True, False, True]))
    [(0, 2), (3, 4)]
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def in_turn(count: Int[np.ndarray, " n"]) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """So many of each, one after the other: (m,) whose each is, and its number among those.

    Examples
    --------
    >>> import numpy as np
    >>> from gcode.stretches import in_turn
    >>> [each.tolist() for each in in_turn(np.array([2, 0, 1]))]
    [[0, 0, 2], [0, 1, 0]]
    """
    owner = np.repeat(np.arange(len(count)), count)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)


def places_along(
    start_mm: Float[np.ndarray, "n k"], end_mm: Float[np.ndarray, "n k"], step_mm: float
) -> tuple[Float[np.ndarray, "m k"], Int[np.ndarray, " m"]]:
    """(m, k) middles of equal pieces of each segment, no longer than a step; and whose each is."""
    length_mm = np.linalg.norm(end_mm - start_mm, axis=1)
    count = np.maximum(1, np.ceil(length_mm / step_mm).astype(np.int64))
    owner, number = in_turn(count)
    share = (number + 0.5) / count[owner]
    return start_mm[owner] + (end_mm - start_mm)[owner] * share[:, None], owner


def places_to_ends(
    start_mm: Float[np.ndarray, "n k"], end_mm: Float[np.ndarray, "n k"], step_mm: float
) -> tuple[Float[np.ndarray, "m k"], Int[np.ndarray, " m"]]:
    """(m, k) both ends of each segment, and equal steps no longer than one; and whose each is."""
    count = np.ceil(np.linalg.norm(end_mm - start_mm, axis=1) / step_mm).astype(np.int64) + 1
    owner, number = in_turn(count)
    share = number / np.maximum(count[owner] - 1, 1)
    return start_mm[owner] + share[:, None] * (end_mm - start_mm)[owner], owner
