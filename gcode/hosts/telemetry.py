"""Counters of a link: lines, resends, stalls, round trips; constant memory for any job."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

_FIRST_S = 1e-6
_DELAY_STEP = math.log(1.05)
_DELAY_CLASSES = 400
"""From 1 µs upwards in steps of 5 %: the last bucket begins at 280 s."""


class RoundTrips:
    """A histogram of times on a logarithmic scale; percentiles are right to 5 %."""

    def __init__(self) -> None:
        self._counts = np.zeros(_DELAY_CLASSES, dtype=np.int64)
        self.count = 0

    def add(self, seconds: Sequence[float]) -> None:
        """Count round trips."""
        times_s = np.maximum(np.asarray(seconds, dtype=np.float64), _FIRST_S)
        buckets = np.minimum(
            (np.log(times_s / _FIRST_S) / _DELAY_STEP).astype(np.intp), _DELAY_CLASSES - 1
        )
        self._counts += np.bincount(buckets, minlength=_DELAY_CLASSES)
        self.count += len(seconds)

    def percentile_s(self, percent: float) -> float:
        """Return the round trip that `percent` of all do not exceed; 0 without any."""
        wanted, seen = self.count * percent / 100.0, 0
        for index, count in enumerate(self._counts.tolist()):
            seen += count
            if count and seen >= wanted:
                return float(_FIRST_S * math.exp((index + 0.5) * _DELAY_STEP))
        return 0.0

    def summary_s(self) -> tuple[float, float, float]:
        """Return percentiles 50, 95 and 99."""
        return self.percentile_s(50.0), self.percentile_s(95.0), self.percentile_s(99.0)
