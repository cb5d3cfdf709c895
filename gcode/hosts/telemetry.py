"""Counters of a link: lines, resends, stalls, round trips; constant memory for any job."""

from __future__ import annotations

import math

_FIRST_S = 1e-6
_STEP = math.log(1.05)
_BUCKETS = 400
"""From 1 µs upwards in steps of 5 %: the last bucket begins at 280 s."""


class RoundTrips:
    """A histogram of times on a logarithmic scale; percentiles are right to 5 %."""

    def __init__(self) -> None:
        self._counts = [0] * _BUCKETS
        self.count = 0

    def add(self, seconds: float) -> None:
        """Count one round trip."""
        index = int(math.log(seconds / _FIRST_S) / _STEP) if seconds > _FIRST_S else 0
        self._counts[index if index < _BUCKETS else _BUCKETS - 1] += 1
        self.count += 1

    def percentile_s(self, percent: float) -> float:
        """Return the round trip that `percent` of all do not exceed; 0 without any."""
        wanted, seen = self.count * percent / 100.0, 0
        for index, count in enumerate(self._counts):
            seen += count
            if count and seen >= wanted:
                return float(_FIRST_S * math.exp((index + 0.5) * _STEP))
        return 0.0

    def summary_s(self) -> tuple[float, float, float]:
        """Return percentiles 50, 95 and 99."""
        return self.percentile_s(50.0), self.percentile_s(95.0), self.percentile_s(99.0)
