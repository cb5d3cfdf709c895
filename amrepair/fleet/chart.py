"""A control chart that needs no normal errors: does this printer lack more here than it used to?

Volumes that are missing are zero for most looks and have a long tail, so that a mean and its
sigmas say little. What is charted is whether a look lacks more than the k-th largest of the first
looks: on a printer that stays as it was, that happens with a probability that is Beta distributed
over baselines, whatever the volumes' own distribution. A Bernoulli CUSUM adds these up, and its
limit is the lowest whose chance of a false alarm over the stated number of looks, averaged over
baselines, is at most the stated one; that chance is computed, not simulated.

References
----------
Reynolds and Stoumbos 1999, A CUSUM chart for monitoring a proportion when inspecting continuously.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.stats import beta


@dataclass(frozen=True, slots=True)
class ChartOptions:
    """What the chart promises.

    Attributes
    ----------
    baseline
        Looks that say what is usual; before them there is no chart.
    largest
        What lacks more than the k-th largest of them is counted: of sound looks about one in ten.
    false_alarm, looks
        The chance of any alarm over so many looks after the baseline of a printer that stays as
        it was. Each printer and height band has a chart, so that ten of them have ten such chances.
    up
        What a look that is counted adds; others take 1 away: the sum rises where more than one in
        three are counted.
    """

    baseline: int = 20
    largest: int = 2
    false_alarm: float = 0.01
    looks: int = 100
    up: int = 2


@dataclass(frozen=True, slots=True)
class Chart:
    """A series and what the chart says of it.

    Attributes
    ----------
    level_mm3
        What is counted as more than usual; NaN before the baseline is complete.
    sums
        The CUSUM after each look past the baseline.
    limit
        From here on it is an alarm.
    alarm_at
        Number of the first look with an alarm; None where there is none.
    since
        Number of the look since which it has risen, where there is an alarm.
    """

    level_mm3: float
    sums: tuple[int, ...]
    limit: int
    alarm_at: int | None
    since: int | None


def chart(values_mm3: Sequence[float], options: ChartOptions | None = None) -> Chart:
    """The chart of one printer's looks at one height, oldest first."""
    options = options or ChartOptions()
    n, limit = options.baseline, limit_of(options)
    if len(values_mm3) < n:
        return Chart(float("nan"), (), limit, None, None)
    level = float(np.sort(np.asarray(values_mm3[:n], dtype=np.float64))[-options.largest])
    sums, total, since = [], 0, n
    alarm_at: int | None = None
    started = n
    for number, value in enumerate(values_mm3[n:], start=n):
        if total == 0:
            since = number
        total = max(0, total + (options.up if value > level else -1))
        sums.append(total)
        if alarm_at is None and total >= limit:
            alarm_at, started = number, since
    return Chart(level, tuple(sums), limit, alarm_at, None if alarm_at is None else started)


@lru_cache
def limit_of(options: ChartOptions) -> int:
    """The lowest limit that keeps the promise."""
    limit = options.up
    while false_alarm_ratio(limit, options) > options.false_alarm:
        limit += 1
    return limit


def false_alarm_ratio(limit: int, options: ChartOptions) -> float:
    """Chance of an alarm over `looks`, averaged over baselines.

    The next value is above the k-th largest of n with a chance p ~ Beta(k, n + 1 − k), for any
    continuous distribution; ties only make it less.
    """
    n, k = options.baseline, options.largest
    nodes, weights = np.polynomial.legendre.leggauss(80)
    p = 0.5 * (nodes + 1.0)
    alarms = alarm_ratio(p, limit, options)
    return float(0.5 * np.sum(weights * beta.pdf(p, k, n + 1 - k) * alarms))


def alarm_ratio(
    p: Float[np.ndarray, " q"], limit: int, options: ChartOptions
) -> Float[np.ndarray, " q"]:
    """(q,) chance that the sum reaches the limit within `looks`, by chance p of one that counts."""
    at = np.zeros((len(p), limit))  # the chance of each sum below the limit
    at[:, 0] = 1.0
    alarmed = np.zeros(len(p))
    for _ in range(options.looks):
        after = np.zeros_like(at)
        after[:, :-1] += (1.0 - p)[:, None] * at[:, 1:]
        after[:, 0] += (1.0 - p) * at[:, 0]
        reaching = max(limit - options.up, 0)
        after[:, options.up :] += p[:, None] * at[:, :reaching]
        alarmed += p * at[:, reaching:].sum(axis=1)
        at = after
    return alarmed
