# mypy: disable-error-code="no-untyped-def"
"""Order statistics over neighbouring cells that face the same way: compiled, no policy."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange

# Cells of a window of 3×3×3 with six ways to face; a surface crosses far fewer.
MOST_NEIGHBOURS = 64
# Slots for the way a cell faces (±x, ±y, ±z), in its key; a power of two.
SLOTS = 8
# median |x| of a normal value of standard deviation 1 (scipy.stats.norm.ppf(0.75))
NORMAL_MEDIAN = 0.674490
# median |a − b| of two normal values of standard deviation 1
PAIR_MEDIAN = 0.953873
# A plane: level and slope.
TREND_TERMS = 4
# Of a window's own spread: nothing beside what is in the surface, much across it.
RIDGE, TINY = 1e-3, 1e-9


@njit(cache=True, nogil=True)
def _median(values, n):
    """The median of the first n values."""
    ranked = np.sort(values[:n])
    half = n // 2
    return ranked[half] if n % 2 else 0.5 * (ranked[half - 1] + ranked[half])


@njit(cache=True, nogil=True)
def _alike(normal, value, i, j, cosine, aside):
    """Whether two cells face the same way, or both are more than `aside` off on the same side.

    The broken end of a thin wall is as near to one of its sides as to the other.
    """
    dot = normal[i, 0] * normal[j, 0] + normal[i, 1] * normal[j, 1] + normal[i, 2] * normal[j, 2]
    if dot > cosine:
        return True
    return min(value[i], value[j]) > aside or max(value[i], value[j]) < -aside


@njit(cache=True, nogil=True, parallel=True)
def neighbours(keys, stride_x, stride_y, normal, value, cosine, aside):
    """(s, MOST_NEIGHBOURS) cells around each, itself included; (s,) how many.

    `keys` are sorted cell numbers times SLOTS plus the way that the cell faces.
    """
    n = keys.shape[0]
    table = np.empty((n, MOST_NEIGHBOURS), np.int32)
    count = np.zeros(n, np.int32)
    for i in prange(n):
        found = 0
        cell = keys[i] // SLOTS
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                first = (cell + dx * stride_x + dy * stride_y - 1) * SLOTS
                j = np.searchsorted(keys, first)
                while j < n and keys[j] < first + 3 * SLOTS:
                    if found < MOST_NEIGHBOURS and (
                        j == i or _alike(normal, value, i, j, cosine, aside)
                    ):
                        table[i, found] = j
                        found += 1
                    j += 1
        count[i] = found
    return table, count


@njit(cache=True, nogil=True)
def _off_plane(place, value, table, count, i):
    """(n,) distances of a window's values from the plane through them by least squares."""
    n = count[i]
    matrix = np.zeros((TREND_TERMS, TREND_TERMS))
    right = np.zeros(TREND_TERMS)
    row = np.ones(TREND_TERMS)
    for k in range(n):
        j = table[i, k]
        for a in range(3):
            row[a + 1] = place[j, a] - place[i, a]
        for a in range(TREND_TERMS):
            right[a] += row[a] * value[j]
            for b in range(TREND_TERMS):
                matrix[a, b] += row[a] * row[b]
    across = RIDGE * (matrix[1, 1] + matrix[2, 2] + matrix[3, 3]) + TINY
    for a in range(1, TREND_TERMS):
        matrix[a, a] += across  # cells hardly reach across the surface that they lie on
    trend = np.linalg.solve(matrix, right)
    off = np.empty(n)
    for k in range(n):
        j = table[i, k]
        at = trend[0]
        for a in range(3):
            at += trend[a + 1] * (place[j, a] - place[i, a])
        off[k] = abs(value[j] - at)
    return off


@njit(cache=True, nogil=True, parallel=True)
def window_statistics(table, count, place, value, weight, rank):
    """(5, s): median, `rank`-th lowest and highest, noise, summed weight of a window.

    The noise is what the values differ by from a plane, the side of a dent being none; by pairs
    where cells are too few for a plane; NaN where a cell has fewer than `rank` others beside it.
    """
    n = table.shape[0]
    out = np.empty((5, n))
    for i in prange(n):
        here, apart = np.empty(MOST_NEIGHBOURS), np.empty(MOST_NEIGHBOURS)
        others, total = 0, 0.0
        for k in range(count[i]):
            j = table[i, k]
            here[k] = value[j]
            total += weight[j]
            if j != i:
                apart[others] = abs(value[j] - value[i])
                others += 1
        ranked = np.sort(here[: count[i]])
        half = count[i] // 2
        out[0, i] = ranked[half] if count[i] % 2 else 0.5 * (ranked[half - 1] + ranked[half])
        at = min(rank, count[i]) - 1
        out[1, i], out[2, i] = ranked[at], ranked[count[i] - 1 - at]
        out[3, i] = _median(apart, others) / PAIR_MEDIAN if others >= rank else np.nan
        if count[i] >= 2 * TREND_TERMS:
            off = _off_plane(place, value, table, count, i)
            # a plane on a surface takes three of the n degrees of freedom
            spread = _median(off, count[i]) / NORMAL_MEDIAN * np.sqrt(count[i] / (count[i] - 3.0))
            out[3, i] = min(out[3, i], spread)
        out[4, i] = total
    return out


@njit(cache=True, nogil=True, parallel=True)
def window_means(table, count, value):
    """(s,) mean over each window."""
    out = np.zeros(table.shape[0])
    for i in prange(table.shape[0]):
        for k in range(count[i]):
            out[i] += value[table[i, k]]
        out[i] /= count[i]
    return out


@njit(cache=True, nogil=True, parallel=True)
def window_medians(table, count, value):
    """(s,) median over each window of the values that are numbers; NaN where none is."""
    n = table.shape[0]
    out = np.empty(n)
    for i in prange(n):
        here = np.empty(MOST_NEIGHBOURS)
        found = 0
        for k in range(count[i]):
            v = value[table[i, k]]
            if not np.isnan(v):
                here[found] = v
                found += 1
        out[i] = _median(here, found) if found else np.nan
    return out


@njit(cache=True, nogil=True, parallel=True)
def group_medians(order, start, value):
    """(g,) median of the values of each group."""
    n = start.shape[0] - 1
    out = np.empty(n)
    for i in prange(n):
        size = start[i + 1] - start[i]
        here = np.empty(size)
        for k in range(size):
            here[k] = value[order[start[i] + k]]
        out[i] = _median(here, size)
    return out


@njit(cache=True, nogil=True)
def pairs_apart(place, normal, which, least, most, cosine):
    """(p, 2) pairs of some cells that face the same way, farther apart than one length, by another.

    Each pair once, rising.
    """
    many = len(which) * (len(which) - 1) // 2
    found = np.empty((many, 2), np.int32)
    n = 0
    for p in range(len(which)):
        i = which[p]
        for q in range(p + 1, len(which)):
            j = which[q]
            dx, dy, dz = (
                place[j, 0] - place[i, 0], place[j, 1] - place[i, 1], place[j, 2] - place[i, 2]
            )  # fmt: skip
            square = dx * dx + dy * dy + dz * dz
            if square > most * most or np.sqrt(square) <= least:
                continue
            dot = (
                normal[i, 0] * normal[j, 0] + normal[i, 1] * normal[j, 1]
                + normal[i, 2] * normal[j, 2]
            )  # fmt: skip
            if dot > cosine:
                found[n, 0], found[n, 1] = i, j
                n += 1
    return found[:n].copy()


@njit(cache=True, nogil=True, parallel=True)
def window_farthest(table, count, value):
    """(s,) the cell of each window whose value is farthest from zero."""
    out = np.empty(table.shape[0], np.int64)
    for i in prange(table.shape[0]):
        most = table[i, 0]
        for k in range(1, count[i]):
            if abs(value[table[i, k]]) > abs(value[most]):
                most = table[i, k]
        out[i] = most
    return out
