"""Greedy coreset selection: the k-centre loop of PatchCore, compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit


@njit(cache=True, fastmath=True)
def farthest_first(features, count, first):  # type: ignore[no-untyped-def]
    """Indices of `count` rows of (n, d) float32, each farthest from those before it."""
    n, d = features.shape
    nearest = np.full(n, np.float32(np.inf))
    chosen = np.empty(count, np.int64)
    last = first
    for k in range(count):
        chosen[k] = last
        farthest, far = 0, np.float32(-1.0)
        for i in range(n):
            total = np.float32(0.0)
            for j in range(d):
                gap = features[i, j] - features[last, j]
                total += gap * gap
            nearest[i] = min(nearest[i], total)
            if nearest[i] > far:
                far = nearest[i]
                farthest = i
        last = farthest
    return chosen
