# mypy: disable-error-code="no-untyped-def"
"""Bytes to words, words to states, states to beads: the loops of the reader, compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit

# Columns of the table of words; the letters in this order.
LETTERS = b"XYZEFIJRSPT"
X, Y, Z, E, F, I_, J, R, S, P, T = range(11)
# Columns of the table of states; from the last one on, one for each head's heater.
S_X, S_Y, S_Z, S_E, S_FEED, S_ABS, S_ABS_E, S_FAN, S_BED, S_ACC, S_MM, S_TOOL, S_HOT = range(13)
# Among kinds of lines, which are letters else: every heater off.
ALL_OFF = 1
INCH_MM = 25.4
CHORD_MM = 0.01  # an arc is told by chords no further from it than this


@njit(cache=True, nogil=True)
def parse(data, starts, letters, codes, kinds, words):
    """Fill `kinds` (letter), `codes` (G and M numbers × 10) and `words` (NaN where absent)."""
    n = len(starts) - 1
    for line in range(n):
        i, end = starts[line], starts[line + 1]
        for c in range(words.shape[1]):
            words[line, c] = np.nan
        kinds[line] = 0
        codes[line] = -1
        while i < end and (data[i] == 32 or data[i] == 9):
            i += 1
        if i < end and (data[i] == 78 or data[i] == 110):  # N: a line number stands before
            i += 1
            while i < end and (48 <= data[i] <= 57 or data[i] == 32 or data[i] == 45):
                i += 1
        if i >= end:
            continue
        head = data[i]
        if 97 <= head <= 122:
            head -= 32
        if head == 59:  # a comment of its own
            kinds[line] = 59
            continue
        if head < 65 or head > 90:
            continue
        following = data[i + 1] if i + 1 < end else 0
        if not (48 <= following <= 57):
            continue  # a named command
        i += 1
        value = 0
        while i < end and 48 <= data[i] <= 57:
            value = value * 10 + (data[i] - 48)
            i += 1
        value *= 10
        if i < end and data[i] == 46:  # G29.1
            i += 1
            if i < end and 48 <= data[i] <= 57:
                value += data[i] - 48
            while i < end and 48 <= data[i] <= 57:
                i += 1
        kinds[line] = head
        codes[line] = value
        while i < end:
            c = data[i]
            if c in (59, 42, 10, 13):  # ; * end
                break
            if 97 <= c <= 122:
                c -= 32
            i += 1
            column = -1
            for k in range(len(letters)):
                if letters[k] == c:
                    column = k
                    break
            if not 65 <= c <= 90:
                continue
            while i < end and data[i] == 32:
                i += 1
            sign, whole, scale, digits = 1.0, 0.0, 1.0, 0
            if i < end and (data[i] == 45 or data[i] == 43):
                if data[i] == 45:
                    sign = -1.0
                i += 1
            while i < end and 48 <= data[i] <= 57:
                whole = whole * 10 + (data[i] - 48)
                digits += 1
                i += 1
            if i < end and data[i] == 46:
                i += 1
                while i < end and 48 <= data[i] <= 57:
                    whole = whole * 10 + (data[i] - 48)
                    scale *= 10
                    digits += 1
                    i += 1
            if column >= 0:
                words[line, column] = sign * whole / scale if digits > 0 else 0.0


@njit(inner=True, cache=True, nogil=True)
def heater_of(now, told):
    """Column of the heater that a line means, which tells a head or none; -1 where it is not there.

    Of a single heater the head may have any number, as long as it is the one that is chosen.
    """
    if len(now) == S_HOT + 1:
        return S_HOT if np.isnan(told) or told == 0 or told == now[S_TOOL] else -1
    head = now[S_TOOL] if np.isnan(told) else told
    return S_HOT + int(head) if 0 <= head < len(now) - S_HOT else -1


@njit(cache=True, nogil=True)
def run(kinds, codes, words, both_modes, g91_moves_e, tool_zeroes_e, offset, states, pushed):
    """States after every line (row line + 1) and filament pushed by it, mm.

    `offset` (3,) is what G92 moved the axes' zero by so far; it is changed.
    """
    for line in range(len(kinds)):
        now = states[line + 1]
        now[:] = states[line]
        pushed[line] = 0.0
        kind, code = kinds[line], codes[line]
        unit = 1.0 if now[S_MM] > 0 else INCH_MM
        w = words[line]
        if kind == 71:  # G
            if code == 100 and not np.isnan(w[P]) and not np.isnan(w[S]):  # RepRapFirmware's
                heater = heater_of(now, w[P])
                if heater >= 0:
                    now[heater] = max(w[S], 0.0)
            elif code in (0, 10, 20, 30):
                for axis in range(3):
                    value = w[axis]
                    if not np.isnan(value):
                        if now[S_ABS] > 0:
                            now[axis] = value * unit + offset[axis]
                        else:
                            now[axis] += value * unit
                if not np.isnan(w[F]):
                    now[S_FEED] = w[F] * unit / 60.0
                if not np.isnan(w[E]):
                    if now[S_ABS_E] > 0 and (now[S_ABS] > 0 or not g91_moves_e):
                        pushed[line] = w[E] * unit - now[S_E]
                        now[S_E] = w[E] * unit
                    else:
                        pushed[line] = w[E] * unit
                        now[S_E] += w[E] * unit
            elif code == 200:
                now[S_MM] = 0.0
            elif code == 210:
                now[S_MM] = 1.0
            elif code == 280:
                every = np.isnan(w[X]) and np.isnan(w[Y]) and np.isnan(w[Z])
                for axis in range(3):
                    if every or not np.isnan(w[axis]):
                        now[axis] = 0.0
                        offset[axis] = 0.0
            elif code in (900, 910):
                now[S_ABS] = 1.0 if code == 900 else 0.0
                if both_modes:
                    now[S_ABS_E] = now[S_ABS]
            elif code == 920:
                for axis in range(3):
                    if not np.isnan(w[axis]):
                        offset[axis] = now[axis] - w[axis] * unit
                if not np.isnan(w[E]):
                    now[S_E] = w[E] * unit
        elif kind == 77:  # M
            if code == 820:
                now[S_ABS_E] = 1.0
            elif code == 830:
                now[S_ABS_E] = 0.0
            elif code in (1040, 1041, 1090):  # M104.1: soon, as slicers tell Prusa's XL
                heater = heater_of(now, w[T])
                if heater >= 0 and not np.isnan(w[S]):
                    now[heater] = max(w[S], 0.0)
                elif heater >= 0 and code == 1090 and not np.isnan(w[R]):
                    now[heater] = w[R]
            elif code == 5680 and not np.isnan(w[S]):  # the same as G10 with P
                heater = heater_of(now, w[P])
                if heater >= 0:
                    now[heater] = max(w[S], 0.0)
            elif code in (1400, 1900) and not np.isnan(w[S]):
                now[S_BED] = w[S]
            elif code == 1900 and not np.isnan(w[R]):
                now[S_BED] = w[R]
            elif code == 1060 and not w[P] > 0:  # with P: another fan than the part's
                now[S_FAN] = 1.0 if np.isnan(w[S]) else w[S] / 255.0
            elif code == 1070 and not w[P] > 0:
                now[S_FAN] = 0.0
            elif code == 2040:
                if not np.isnan(w[P]):
                    now[S_ACC] = w[P]
                elif not np.isnan(w[S]):
                    now[S_ACC] = w[S]
        elif kind == 84:  # T
            heads = len(now) - S_HOT
            if heads == 1 or code // 10 < heads:  # else the firmware goes on with what it has
                if tool_zeroes_e and heads > 1 and now[S_TOOL] != code // 10:
                    now[S_E] = 0.0
                now[S_TOOL] = code // 10
        elif kind == ALL_OFF:
            now[S_HOT:] = 0.0
            now[S_BED] = 0.0


@njit(inner=True, cache=True, nogil=True)
def chords(x0, y0, x1, y1, w, unit, clockwise):
    """Centre, start angle, sweep and number of chords of an arc; no chord if it is none."""
    if not np.isnan(w[R]):
        r = w[R] * unit
        dx, dy = x1 - x0, y1 - y0
        d = np.hypot(dx, dy)
        if d < 1e-9 or abs(r) < 0.5 * d:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0
        h = np.sqrt(max(0.0, r * r - 0.25 * d * d))
        side = -1.0 if clockwise == (r > 0) else 1.0
        cx = 0.5 * (x0 + x1) - side * h * dy / d
        cy = 0.5 * (y0 + y1) + side * h * dx / d
    else:
        cx = x0 + (0.0 if np.isnan(w[I_]) else w[I_] * unit)
        cy = y0 + (0.0 if np.isnan(w[J]) else w[J] * unit)
    radius = np.hypot(x0 - cx, y0 - cy)
    if radius < 1e-9:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0
    a0 = np.arctan2(y0 - cy, x0 - cx)
    sweep = np.arctan2(y1 - cy, x1 - cx) - a0
    if clockwise:
        if sweep >= -1e-9:
            sweep -= 2 * np.pi
    elif sweep <= 1e-9:
        sweep += 2 * np.pi
    step = 2 * np.arccos(max(0.0, 1 - CHORD_MM / radius)) if radius > CHORD_MM else np.pi / 2
    return cx, cy, radius, a0, sweep, max(1, int(np.ceil(abs(sweep) / step)))


@njit(cache=True, nogil=True)
def beads(kinds, codes, words, states, pushed, start, end, filament, owner, count_only):
    """Extruding segments, arcs cut into chords; returns how many."""
    found = 0
    for line in range(len(kinds)):
        if kinds[line] != 71 or pushed[line] <= 0.0:
            continue
        a, b = states[line], states[line + 1]
        code = codes[line]
        if code in (20, 30):
            unit = 1.0 if a[S_MM] > 0 else INCH_MM
            cx, cy, radius, a0, sweep, n = chords(
                a[0], a[1], b[0], b[1], words[line], unit, code == 20
            )
            if n > 0:
                if not count_only:
                    for k in range(n):
                        for side in range(2):
                            t = (k + side) / n
                            point = start[found + k] if side == 0 else end[found + k]
                            point[0] = cx + radius * np.cos(a0 + sweep * t)
                            point[1] = cy + radius * np.sin(a0 + sweep * t)
                            point[2] = a[2] + (b[2] - a[2]) * t
                        filament[found + k] = pushed[line] / n
                        owner[found + k] = line
                found += n
                continue
        dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        if not dx * dx + dy * dy + dz * dz > 1e-12:
            continue
        if not count_only:
            start[found] = a[:3]
            end[found] = b[:3]
            filament[found] = pushed[line]
            owner[found] = line
        found += 1
    return found
