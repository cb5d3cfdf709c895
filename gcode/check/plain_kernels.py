# mypy: disable-error-code="no-untyped-def"
"""Plain moves judged in machine code; the first line that is anything else, or wrong, ends it."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit

# What the machine's state is, and what it may not pass.
X, Y, Z, E, FEED, PULLED, SHORT_MM3, ABSOLUTE, ABSOLUTE_E, UNIT = range(10)
(
    LOW_X, LOW_Y, LOW_Z, HIGH_X, HIGH_Y, HIGH_Z, FASTEST, SHORT_MOVE, SECTION, ALONE, LINE,
    LEAST_Z, MOLTEN, FAST_X, FAST_Y, AREA, FLOW, COLD, STILL,
) = range(19)  # fmt: skip
EXACT = 2**53  # digits up to this, and as many decimals as a double divides by exactly
MOST_DECIMALS = 22
MOVE_WORDS = 5  # X, Y, Z, E, F


@njit(inner=True, cache=True, nogil=True)
def words_of(data, at, end, most, words):
    """Words of a line `G0 ...` or `G1 ...`: -1 if it is one, 0 if it is empty, 1 for all else.

    No letter twice, every letter with a number that comes out as Python's `float` reads it.
    """
    words[:] = np.nan
    first = at
    while first < end and (data[first] == 32 or data[first] == 9):
        first += 1
    i, stop = first, first
    while i < end and data[i] != 59:
        i += 1
    stop = i
    while stop > first and (data[stop - 1] == 32 or data[stop - 1] == 13 or data[stop - 1] == 9):
        stop -= 1
    if stop == first:
        return 0
    if stop - first > most or stop - first < 4 or data[first] != 71:
        return 1
    if not (data[first + 1] == 48 or data[first + 1] == 49) or data[first + 2] != 32:
        return 1
    i = first + 3
    while i < stop:
        if data[i] == 32:
            i += 1
            continue
        if 88 <= data[i] <= 90:
            word = data[i] - 88
        elif data[i] == 69:
            word = 3
        elif data[i] == 70:
            word = 4
        else:
            return 1
        if not np.isnan(words[word]):
            return 1
        i += 1
        sign = 1.0
        if i < stop and (data[i] == 45 or data[i] == 43):
            sign = -1.0 if data[i] == 45 else 1.0
            i += 1
        digits, decimals, point, some = 0, 0, False, False
        while i < stop and (48 <= data[i] <= 57 or (data[i] == 46 and not point)):
            if data[i] == 46:
                point = True
            else:
                some = True
                digits = digits * 10 + (data[i] - 48)
                if digits >= EXACT:
                    return 1
                if point:
                    decimals += 1
            i += 1
        if not some or decimals > MOST_DECIMALS:
            return 1
        if i < stop and data[i] != 32 and not 65 <= data[i] <= 90:
            return 1
        words[word] = sign * (digits / 10.0**decimals)
    return -1


@njit(cache=True, nogil=True)
def follow(data, starts, first, last, limits, state, rows, counts):
    """Follow lines first to last - 1 (from 0) as long as they are plain moves that may be.

    Parameters: bytes of the text, and where lines begin (one more than there are lines); `limits`
    and `state` as named above; `rows` (n, 8) for line (from 1), start, end and plastic of moves,
    below 0 where it is pulled back; `counts` (2,) of commands and of rows. The last three are
    changed. Returns the first line that was not followed.
    """
    words = np.empty(MOVE_WORDS)
    for line in range(first, last):
        kind = words_of(data, starts[line], starts[line + 1] - 1, limits[LINE], words)
        if kind == 0:
            continue
        if kind > 0 or counts[1] >= len(rows):
            return line
        feed = state[FEED]
        if not np.isnan(words[4]):
            feed = words[4] * state[UNIT] / 60.0
            if not 0.0 < feed <= limits[FASTEST]:
                return line
            feed = max(feed, 1e-3)
        moved = False
        length = 0.0
        row = rows[counts[1]]
        row[0] = line + 1
        for axis in range(3):
            here = state[axis]
            row[1 + axis] = here
            value = words[axis]
            if not np.isnan(value):
                moved = True
                value *= state[UNIT]
                value = value if state[ABSOLUTE] > 0 else here + value
            else:
                value = here
            row[4 + axis] = value
            length += (value - here) ** 2
        length = np.sqrt(length)
        if moved:
            for axis in range(3):
                if not limits[LOW_X + axis] <= row[4 + axis] <= limits[HIGH_X + axis]:
                    return line
            for axis in range(2):
                if feed * abs(row[4 + axis] - row[1 + axis]) > limits[FAST_X + axis] * length:
                    return line
        pushed, e = 0.0, state[E]
        if not np.isnan(words[3]):
            pushed = words[3] * state[UNIT]
            if state[ABSOLUTE_E] > 0:
                pushed -= e
            e += pushed
        if max(length, abs(pushed)) > limits[STILL] * feed > 0.0:
            return line
        if pushed > 0.0 and length > limits[SHORT_MOVE] and min(row[3], row[6]) < limits[LEAST_Z]:
            return line
        pulled, short_mm3 = state[PULLED], state[SHORT_MM3]
        if pushed != 0.0:
            if (pushed > 0.0 and limits[COLD] > 0) or pulled > limits[ALONE]:
                return line
            back = max(0.0, min(pushed, pulled))
            if length > limits[SHORT_MOVE]:
                short_mm3 = 0.0
            if pushed < 0.0:
                pulled -= pushed
                if pulled > limits[ALONE]:
                    return line
            elif length > limits[SHORT_MOVE]:
                pulled -= back
                section = (pushed - back) * limits[AREA] / length
                if section > limits[SECTION] or section * feed > limits[FLOW]:
                    return line
            else:
                pulled -= back
                fresh = (pushed - back) * limits[AREA]
                short_mm3 += fresh
                melts = fresh / (length if length > 0.0 else pushed) * feed
                molten = short_mm3 <= limits[MOLTEN] * limits[AREA]
                if fresh > 0.0 and not molten and melts > limits[FLOW]:
                    return line
                if short_mm3 > limits[ALONE] * limits[AREA]:
                    return line
        # nothing speaks against it
        row[7] = pushed * limits[AREA]
        for axis in range(3):
            state[axis] = row[4 + axis]
        state[E], state[FEED], state[PULLED] = e, feed, pulled
        state[SHORT_MM3] = short_mm3
        counts[0] += 1
        if length > 0.0:
            counts[1] += 1
    return last
