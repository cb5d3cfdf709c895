# mypy: disable-error-code="no-untyped-def"
"""Kernels on columns: linked lists of solid z-intervals that grow, and flat maps of them.

A column's topmost interval lies in dense arrays `hi`, `lo` (ny, nx), mm; the others hang below it
in a pool, `nxt` (ny, nx) and `pool_next` (m,) being indices into `pool` (m, 2) of (lo, hi), 0 for
none. An empty column has hi = lo = 0: the bed. `meta` holds the first never-used pool index and
the head of the list of freed ones. Nothing here knows beads, scanners or units other than mm.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gcode.compiled import njit

TOUCH_MM = 1e-9  # intervals this close are one: far below any layer, far above float64 rounding
FRESH, FREE_ENTRY = 0, 1  # entries of `meta`


@njit(inner=True, cache=True, nogil=True, inline="never")
def allocate(pool, pool_next, meta, lo, hi, following):
    """Take a pool node for (lo, hi); the caller has made sure that there is room."""
    node = meta[FREE_ENTRY]
    if node != 0:
        meta[FREE_ENTRY] = pool_next[node]
    else:
        node = meta[FRESH]
        meta[FRESH] = node + 1
    pool[node, 0] = lo
    pool[node, 1] = hi
    pool_next[node] = following
    return node


@njit(inner=True, cache=True, nogil=True)
def release(pool_next, meta, node):
    """Give a pool node back; returns what followed it."""
    following = pool_next[node]
    pool_next[node] = meta[FREE_ENTRY]
    meta[FREE_ENTRY] = node
    return following


class Stacks(NamedTuple):
    """The columns: topmost interval, the chain of those below in a pool of nodes, its counters."""

    hi: Any
    lo: Any
    nxt: Any
    pool: Any
    pool_next: Any
    meta: Any


@njit(inner=True, cache=True, nogil=True)
def surface_below(hi, lo, nxt, pool, pool_next, iy, ix, z):
    """Highest solid at or below z (0: the bed); z itself where z lies inside solid."""
    top = hi[iy, ix]
    if top <= z:
        return top
    if lo[iy, ix] < z:
        return z
    node = nxt[iy, ix]
    while node != 0:
        if pool[node, 1] <= z:
            return pool[node, 1]
        if pool[node, 0] < z:
            return z
        node = pool_next[node]
    return 0.0


@njit(inner=True, cache=True, nogil=True)
def insert(hi, lo, nxt, pool, pool_next, meta, iy, ix, a, b):
    """Unite the column with [a, b]; needs room for one pool node."""
    if hi[iy, ix] <= lo[iy, ix]:
        lo[iy, ix] = a
        hi[iy, ix] = b
        return
    if a > hi[iy, ix] + TOUCH_MM:
        nxt[iy, ix] = allocate(pool, pool_next, meta, lo[iy, ix], hi[iy, ix], nxt[iy, ix])
        lo[iy, ix] = a
        hi[iy, ix] = b
        return
    if lo[iy, ix] > b + TOUCH_MM:
        before = 0
        node = nxt[iy, ix]
        while node != 0 and pool[node, 0] > b + TOUCH_MM:
            before = node
            node = pool_next[node]
        while node != 0 and pool[node, 1] >= a - TOUCH_MM:
            a = min(a, pool[node, 0])
            b = max(b, pool[node, 1])
            node = release(pool_next, meta, node)
        fresh = allocate(pool, pool_next, meta, a, b, node)
        if before == 0:
            nxt[iy, ix] = fresh
        else:
            pool_next[before] = fresh
        return
    a = min(a, lo[iy, ix])
    b = max(b, hi[iy, ix])
    node = nxt[iy, ix]
    while node != 0 and pool[node, 1] >= a - TOUCH_MM:
        a = min(a, pool[node, 0])
        node = release(pool_next, meta, node)
    lo[iy, ix] = a
    hi[iy, ix] = b
    nxt[iy, ix] = node


@njit(inner=True, cache=True, nogil=True)
def cut(hi, lo, nxt, pool, pool_next, meta, iy, ix, a, b):
    """Take [a, b] out of the column; needs room for one pool node; returns the length removed."""
    removed = 0.0
    while hi[iy, ix] > lo[iy, ix]:  # the topmost interval, promoting those below
        top, bottom = hi[iy, ix], lo[iy, ix]
        if top <= a:
            return removed
        if bottom >= b:
            break
        removed += min(top, b) - max(bottom, a)
        if top > b:
            lo[iy, ix] = b
            if bottom < a:
                nxt[iy, ix] = allocate(pool, pool_next, meta, bottom, a, nxt[iy, ix])
                return removed
            break
        if bottom < a:
            hi[iy, ix] = a
            return removed
        node = nxt[iy, ix]
        if node == 0:
            hi[iy, ix] = 0.0
            lo[iy, ix] = 0.0
        else:
            lo[iy, ix] = pool[node, 0]
            hi[iy, ix] = pool[node, 1]
            nxt[iy, ix] = release(pool_next, meta, node)
    before = 0
    node = nxt[iy, ix]
    while node != 0:
        bottom, top = pool[node, 0], pool[node, 1]
        if top <= a:
            return removed
        if bottom < b:
            removed += min(top, b) - max(bottom, a)
            if top > b:
                pool[node, 0] = b
                if bottom < a:
                    pool_next[node] = allocate(pool, pool_next, meta, bottom, a, pool_next[node])
                    return removed
            elif bottom < a:
                pool[node, 1] = a
                return removed
            else:
                node = release(pool_next, meta, node)
                if before == 0:
                    nxt[iy, ix] = node
                else:
                    pool_next[before] = node
                continue
        before = node
        node = pool_next[node]
    return removed


@njit(inner=True, cache=True, nogil=True)
def grown(pool, pool_next, meta, room):
    """The same pool with room for at least `room` more nodes."""
    capacity = len(pool_next)
    if meta[FRESH] + room <= capacity:
        return pool, pool_next
    larger = max(2 * capacity, capacity + room)
    wider_pool = np.empty((larger, 2))
    wider_next = np.zeros(larger, dtype=np.int32)
    wider_pool[:capacity] = pool
    wider_next[:capacity] = pool_next
    return wider_pool, wider_next


@njit(cache=True, nogil=True)
def flatten(hi, lo, nxt, pool, pool_next, y0, y1, x0, x1):
    """Offsets (n + 1,) and intervals (m, 2) by column, rising, of the window [y0:y1, x0:x1]."""
    offsets = np.zeros((y1 - y0) * (x1 - x0) + 1, dtype=np.int64)
    k = 0
    for iy in range(y0, y1):
        for ix in range(x0, x1):
            count = 0
            if hi[iy, ix] > lo[iy, ix]:
                count = 1
                node = nxt[iy, ix]
                while node != 0:
                    count += 1
                    node = pool_next[node]
            offsets[k + 1] = offsets[k] + count
            k += 1
    spans = np.empty((offsets[k], 2))
    k = 0
    for iy in range(y0, y1):
        for ix in range(x0, x1):
            at = offsets[k + 1] - 1
            if at >= offsets[k]:
                spans[at, 0] = lo[iy, ix]
                spans[at, 1] = hi[iy, ix]
                node = nxt[iy, ix]
                while node != 0:
                    at -= 1
                    spans[at, 0] = pool[node, 0]
                    spans[at, 1] = pool[node, 1]
                    node = pool_next[node]
            k += 1
    return offsets, spans


@njit(cache=True, nogil=True)
def merge_flat(hi, lo, nxt, pool, pool_next, meta, y0, x0, width, offsets, spans, subtract):
    """Unite (or cut) flat intervals into the columns; returns the pool and the length changed."""
    changed = 0.0
    for k in range(len(offsets) - 1):
        iy = y0 + k // width
        ix = x0 + k % width
        if offsets[k + 1] > offsets[k]:
            pool, pool_next = grown(pool, pool_next, meta, offsets[k + 1] - offsets[k] + 1)
        for m in range(offsets[k], offsets[k + 1]):
            removed = cut(hi, lo, nxt, pool, pool_next, meta, iy, ix, spans[m, 0], spans[m, 1])
            if subtract:
                changed += removed
            else:
                insert(hi, lo, nxt, pool, pool_next, meta, iy, ix, spans[m, 0], spans[m, 1])
                changed += spans[m, 1] - spans[m, 0] - removed
    return pool, pool_next, changed


@njit(cache=True, nogil=True)
def subtract_flat(offsets_a, spans_a, offsets_b, spans_b):
    """A \\ B by column, both flat over the same window; flat again."""
    n = len(offsets_a) - 1
    offsets = np.zeros(n + 1, dtype=np.int64)
    spans = np.empty((len(spans_a) + len(spans_b), 2))
    at = 0
    for k in range(n):
        j = offsets_b[k]
        for i in range(offsets_a[k], offsets_a[k + 1]):
            low, top = spans_a[i, 0], spans_a[i, 1]
            while j > offsets_b[k] and spans_b[j - 1, 1] > low:
                j -= 1
            while j < offsets_b[k + 1] and spans_b[j, 0] < top:
                if spans_b[j, 1] > low:
                    if spans_b[j, 0] > low + TOUCH_MM:
                        spans[at, 0] = low
                        spans[at, 1] = spans_b[j, 0]
                        at += 1
                    low = spans_b[j, 1]
                j += 1
            if top > low + TOUCH_MM:
                spans[at, 0] = low
                spans[at, 1] = top
                at += 1
        offsets[k + 1] = at
    return offsets, spans[:at].copy()


@njit(cache=True, nogil=True)
def intersect_flat(offsets_a, spans_a, offsets_b, spans_b):
    """A ∩ B by column, both flat over the same window; flat again."""
    n = len(offsets_a) - 1
    offsets = np.zeros(n + 1, dtype=np.int64)
    spans = np.empty((len(spans_a) + len(spans_b), 2))
    at = 0
    for k in range(n):
        i, j = offsets_a[k], offsets_b[k]
        while i < offsets_a[k + 1] and j < offsets_b[k + 1]:
            low = max(spans_a[i, 0], spans_b[j, 0])
            top = min(spans_a[i, 1], spans_b[j, 1])
            if top > low + TOUCH_MM:
                spans[at, 0] = low
                spans[at, 1] = top
                at += 1
            if spans_a[i, 1] < spans_b[j, 1]:
                i += 1
            else:
                j += 1
        offsets[k + 1] = at
    return offsets, spans[:at].copy()


@njit(cache=True, nogil=True)
def paired(offset, z):
    """Flat intervals of a closed surface from its crossings by column (`column_crossings`).

    Those of a column are put in order, in place.
    """
    n = len(offset) - 1
    offsets = np.zeros(n + 1, dtype=np.int64)
    spans = np.empty((len(z) // 2 + 1, 2))
    at = 0
    for k in range(n):
        for m in range(offset[k] + 1, offset[k + 1]):  # few: by insertion
            height, i = z[m], m
            while i > offset[k] and z[i - 1] > height:
                z[i] = z[i - 1]
                i -= 1
            z[i] = height
        for m in range(offset[k], offset[k + 1] - 1, 2):
            low, top = max(0.0, z[m]), z[m + 1]
            if top > low + TOUCH_MM:
                if at > offsets[k] and low <= spans[at - 1, 1] + TOUCH_MM:
                    spans[at - 1, 1] = max(spans[at - 1, 1], top)
                else:
                    spans[at, 0] = low
                    spans[at, 1] = top
                    at += 1
        offsets[k + 1] = at
    return offsets, spans[:at].copy()
