"""Lines of a chain of beads as bytes; compiled, for `writer`."""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit

LONGEST_LINE = 96  # three axes and E, each of at most nineteen digits


@njit(inner=True, cache=True, nogil=True)
def put_number(out: Any, at: int, value: int, digits: int) -> int:
    """Write a number of so many decimal places, without trailing zeros; returns where it ends."""
    if value < 0:
        out[at] = 45  # -
        at += 1
        value = -value
    scale = 1
    for _ in range(digits):
        scale *= 10
    whole, rest = value // scale, value % scale
    first = 1
    while first * 10 <= whole:
        first *= 10
    while first > 0:
        out[at] = 48 + whole // first % 10
        at += 1
        first //= 10
    if rest > 0:
        out[at] = 46  # .
        at += 1
        while rest > 0:
            scale //= 10
            out[at] = 48 + rest // scale
            at += 1
            rest %= scale
    return at


@njit(cache=True, nogil=True)
def bead_lines(
    points: Any,
    section: Any,
    place: Any,
    per_mm3: float,
    owed: float,
    xyz_digits: int,
    e_digits: int,
) -> tuple[Any, int, Any, float]:
    """Lines of a chain from where the nozzle is on, where the first of them ends; place and debt.

    The nozzle's place then, and the filament that is still owed.

    Parameters
    ----------
    points, section
        (n, 3) nozzle positions and (n - 1,) sections.
    place
        (3,) what the firmware has read last.
    per_mm3
        Filament of a cubic millimetre.
    owed
        What rounding has kept back so far; what is shorter than what is written goes with the next.
    """
    to_xyz, to_e = 10.0**xyz_digits, 10.0**e_digits
    out = np.empty(len(section) * LONGEST_LINE, np.uint8)
    here, there = np.empty(3, np.int64), np.empty(3, np.int64)
    for a in range(3):
        here[a] = np.int64(np.rint(place[a] * to_xyz))
    at, first_end, pushed, filament = 0, 0, np.int64(0), 0.0
    for k in range(len(section)):
        square, moved = 0.0, False
        for a in range(3):
            step = points[k + 1, a] - points[k, a]
            square += step * step
            there[a] = np.int64(np.rint(points[k + 1, a] * to_xyz))
            moved |= there[a] != here[a]
        filament += np.sqrt(square) * section[k] * per_mm3
        if not moved:
            continue
        if at > 0:
            out[at] = 10  # a new line
            at += 1
        out[at], out[at + 1] = 71, 49  # G1
        at += 2
        for a in range(3):
            if there[a] != here[a]:
                out[at], out[at + 1] = 32, 88 + a
                at = put_number(out, at + 2, there[a], xyz_digits)
                here[a] = there[a]
        total = np.int64(np.rint((owed + filament) * to_e))
        if total != pushed:
            out[at], out[at + 1] = 32, 69  # E
            at = put_number(out, at + 2, total - pushed, e_digits)
            pushed = total
        if first_end == 0:
            first_end = at
    return out[:at], first_end, here / to_xyz, owed + filament - pushed / to_e
