# mypy: disable-error-code="no-untyped-def"
"""A tree of boxes over places, and the nearest of them to many points; compiled, for `places`."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit, prange

LEAF_PLACES = 8
LEAST_SIDE_MM = 1e-6  # places nearer together are not told apart
STACKED = 128  # boxes that wait: of each axis' halves of a kilometre, down to the least side
IN_A_ROW = 512  # points by one thread; each starts from what is near the one before


@njit(cache=True, nogil=True)
def built(places):
    """Order of the places, and the nodes: boxes, first child, first and last place.

    A node is cut in the middle of its longest side; its second child follows the first one.
    """
    n = len(places)
    order, ordered = np.arange(n), places.copy()
    most = max(1, 2 * n)
    box = np.empty((most, 6))
    child = np.full(most, -1, np.int32)
    first, last = np.zeros(most, np.int32), np.zeros(most, np.int32)
    last[0] = n
    count, k = 1, 0
    low, high = np.empty(3), np.empty(3)
    while k < count:
        for a in range(3):
            low[a], high[a] = np.inf, -np.inf
        for i in range(first[k], last[k]):
            for a in range(3):
                low[a] = min(low[a], ordered[i, a])
                high[a] = max(high[a], ordered[i, a])
        axis = 0
        for a in range(3):
            box[k, a], box[k, 3 + a] = low[a], high[a]
            if high[a] - low[a] > high[axis] - low[axis]:
                axis = a
        middle = 0.5 * (low[axis] + high[axis])
        if last[k] - first[k] > LEAF_PLACES and high[axis] - low[axis] > LEAST_SIDE_MM:
            i, j = first[k], last[k] - 1
            while i <= j:
                if ordered[i, axis] < middle:
                    i += 1
                    continue
                order[i], order[j] = order[j], order[i]
                for a in range(3):
                    ordered[i, a], ordered[j, a] = ordered[j, a], ordered[i, a]
                j -= 1
            child[k] = count
            first[count], last[count] = first[k], i
            first[count + 1], last[count + 1] = i, last[k]
            count += 2
        k += 1
    return order, ordered, box[:count], child[:count], first[:count], last[:count]


@njit(cache=True, nogil=True, inline="always")
def _apart2(x, y, z, box, k):
    """Squared distance to a node's box."""
    dx = max(box[k, 0] - x, 0.0, x - box[k, 3])
    dy = max(box[k, 1] - y, 0.0, y - box[k, 4])
    dz = max(box[k, 2] - z, 0.0, z - box[k, 5])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True, inline="always")
def _put_in(near, near2, k, p, here2):
    """A place among the k nearest so far, the nearest first, unless it is one of them."""
    for j in range(k):
        if near[j] == p:
            return
    j = k - 1
    while j > 0 and near2[j - 1] > here2:
        near[j], near2[j] = near[j - 1], near2[j - 1]
        j -= 1
    near[j], near2[j] = p, here2


@njit(inner=True, cache=True, nogil=True)
def _closer(x, y, z, near, near2, k, tree, stack, stack2):
    """Make the k nearest of all places of k places and their squared distances, both in order."""
    ordered, box, child, first, last = tree
    stack[0], stack2[0], top = 0, _apart2(x, y, z, box, 0), 1
    while top > 0:
        top -= 1
        if stack2[top] >= near2[k - 1]:
            continue
        node = stack[top]
        while child[node] >= 0:
            one, other = child[node], child[node] + 1
            one2, other2 = _apart2(x, y, z, box, one), _apart2(x, y, z, box, other)
            if other2 < one2:
                one, other, one2, other2 = other, one, other2, one2
            if other2 < near2[k - 1]:
                stack[top], stack2[top] = other, other2
                top += 1
            node = one
            if one2 >= near2[k - 1]:
                break
        else:
            for p in range(first[node], last[node]):
                dx, dy, dz = ordered[p, 0] - x, ordered[p, 1] - y, ordered[p, 2] - z
                here2 = dx * dx + dy * dy + dz * dz
                if here2 < near2[k - 1]:
                    _put_in(near, near2, k, p, here2)


@njit(cache=True, nogil=True, parallel=True)
def nearest(points, order, tree, count, within, most):
    """(n, k) distances to the nearest places and their numbers, the nearest first.

    Where the nearest is farther off than `within`, the others are just places; and where it is
    farther off than `most`, it is one, too, and said to be so far.
    """
    n = len(points)
    ordered = tree[0]
    distance, index = np.empty((n, count)), np.empty((n, count), np.int32)
    for part in prange((n + IN_A_ROW - 1) // IN_A_ROW):
        stack, stack2 = np.empty(STACKED, np.int32), np.empty(STACKED)
        near, near2 = np.arange(count).astype(np.int32), np.empty(count)
        for i in range(part * IN_A_ROW, min(n, (part + 1) * IN_A_ROW)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            for j in range(count):  # those near the point before, in their order from here
                p = near[j]
                dx, dy, dz = ordered[p, 0] - x, ordered[p, 1] - y, ordered[p, 2] - z
                here2 = dx * dx + dy * dy + dz * dz
                m = j
                while m > 0 and near2[m - 1] > here2:
                    near[m], near2[m] = near[m - 1], near2[m - 1]
                    m -= 1
                near[m], near2[m] = p, here2
            near2[0] = min(near2[0], most * most)
            _closer(x, y, z, near, near2, 1, tree, stack, stack2)
            if count > 1 and near2[0] <= within * within:
                _closer(x, y, z, near, near2, count, tree, stack, stack2)
            for j in range(count):
                distance[i, j], index[i, j] = np.sqrt(near2[j]), order[near[j]]
    return distance, index


@njit(cache=True, nogil=True)
def beside(points, order, tree, within):
    """(n,) whether any of the points lies within a distance of each place."""
    ordered, box, child, first, last = tree
    found = np.zeros(len(ordered), np.bool_)
    stack, within2 = np.empty(STACKED, np.int32), within * within
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        stack[0], top = 0, 1
        while top > 0:
            top -= 1
            node = stack[top]
            if _apart2(x, y, z, box, node) > within2:
                continue
            if child[node] >= 0:
                stack[top], stack[top + 1] = child[node], child[node] + 1
                top += 2
                continue
            for p in range(first[node], last[node]):
                dx, dy, dz = ordered[p, 0] - x, ordered[p, 1] - y, ordered[p, 2] - z
                if dx * dx + dy * dy + dz * dz <= within2:
                    found[order[p]] = True
    return found
