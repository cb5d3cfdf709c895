# mypy: disable-error-code="no-untyped-def"
"""Straight lines over columns, and which of their stretches over air have a hold at both ends."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit

NO_COLUMN, HOLD_COLUMN, AIR_COLUMN, WANTED_COLUMN = 0, 1, 2, 3


@njit(inner=True, cache=True, nogil=True)
def kind_at(kind, row, column):
    """Of a column; nothing beyond the grid."""
    if row < 0 or column < 0 or row >= kind.shape[0] or column >= kind.shape[1]:
        return NO_COLUMN
    return kind[row, column]


@njit(cache=True, nogil=True)
def spans_on_line(kind, x, y, dx, dy, count, anchor, loose, found):
    """Stretches over air between two holds on one line; returns how many.

    Parameters: (ny, nx) kinds; the first place, in columns, the step to the next (half a column),
    and how many places there are; how many of them a hold takes; over how many nothing may be
    wanted; (k, 2) rows for the first and last place of each stretch.
    """
    number, place = 0, 0
    while place < count:
        if kind_at(kind, int(np.floor(y + place * dy)), int(np.floor(x + place * dx))) < AIR_COLUMN:
            place += 1
            continue
        first, bare = place, 0
        while place < count:
            here = kind_at(kind, int(np.floor(y + place * dy)), int(np.floor(x + place * dx)))
            if here < AIR_COLUMN:
                break
            bare += here == AIR_COLUMN
            place += 1
        if bare > loose or number == len(found):
            continue
        holds = True
        for k in range(1, anchor + 1):
            for at in (first - k, place - 1 + k):
                row, column = int(np.floor(y + at * dy)), int(np.floor(x + at * dx))
                holds &= kind_at(kind, row, column) == HOLD_COLUMN
        if holds:
            found[number, 0], found[number, 1] = first, place - 1
            number += 1
    return number


@njit(cache=True, nogil=True)
def spanned(kind, angle, box, most, anchor, loose):
    """What lines at an angle would span, each half a column from the next.

    Parameters: (ny, nx) kinds; the angle; first row, first column, and those after the last of what
    is asked about; steps of half a column in the longest span, in a hold, and in what is not wanted
    of a span. Returns (ny, nx) by column the length of the shortest span over it, in steps, inf
    where there is none; and in how many columns it is within `most`.
    """
    ny, nx = kind.shape
    least = np.full((ny, nx), np.inf)
    dx, dy = 0.5 * np.cos(angle), 0.5 * np.sin(angle)
    middle_y, middle_x = 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
    radius = 0.5 * np.hypot(box[2] - box[0], box[3] - box[1])
    lines, half = int(np.ceil(2.0 * radius)) + 1, int(np.ceil(2.0 * radius)) + anchor + 2
    found = np.empty((64, 2), np.int64)
    for k in range(-lines, lines + 1):
        x = middle_x - k * dy - half * dx
        y = middle_y + k * dx - half * dy
        number = spans_on_line(kind, x, y, dx, dy, 2 * half + 1, anchor, loose, found)
        for n in range(number):
            length = found[n, 1] - found[n, 0] + 1
            for at in range(found[n, 0], found[n, 1] + 1):
                row, column = int(np.floor(y + at * dy)), int(np.floor(x + at * dx))
                if kind[row, column] == WANTED_COLUMN:
                    least[row, column] = min(least[row, column], length)
    within = 0
    for row in range(box[0], box[2]):
        for column in range(box[1], box[3]):
            within += least[row, column] <= most
    return least, within
