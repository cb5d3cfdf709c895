# mypy: disable-error-code="no-untyped-def"
"""Votes of a scan's order on where one view ends and the next begins: compiled, no policy."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def weakest(first, last, apart, points, parts):
    """Boundaries to choose from: of each part of the order the one that parts the fewest pairs.

    Parameters
    ----------
    first, last
        (k,) points of one place that follow each other in the order.
    apart
        Pairs up to so far from each other in the order count.
    points, parts
        How many points there are, and in how many parts the order is cut.

    Returns
    -------
    tuple
        (parts,) the first point behind each boundary, in order, and how many pairs it parts; the
        first lies before all points.
    """
    opens = np.zeros(points + 1, np.int64)
    for k in range(len(first)):
        if last[k] - first[k] <= apart:
            opens[first[k] + 1] += 1
            opens[last[k] + 1] -= 1
    begins, parted = np.zeros(parts, np.int64), np.zeros(parts, np.int64)
    crossing, part, least = 0, -1, 0
    for i in range(points):
        crossing += opens[i]
        of = i * parts // points
        if of > part or crossing < least:
            begins[of], parted[of], least = i, crossing, crossing
        part = of
    parted[0] = begins[0] = 0
    return begins, parted


@njit(cache=True, nogil=True)
def together(first, last, apart, begins, points):
    """Pairs farther apart in the order that lie within each run of it.

    Returns
    -------
    array
        (m + 1, m + 1) for the run from the i-th boundary to before the j-th.
    """
    m = len(begins)
    of = np.zeros(points, np.int64)
    run = 0
    for i in range(points):
        while run + 1 < m and begins[run + 1] <= i:
            run += 1
        of[i] = run
    within = np.zeros((m + 1, m + 1), np.int64)
    for k in range(len(first)):
        if last[k] - first[k] > apart:
            within[of[first[k]], of[last[k]] + 1] += 1
    for i in range(m - 1, -1, -1):
        for j in range(1, m + 1):
            within[i, j] += within[i + 1, j] + within[i, j - 1] - within[i + 1, j - 1]
    return within


@njit(cache=True, nogil=True)
def least_contradicted(within, cost):
    """The boundaries of the runs that contradict the fewest votes, by dynamic programming.

    Parameters
    ----------
    within
        (m + 1, m + 1) pairs that contradict a run; see `together`.
    cost
        (m,) what each boundary costs.

    Returns
    -------
    array
        (v,) numbers of the boundaries that runs begin at, in order; the first is 0.
    """
    m = len(cost)
    least, came = np.full(m + 1, np.inf), np.zeros(m + 1, np.int64)
    least[0] = 0.0
    for j in range(1, m + 1):
        for i in range(j):
            told = least[i] + cost[i] + within[i, j]
            if told < least[j]:
                least[j], came[j] = told, i
    chosen, j = [came[m]], came[m]
    while j > 0:
        j = came[j]
        chosen.append(j)
    return np.array(chosen[::-1])
