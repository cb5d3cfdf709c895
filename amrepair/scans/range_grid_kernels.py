# mypy: disable-error-code="no-untyped-def"
"""Range grids: neighbours of each pixel, and lists of a file's grid. Compiled, no policy."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit

EDGE, FLYING = 1, 2
OUTSIDE, GAP, SMOOTH, NEARER, FARTHER = 0, 1, 2, 3, 4


@njit(inner=True, cache=True, nogil=True)
def _state(index, depth, spacing, row, column, i, lateral, steepest):
    """How the pixel at (row, column) goes on from point i, `lateral` spacings away."""
    if row < 0 or column < 0 or row >= index.shape[0] or column >= index.shape[1]:
        return OUTSIDE
    j = index[row, column]
    if j < 0:
        return GAP
    step = depth[j] - depth[i]
    if abs(step) <= steepest * lateral * min(spacing[i], spacing[j]):
        return SMOOTH
    return NEARER if step < 0 else FARTHER


@njit(cache=True, nogil=True)
def mark_edges(index, depth, spacing, row_ratio, steepest, flags):
    """Raise the flags of the grid's points.

    `depth` (n,) grows away from the sensor, `spacing` (n,) is a point's distance to the next
    column, `row_ratio` what the next row's is of it, `steepest` the tangent of the incidence.
    """
    rows, columns = index.shape
    across = (1.0, row_ratio, np.hypot(1.0, row_ratio), np.hypot(1.0, row_ratio))
    for r in range(rows):
        for c in range(columns):
            i = index[r, c]
            if i < 0:
                continue
            for k in range(4):
                dr = 0 if k == 0 else 1
                dc = 0 if k == 1 else (-1 if k == 3 else 1)
                on = _state(index, depth, spacing, r + dr, c + dc, i, across[k], steepest)
                back = _state(index, depth, spacing, r - dr, c - dc, i, across[k], steepest)
                if on in (GAP, NEARER, FARTHER) or back in (GAP, NEARER, FARTHER):
                    flags[i] |= EDGE
                if (on == NEARER and back == FARTHER) or (on == FARTHER and back == NEARER):
                    flags[i] |= FLYING


@njit(cache=True, nogil=True)
def rims(index, depth, spacing, row_ratio, steepest, least_slope):
    """How many rims (beside a gap or a jump) fall away, and how many rise, towards the rim.

    Counted along rows and columns, where the surface comes to the rim at least that steep.
    """
    rows, columns = index.shape
    falls, rises = 0, 0
    for r in range(rows):
        for c in range(columns):
            i = index[r, c]
            if i < 0:
                continue
            for k in range(4):
                dr = (k == 2) - (k == 3)
                dc = (k == 0) - (k == 1)
                across = 1.0 if dr == 0 else row_ratio
                on = _state(index, depth, spacing, r + dr, c + dc, i, across, steepest)
                if on in (SMOOTH, OUTSIDE):
                    continue
                back = _state(index, depth, spacing, r - dr, c - dc, i, across, steepest)
                if back != SMOOTH:
                    continue
                slope = (depth[i] - depth[index[r - dr, c - dc]]) / (across * spacing[i])
                falls += slope > least_slope
                rises += slope < -least_slope
    return falls, rises


@njit(cache=True, nogil=True)
def lists_of_numbers(numbers, count):
    """`count` lists of none or one number, each after its length: (entries, where they end).

    An entry is -1 for a gap and -2 for a list that is neither; the end is -1 where they break off.
    """
    out = np.full(count, -1, np.int64)
    at, size = 0, len(numbers)
    for k in range(count):
        if at >= size:
            return out, -1
        length = numbers[at]
        at += 1
        if length == 0:
            continue
        if length != 1 or at >= size:
            out[k] = -2
            return out, -1 if length == 1 else at
        out[k] = max(numbers[at], -2)
        at += 1
    return out, at


@njit(inner=True, cache=True, nogil=True)
def _number(data, at, size, big):
    value = np.int64(0)
    for k in range(size):
        shift = size - 1 - k if big else k
        value |= np.int64(data[at + k]) << (8 * shift)
    return value


@njit(cache=True, nogil=True)
def lists_of_bytes(data, count, length_bytes, entry_bytes, big):
    """The same of binary lists; a negative entry comes out far too large."""
    out = np.full(count, -1, np.int64)
    at, size = 0, len(data)
    for k in range(count):
        if at + length_bytes > size:
            return out, -1
        length = _number(data, at, length_bytes, big)
        at += length_bytes
        if length == 0:
            continue
        if length != 1 or at + entry_bytes > size:
            out[k] = -2
            return out, -1 if length == 1 else at
        out[k] = _number(data, at, entry_bytes, big)
        at += entry_bytes
    return out, at
