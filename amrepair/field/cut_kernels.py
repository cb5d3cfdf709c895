# mypy: disable-error-code="no-untyped-def"
"""A minimum cut through voxels that hold together; compiled, for `occupancy`.

Two trees grow towards each other, of what is still held solid and of what still reaches empty;
where they meet flow is pushed, and what that cuts off looks for another parent (Boykov &
Kolmogorov 2004). A voxel's neighbours are before and behind it along x, y and z: of number k, the
way back is k ^ 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from gcode.compiled import njit

FREE, SOLID, EMPTY = 0, 1, 2  # in which tree
ROOT, CUT_OFF = 6, 7  # what a parent is that is no neighbour
NO_WAY = 1 << 30  # to a root


class Trees(NamedTuple):
    """Voxels and flow that still fits: to each neighbour, from what is solid (else to empty)."""

    beside: Int[np.ndarray, "v 6"]
    fits: Int[np.ndarray, "v 6"]
    ends: Int[np.ndarray, " v"]
    tree: Int[np.ndarray, " v"]
    parent: Int[np.ndarray, " v"]
    clock: Int[np.ndarray, " v"]
    steps: Int[np.ndarray, " v"]


@njit(cache=True, nogil=True)
def joined(one, other, axis, fits, count):
    """(v, 6) neighbours of each voxel, −1 where there is none, and what fits through to each."""
    beside, through = np.full((count, 6), -1, np.int32), np.zeros((count, 6), np.int32)
    for k in range(len(one)):
        i, j, way = one[k], other[k], 2 * axis[k]
        if i >= 0 and j >= 0:
            beside[i, way], beside[j, way + 1] = j, i
            through[i, way], through[j, way + 1] = fits[k, 0], fits[k, 1]
    return beside, through


@njit(cache=True, nogil=True, inline="always")
def _room(t, mine, i, j, way):
    """What still fits between a voxel of a tree and its neighbour, away from the tree's roots."""
    return t.fits[i, way] if mine == SOLID else t.fits[j, way ^ 1]


@njit(inner=True, cache=True, nogil=True)
def _grown(t, i, queue, waits, last):
    """Take in what a voxel reaches; the way to where the other tree is met, −1 if nowhere."""
    mine = t.tree[i]
    for way in range(6):
        j = t.beside[i, way]
        if j < 0 or _room(t, mine, i, j, way) <= 0:
            continue
        if t.tree[j] == FREE:
            t.tree[j], t.parent[j] = mine, way ^ 1
            t.clock[j], t.steps[j] = t.clock[i], t.steps[i] + 1
            last = _put(j, queue, waits, last)
        elif t.tree[j] != mine:
            return way, last
        elif t.clock[j] <= t.clock[i] and t.steps[j] > t.steps[i]:
            t.parent[j] = way ^ 1
            t.clock[j], t.steps[j] = t.clock[i], t.steps[i] + 1
    return -1, last


@njit(cache=True, nogil=True, inline="always")
def _put(i, queue, waits, last):
    """One more in a ring, unless it waits there."""
    if not waits[i]:
        waits[i] = True
        queue[last] = i
        last = last + 1 if last + 1 < len(queue) else 0
    return last


@njit(inner=True, cache=True, nogil=True)
def _least(t, i, least):
    """How much flow fits between a voxel and its root, at most so much; and the root."""
    mine = t.tree[i]
    while t.parent[i] != ROOT:
        way = t.parent[i]
        j = t.beside[i, way]
        least = min(least, _room(t, mine, j, i, way ^ 1))
        i = j
    return min(least, abs(t.ends[i]))


@njit(cache=True, nogil=True, inline="always")
def _cut_off(t, i, lost, count):
    """One more that has no parent."""
    t.parent[i] = CUT_OFF
    lost[count] = i
    return count + 1


@njit(inner=True, cache=True, nogil=True)
def _pushed(t, i, amount, lost, count):
    """Flow pushed between a voxel and its root; what has no parent any more is lost."""
    mine = t.tree[i]
    sign = 1 if mine == SOLID else -1
    while t.parent[i] != ROOT:
        way = t.parent[i]
        j = t.beside[i, way]
        t.fits[j, way ^ 1] -= sign * amount
        t.fits[i, way] += sign * amount
        if _room(t, mine, j, i, way ^ 1) == 0:
            count = _cut_off(t, i, lost, count)
        i = j
    t.ends[i] -= sign * amount
    return _cut_off(t, i, lost, count) if t.ends[i] == 0 else count


@njit(inner=True, cache=True, nogil=True)
def _steps_to_root(t, i, now):
    """Of a voxel of a tree; marked on the way, so that no way is gone twice."""
    steps, k = 0, i
    while t.clock[k] != now:
        if t.parent[k] == CUT_OFF:
            return NO_WAY
        steps += 1
        if t.parent[k] == ROOT:
            t.clock[k], t.steps[k] = now, 1
            steps -= 1
            break
        k = t.beside[k, t.parent[k]]
    steps += t.steps[k]
    found = steps
    while t.clock[i] != now:
        t.clock[i], t.steps[i] = now, steps
        steps -= 1
        i = t.beside[i, t.parent[i]]
    return found


@njit(inner=True, cache=True, nogil=True)
def _adopted(t, lost, count, now, queue, waits, last):
    """A new parent for each that lost its own, or it is free, and those that it held are lost."""
    while count > 0:
        count -= 1
        i = lost[count]
        mine, best, parent = t.tree[i], NO_WAY, CUT_OFF
        for way in range(6):
            j = t.beside[i, way]
            if j >= 0 and t.tree[j] == mine and _room(t, mine, j, i, way ^ 1) > 0:
                steps = _steps_to_root(t, j, now)
                if steps < best:
                    best, parent = steps, way
        if best < NO_WAY:
            t.parent[i], t.clock[i], t.steps[i] = parent, now, best + 1
            continue
        t.tree[i] = FREE
        for way in range(6):
            j = t.beside[i, way]
            if j < 0 or t.tree[j] != mine:
                continue
            if _room(t, mine, j, i, way ^ 1) > 0:
                last = _put(j, queue, waits, last)
            if t.parent[j] == way ^ 1:
                count = _cut_off(t, j, lost, count)
    return last


@njit(cache=True, nogil=True)
def flow(beside, fits, ends):
    """Push all the flow that fits, in place. (v,) the tree of each voxel, none where no flow comes.

    EMPTY is what still reaches empty.
    """
    n = len(ends)
    t = Trees(
        beside, fits, ends, np.zeros(n, np.int8), np.full(n, CUT_OFF, np.int8),
        np.zeros(n, np.int32), np.ones(n, np.int32),
    )  # fmt: skip
    queue, waits = np.empty(n + 1, np.int32), np.zeros(n, np.bool_)
    lost = np.empty(n, np.int32)
    first, last, now = 0, 0, 0
    for i in range(n):
        if ends[i] != 0:
            t.tree[i] = SOLID if ends[i] > 0 else EMPTY
            t.parent[i] = ROOT
            last = _put(i, queue, waits, last)
    while first != last:
        i = queue[first]
        first = first + 1 if first + 1 < len(queue) else 0
        waits[i] = False
        while t.tree[i] != FREE:
            way, last = _grown(t, i, queue, waits, last)
            if way < 0:
                break
            j = t.beside[i, way]
            s, e = (i, j) if t.tree[i] == SOLID else (j, i)
            here = way if s == i else way ^ 1
            now += 1
            amount = _least(t, e, _least(t, s, t.fits[s, here]))
            t.fits[s, here] -= amount
            t.fits[e, here ^ 1] += amount
            count = _pushed(t, e, amount, lost, _pushed(t, s, amount, lost, 0))
            last = _adopted(t, lost, count, now, queue, waits, last)
    return t.tree
