"""Metrics: areas under ROC and precision-recall curves, Chamfer and earth mover's distances.

Plain numpy and scipy, exact under ties. It knows nothing of data sets or methods.

References
----------
Fawcett, An introduction to ROC analysis, 2006 (AUROC as the Mann–Whitney statistic).
Davis and Goadrich, The relationship between Precision-Recall and ROC curves, 2006.
PASDF (arXiv 2505.24431), eq. (7): Chamfer distance; section 4: earth mover's distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from amrepair.arrays import Numbers, Points, Values
from amrepair.errors import InputError

# The bijection costs O(n³): 1,024 points take about 0.1 s.
EMD_POINTS = 1024


@dataclass(frozen=True, slots=True)
class Detection:
    """Both areas for one set of labels; NaN where the labels hold one class only.

    Attributes
    ----------
    auroc
        Probability that an anomalous item scores higher than a normal one, ties counting half.
    aupr
        Average precision: Σ (recall step) × precision, without interpolation.
    """

    auroc: float
    aupr: float


def _checked(
    labels: Shaped[np.ndarray, " n"], scores: Shaped[np.ndarray, " m"]
) -> tuple[Numbers, Float[np.ndarray, " m"]]:
    if labels.shape != scores.shape:
        raise InputError(f"there are {len(labels)} labels for {len(scores)} scores; give one each")
    values = np.asarray(scores, dtype=np.float64)
    bad = int(np.isnan(values).sum())
    if bad:
        raise InputError(f"{bad} of {len(values)} scores are NaN; a method must score every point")
    truth = np.asarray(labels)
    if not np.isin(truth, (0, 1)).all():
        raise InputError(f"labels must be 0 or 1, there is {np.setdiff1d(truth, (0, 1))[0]!r}")
    return truth.astype(np.int64), values


def _steps(labels: Numbers, scores: Values) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """True and false positives at each distinct threshold, highest first: ties move together."""
    order = np.argsort(-scores, kind="stable")
    falling = scores[order]
    last_of_tie = np.flatnonzero(np.append(falling[1:] != falling[:-1], True))
    hits = np.cumsum(labels[order])[last_of_tie]
    return hits, last_of_tie + 1 - hits


def detection(labels: Shaped[np.ndarray, " n"], scores: Shaped[np.ndarray, " m"]) -> Detection:
    """Both areas from one sort.

    Parameters
    ----------
    labels
        (n,) 0 normal, 1 anomalous.
    scores
        (n,) higher is more anomalous; infinities are allowed, NaN is not.

    Raises
    ------
    InputError
        If there is not one score for each label, a score is NaN, or a label neither 0 nor 1.
    """
    truth, values = _checked(labels, scores)
    positives = int(truth.sum())
    negatives = len(truth) - positives
    if positives == 0 or negatives == 0:
        return Detection(float("nan"), float("nan"))
    hits, alarms = _steps(truth, values)
    hit_steps = np.diff(hits, prepend=0).astype(np.float64)
    alarm_steps = np.diff(alarms, prepend=0).astype(np.float64)
    # By the trapezoid rule items with equal scores count half against each other.
    area = float((alarm_steps * (hits - hit_steps / 2)).sum())
    precision = hits / (hits + alarms)
    return Detection(
        auroc=area / positives / negatives,
        aupr=float((hit_steps * precision).sum() / positives),
    )


@dataclass(frozen=True, slots=True)
class CloudDistance:
    """Distances between two clouds, in their unit.

    Attributes
    ----------
    chamfer
        Mean nearest distance, both directions added: the scale of PASDF's printed CD.
    chamfer_squared
        The same with squared distances, as PASDF's eq. (7) has it.
    emd
        Mean distance under the best bijection of equally many points.
    to_surface, from_surface
        Mean distance of the first's points to the second's surface, and back; None where they are
        clouds without one.
    """

    chamfer: float
    chamfer_squared: float
    emd: float
    to_surface: float | None = None
    from_surface: float | None = None


def cloud_distance(
    first: Points, second: Float[np.ndarray, "m 3"], *, rng: np.random.Generator
) -> CloudDistance:
    """Chamfer on all points, earth mover's distance on a random subset of equal size."""
    if len(first) == 0 or len(second) == 0:
        raise InputError("the distance between clouds needs at least one point in each")
    forth = cKDTree(second).query(first)[0]
    back = cKDTree(first).query(second)[0]
    return CloudDistance(
        chamfer=float(forth.mean() + back.mean()),
        chamfer_squared=float((forth**2).mean() + (back**2).mean()),
        emd=earth_movers_distance(first, second, rng=rng),
    )


def earth_movers_distance(
    first: Points, second: Float[np.ndarray, "m 3"], *, rng: np.random.Generator
) -> float:
    """Mean distance under the optimal bijection of some points (`EMD_POINTS` at most)."""
    count = min(EMD_POINTS, len(first), len(second))
    a = first[np.sort(rng.permutation(len(first))[:count])]
    b = second[np.sort(rng.permutation(len(second))[:count])]
    cost = cdist(a, b)
    return float(cost[linear_sum_assignment(cost)].mean())


def mean_and_spread(values: Values) -> tuple[float, float]:
    """Mean and sample standard deviation of what is not NaN (spread 0 for a single value)."""
    known = values[~np.isnan(values)]
    if len(known) == 0:
        return float("nan"), float("nan")
    return float(known.mean()), float(known.std(ddof=1)) if len(known) > 1 else 0.0
