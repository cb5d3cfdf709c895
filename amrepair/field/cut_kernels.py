# mypy: disable-error-code="no-untyped-def"
"""A minimum cut between two kinds of voxels; compiled.

Two trees of unsaturated edges grow from source and sink until they meet; each path is filled, and
what it tears off is adopted again (Boykov & Kolmogorov 2004, "An experimental comparison of
min-cut/max-flow algorithms", section 3).
"""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit

FREE_NODE, SOURCE, SINK = 0, 1, 2
ROOT, ORPHAN = 6, -1  # instead of the direction to a parent


@njit(cache=True, nogil=True)
def least_cut(neighbour, room, rest):
    """(n,) whether each voxel can still reach the sink once no more flow fits.

    `neighbour` (n, 6) is the voxel behind each face, −1 where none, opposite faces side by side;
    `room` (n, 6) what fits through it outward, `rest` (n,) from the source, negative to the sink.
    The last two hold what is left afterwards.
    """
    n = len(rest)
    tree, parent = np.zeros(n, np.int8), np.full(n, ORPHAN, np.int8)
    stamp, depth = np.zeros(n, np.int64), np.zeros(n, np.int32)
    queue, queued = np.empty(n + 1, np.int32), np.zeros(n, np.bool_)
    ends = np.zeros(2, np.int64)  # of the queue of active voxels, a ring
    for u in range(n):
        if rest[u] != 0:
            tree[u] = SOURCE if rest[u] > 0 else SINK
            parent[u] = ROOT
            put(u, queue, queued, ends)
    orphans = np.empty(n, np.int32)
    now = 0
    while ends[0] != ends[1]:
        u = queue[ends[0]]
        if tree[u] == FREE_NODE:
            k = -1
        else:
            k = grown(u, neighbour, room, tree, parent, stamp, depth, queue, queued, ends)
        if k < 0:
            queued[u] = False
            ends[0] = (ends[0] + 1) % len(queue)
            continue
        s, way = (u, k) if tree[u] == SOURCE else (neighbour[u, k], k ^ 1)
        count = filled(s, way, neighbour, room, rest, parent, orphans)
        now += 1
        # a stack: each voxel is an orphan at most once at a time
        while count > 0:
            count -= 1
            v = orphans[count]
            if not adopted(v, neighbour, room, tree, parent, stamp, depth, now):
                count = let_go(
                    v, neighbour, room, tree, parent, orphans, count, queue, queued, ends
                )
    return tree == SINK


@njit(cache=True, nogil=True)
def put(u, queue, queued, ends):
    """Append a voxel to the ring of those to grow from, once."""
    if not queued[u]:
        queued[u] = True
        queue[ends[1]] = u
        ends[1] = (ends[1] + 1) % len(queue)


@njit(cache=True, nogil=True)
def grown(u, neighbour, room, tree, parent, stamp, depth, queue, queued, ends):
    """Grow a tree from a voxel; the face through which it meets the other, −1 where it does not."""
    for k in range(6):
        v = neighbour[u, k]
        if v < 0:
            continue
        fits = room[u, k] if tree[u] == SOURCE else room[v, k ^ 1]
        if fits <= 0:
            continue
        if tree[v] == FREE_NODE:
            tree[v], parent[v] = tree[u], k ^ 1
            stamp[v], depth[v] = stamp[u], depth[u] + 1
            put(v, queue, queued, ends)
        elif tree[v] != tree[u]:
            return k
        elif stamp[v] <= stamp[u] and depth[v] > depth[u] + 1:  # nearer to its root this way
            parent[v] = k ^ 1
            stamp[v], depth[v] = stamp[u], depth[u] + 1
    return -1


@njit(cache=True, nogil=True)
def filled(s, way, neighbour, room, rest, parent, orphans):
    """Send what fits from source to sink through the face where the trees meet; count of orphans.

    `s` is the source's voxel there.
    """
    t = neighbour[s, way]
    most = room[s, way]
    u = s
    while parent[u] != ROOT:
        k = parent[u]
        u = neighbour[u, k]
        most = min(most, room[u, k ^ 1])
    most = min(most, rest[u])
    u = t
    while parent[u] != ROOT:
        most = min(most, room[u, parent[u]])
        u = neighbour[u, parent[u]]
    most = min(most, -rest[u])
    room[s, way] -= most
    room[t, way ^ 1] += most
    count = 0
    for end in range(2):
        to_sink = end == 1
        u = t if to_sink else s
        while True:
            k = parent[u]
            v = u
            if k == ROOT:
                rest[u] += most if to_sink else -most
                torn = rest[u] == 0
            else:
                v = neighbour[u, k]
                full, back = (u, k), (v, k ^ 1)
                if not to_sink:
                    full, back = back, full
                room[full] -= most
                room[back] += most
                torn = room[full] == 0
            if torn:
                parent[u] = ORPHAN
                orphans[count] = u
                count += 1
            if k == ROOT:
                break
            u = v
    return count


@njit(cache=True, nogil=True)
def root_depth(u, neighbour, parent, stamp, depth, now):
    """Steps from a voxel to its root, −1 where it hangs on an orphan; found ones are stamped."""
    steps, v = 0, u
    while stamp[v] != now:
        if parent[v] == ORPHAN:
            return -1
        if parent[v] == ROOT:
            stamp[v], depth[v] = now, 0
            break
        v = neighbour[v, parent[v]]
        steps += 1
    steps += depth[v]
    v, left = u, steps
    while stamp[v] != now:
        stamp[v], depth[v] = now, left
        left -= 1
        v = neighbour[v, parent[v]]
    return steps


@njit(cache=True, nogil=True)
def adopted(u, neighbour, room, tree, parent, stamp, depth, now):
    """Whether an orphan found a parent in its own tree that hangs on a root."""
    best, least = -1, 2**30
    for k in range(6):
        v = neighbour[u, k]
        if v < 0 or tree[v] != tree[u]:
            continue
        fits = room[v, k ^ 1] if tree[u] == SOURCE else room[u, k]
        if fits > 0 and parent[v] != k ^ 1:
            steps = root_depth(v, neighbour, parent, stamp, depth, now)
            if 0 <= steps < least:
                best, least = k, steps
    if best < 0:
        return False
    parent[u] = best
    stamp[u], depth[u] = now, least + 1
    return True


@njit(cache=True, nogil=True)
def let_go(u, neighbour, room, tree, parent, orphans, count, queue, queued, ends):
    """Free an orphan that found no parent; its children are orphans; their new number."""
    for k in range(6):
        v = neighbour[u, k]
        if v < 0 or tree[v] != tree[u]:
            continue
        fits = room[v, k ^ 1] if tree[u] == SOURCE else room[u, k]
        if fits > 0:
            put(v, queue, queued, ends)
        if parent[v] == k ^ 1:
            parent[v] = ORPHAN
            orphans[count] = v
            count += 1
    tree[u] = FREE_NODE
    return count
