# mypy: disable-error-code="no-untyped-def"
"""Order statistics over neighbouring cells that face the same way: compiled, no policy."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange

# Cells of a window of 3×3×3 with six ways to face; a surface crosses far fewer.
MOST_NEIGHBOURS = 64
# Cells by one thread, one after the other: their neighbours lie one after the other, too.
TOGETHER = 256
# Slots for the way a cell faces (±x, ±y, ±z, nowhere), in its key; a power of two. The last is of
# cells that are looked at apart from the others.
SLOTS = 8
APART = SLOTS - 1
# median |x| of a normal value of standard deviation 1 (scipy.stats.norm.ppf(0.75))
NORMAL_MEDIAN = 0.674490
# median |a − b| of two normal values of standard deviation 1
PAIR_MEDIAN = 0.953873
# A plane: level and slope.
TREND_TERMS = 4
# Of a window's own spread: nothing beside what is in the surface, much across it.
RIDGE, TINY = 1e-3, 1e-9


@njit(inner=True, cache=True, nogil=True)
def median(values, n):
    """The median of the first n values, which are put in order: few, so by insertion."""
    for k in range(1, n):
        value, j = values[k], k
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value
    half = n // 2
    return values[half] if n % 2 else 0.5 * (values[half - 1] + values[half])


@njit(inner=True, cache=True, nogil=True)
def put_in_order(values, along, n):
    """Put the first n values in order, and what goes along with each: few, so by insertion."""
    for k in range(1, n):
        value, its, j = values[k], along[k], k
        while j > 0 and values[j - 1] > value:
            values[j], along[j] = values[j - 1], along[j - 1]
            j -= 1
        values[j], along[j] = value, its


@njit(inner=True, cache=True, nogil=True)
def weighted_median(values, weights, n):
    """The median of what the first n values stand for, each so many observations; put in order."""
    whole = 0.0
    for k in range(n):
        whole += weights[k]
    put_in_order(values, weights, n)
    below, k = weights[0], 0
    while 2.0 * below < whole and k < n - 1:
        k += 1
        below += weights[k]
    return 0.5 * (values[k] + values[k + 1]) if 2.0 * below == whole and k < n - 1 else values[k]


@njit(inner=True, cache=True, nogil=True)
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
    for part in prange((n + TOGETHER - 1) // TOGETHER):
        begins = np.full(9, -1, np.int64)  # of each line of cells; they rise with the cell
        for i in range(part * TOGETHER, min(n, (part + 1) * TOGETHER)):
            found = 0
            cell = keys[i] // SLOTS
            for line in range(9):
                beside = (line // 3 - 1) * stride_x + (line % 3 - 1) * stride_y
                first = (cell + beside - 1) * SLOTS
                j = begins[line] if begins[line] >= 0 else np.searchsorted(keys, first)
                while j < n and keys[j] < first:
                    j += 1
                begins[line] = j
                while j < n and keys[j] < first + 3 * SLOTS:
                    together = (keys[i] % SLOTS == APART) == (keys[j] % SLOTS == APART)
                    if found < MOST_NEIGHBOURS and (
                        j == i or (together and _alike(normal, value, i, j, cosine, aside))
                    ):
                        table[i, found] = j
                        found += 1
                    j += 1
            count[i] = found
    return table, count


@njit(inner=True, cache=True, nogil=True)
def _off_plane(place, value, table, n, i, off):
    """Distances of a window's values from the plane through them by least squares, into `off`."""
    first, second = np.zeros(TREND_TERMS), np.zeros((TREND_TERMS, TREND_TERMS))
    row = np.empty(TREND_TERMS)
    for k in range(n):
        j = table[i, k]
        row[3] = value[j]
        for a in range(3):
            row[a] = place[j, a] - place[i, a]
        for a in range(TREND_TERMS):
            first[a] += row[a] / n
            for b in range(a, TREND_TERMS):
                second[a, b] += row[a] * row[b]
    # cells hardly reach across the surface that they lie on
    across = RIDGE * (second[0, 0] + second[1, 1] + second[2, 2]) + TINY
    xx = second[0, 0] - n * first[0] * first[0] + across
    yy = second[1, 1] - n * first[1] * first[1] + across
    zz = second[2, 2] - n * first[2] * first[2] + across
    xy = second[0, 1] - n * first[0] * first[1]
    xz = second[0, 2] - n * first[0] * first[2]
    yz = second[1, 2] - n * first[1] * first[2]
    xv = second[0, 3] - n * first[0] * first[3]
    yv = second[1, 3] - n * first[1] * first[3]
    zv = second[2, 3] - n * first[2] * first[3]
    ax, ay, az = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy  # the adjugate's rows
    by, bz, cz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    whole = xx * ax + xy * ay + xz * az
    gx = (ax * xv + ay * yv + az * zv) / whole
    gy = (ay * xv + by * yv + bz * zv) / whole
    gz = (az * xv + bz * yv + cz * zv) / whole
    for k in range(n):
        j = table[i, k]
        at = first[3] + gx * (place[j, 0] - place[i, 0] - first[0])
        at += gy * (place[j, 1] - place[i, 1] - first[1])
        off[k] = abs(value[j] - at - gz * (place[j, 2] - place[i, 2] - first[2]))


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
        told = np.empty(MOST_NEIGHBOURS)
        # counts and places as whole numbers of one kind: else what is called is compiled for two
        size, own, others, total = np.int64(count[i]), np.int64(i), 0, 0.0
        for k in range(count[i]):
            j = table[i, k]
            here[k], told[k] = value[j], weight[j]
            total += weight[j]
            if j != i:
                apart[others] = abs(value[j] - value[i])
                others += 1
        out[0, i] = weighted_median(here, told, size)
        at = min(rank, count[i]) - 1
        out[1, i], out[2, i] = here[at], here[count[i] - 1 - at]
        out[3, i] = median(apart, others) / PAIR_MEDIAN if others >= rank else np.nan
        if count[i] >= 2 * TREND_TERMS:
            _off_plane(place, value, table, size, own, apart)
            # a plane on a surface takes three of the n degrees of freedom
            spread = median(apart, size) / NORMAL_MEDIAN
            out[3, i] = min(out[3, i], spread * np.sqrt(count[i] / (count[i] - 3.0)))
        out[4, i] = total
    return out


@njit(cache=True, nogil=True, parallel=True)
def most_of_ranked(table, count, value, told, rank):
    """(s,) the most that is told of a window's `rank` lowest and of its `rank` highest cells."""
    n = table.shape[0]
    out = np.empty(n)
    for i in prange(n):
        here, its = np.empty(MOST_NEIGHBOURS), np.empty(MOST_NEIGHBOURS)
        size, most = np.int64(count[i]), 0.0
        for k in range(size):
            here[k], its[k] = value[table[i, k]], told[table[i, k]]
        put_in_order(here, its, size)
        for k in range(min(rank, size)):
            most = max(most, its[k], its[size - 1 - k])
        out[i] = most
    return out


@njit(cache=True, nogil=True)
def window_means(table, count, value):
    """(s,) mean over each window."""
    out = np.zeros(table.shape[0])
    for i in range(table.shape[0]):
        for k in range(count[i]):
            out[i] += value[table[i, k]]
        out[i] /= count[i]
    return out


@njit(cache=True, nogil=True)
def window_sums(table, count, value):
    """(s, v) sums over each window of v values a cell."""
    out = np.zeros((table.shape[0], value.shape[1]))
    for i in range(table.shape[0]):
        for k in range(count[i]):
            for c in range(value.shape[1]):
                out[i, c] += value[table[i, k], c]
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
        out[i] = median(here, found) if found else np.nan
    return out


@njit(cache=True, nogil=True, parallel=True)
def group_medians(order, start, value, weight):
    """(g,) median of the observations that the values of each group stand for."""
    n = start.shape[0] - 1
    out = np.empty(n)
    for i in prange(n):
        size = start[i + 1] - start[i]
        here, told = np.empty(size), np.empty(size)
        for k in range(size):
            j = order[start[i] + k]
            here[k], told[k] = value[j], weight[j]
        out[i] = weighted_median(here, told, size)
    return out


@njit(cache=True, nogil=True)
def differences_apart(place, normal, value, group, patch, which, least, most, cosine, groups):
    """How much some cells differ that face the same way, farther apart than one length, by another.

    (p,) differences of value, each pair once; (p,) its group, the larger one of the two; and
    (groups, patches) whether a patch has a cell in a pair of the group.
    """
    many = len(which) * (len(which) - 1) // 2
    off, worse = np.empty(many), np.empty(many, np.int16)
    touched = np.zeros((groups, patch.max() + 1), np.bool_)
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
                k = max(group[i], group[j])
                off[n], worse[n] = abs(value[i] - value[j]), k
                touched[k, patch[i]] = touched[k, patch[j]] = True
                n += 1
    return off[:n].copy(), worse[:n].copy(), touched


@njit(cache=True, nogil=True)
def window_farthest(table, count, value):
    """(s,) the cell of each window whose value is farthest from zero."""
    out = np.empty(table.shape[0], np.int64)
    for i in range(table.shape[0]):
        most = table[i, 0]
        for k in range(1, count[i]):
            if abs(value[table[i, k]]) > abs(value[most]):
                most = table[i, k]
        out[i] = most
    return out
