"""What a program may make the machine's own limits: speeds, accelerations, jerk.

Firmwares hold moves to these limits (Marlin's M201 and M203, Klipper's `[printer]` section), so a
program may set what it likes below them. It knows no moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from gcode.profiles import PrinterProfile

# Slicers write limits that are not quite this machine's (PrusaSlicer's M203 X500 for an MK3S of
# 200): beyond so many times the profile's they are another machine's.
RAISED = 5.0
Finding = tuple[str, str, str, float]  # what, value, limit, and how many times the limit it is
# What M201 and M203 set for each axis, by the profile's name, and its unit.
_BY_AXIS = {
    "M201": ("max_acceleration_mm_s2", "acceleration", "mm/s²"),
    "M203": ("max_speed_mm_s", "speed", "mm/s"),
    "M205": ("max_jerk_mm_s", "jerk", "mm/s"),
    "M566": ("max_jerk_mm_s", "jerk", "mm/s"),
}
# RepRapFirmware's own are told in mm/min (its G-code dictionary, M203 and M566).
_PER_MINUTE = frozenset({("reprap", "M203"), ("reprap", "M566")})
# M204: printing, travelling, both (Marlin's S and Klipper's), and retracting.
_OF_M204 = {"P": "x", "T": "x", "S": "x", "R": "e"}
_OF_KLIPPER = {
    "VELOCITY": ("max_speed_mm_s", "speed", "mm/s"),
    "ACCEL": ("max_acceleration_mm_s2", "acceleration", "mm/s²"),
    "SQUARE_CORNER_VELOCITY": ("max_jerk_mm_s", "jerk", "mm/s"),
}
LIMIT_COMMANDS = frozenset(_BY_AXIS) | {"M204"}
_MAY_BE_ZERO = "max_jerk_mm_s"  # an axis without speed or acceleration never arrives


def raised_by(
    name: str, words: dict[str, float | None], printer: PrinterProfile, dialect: str
) -> Iterator[Finding]:
    """What a command of `LIMIT_COMMANDS` raises too far, or sets to what stops an axis."""
    if name == "M204":
        for letter, axis in _OF_M204.items():
            limit = getattr(printer.max_acceleration_mm_s2, axis)
            what = f"acceleration by M204 {letter}"
            yield from _judged(what, words.get(letter), limit, "mm/s²", zero=False)
        return
    field, what, unit = _BY_AXIS[name]
    per_s = 1.0 / 60.0 if (dialect, name) in _PER_MINUTE else 1.0
    for letter in "XYZE":
        value, limit = words.get(letter), getattr(getattr(printer, field), letter.lower())
        told = None if value is None else value * per_s
        what_of = f"machine limit of {letter}'s {what}"
        yield from _judged(what_of, told, limit, unit, zero=field == _MAY_BE_ZERO)


def raised_by_klipper(given: dict[str, float | None], printer: PrinterProfile) -> Iterator[Finding]:
    """The same of Klipper's SET_VELOCITY_LIMIT: what its parameters say."""
    for key, (field, what, unit) in _OF_KLIPPER.items():
        limit = getattr(printer, field).x
        what_of = f"machine limit of {what}, {key}"
        yield from _judged(what_of, given.get(key), limit, unit, zero=field == _MAY_BE_ZERO)


def _judged(
    what: str, value: float | None, limit: float, unit: str, *, zero: bool
) -> Iterator[Finding]:
    if value is None:
        return
    over_ratio = value / (RAISED * limit) if value > 0 else math.inf
    if not 0 <= value <= RAISED * limit or (value == 0 and not zero):
        told = f"{'0' if zero else 'above 0'} to {RAISED * limit:g} {unit}, "
        told += f"{RAISED:g} times the profile's"
        yield what, f"{value:g} {unit}", told, over_ratio
