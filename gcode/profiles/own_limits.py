"""What in a printer's own profile breaks that profile's limits: its places, priming, start script.

It reads the plain moves and temperatures of the start script, no macro and nothing that a material
fills in; whole programs are judged by `gcode.check`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

from gcode.dialects import command_of, dialect_of
from gcode.profiles.schema import PrinterProfile

_CLOSE_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))")
_HEATS = {"M104": "hotend", "M109": "hotend", "M140": "bed", "M190": "bed"}
_AXES = "XYZ"
ROUNDED = 1.05  # what a script's digits may add
UNMOVED_MM = 0.05  # a shorter move leaves a blob, no bead


def own_fault(printer: PrinterProfile) -> str | None:
    """The first thing that breaks a limit: key, what, value and limit; None where nothing does."""
    return next(_faults(printer), None)


def _faults(printer: PrinterProfile) -> Iterator[str]:
    for key in ("park_mm", "prime_mm"):
        place = dict(zip(_AXES, getattr(printer, key), strict=True))
        yield from (f"key '{key}': {what}" for what in _out_of_reach(place, printer))
    for key in ("prime_length_mm", "retraction_mm"):
        value, most = getattr(printer, key), printer.max_extrude_only_mm
        if value > most:
            yield f"key '{key}' = {value:g} is more than 'max_extrude_only_mm' = {most:g}"
    start = _Start(printer)
    for number, line in enumerate(printer.start_gcode, 1):
        for what in start.wrong_with(line):
            yield f"key 'start_gcode', line {number} ('{line.strip()}'): {what}"


def _out_of_reach(place: dict[str, float], printer: PrinterProfile) -> Iterator[str]:
    x0, y0, x1, y1 = printer.reach_box_mm
    bounds = {"X": (x0, x1), "Y": (y0, y1), "Z": (0.0, printer.max_z_mm)}
    for axis, value in place.items():
        low, high = bounds[axis]
        if not low <= value <= high:
            yield f"{axis} {value:g} mm is out of reach, {low:g} to {high:g} mm"


class _Start:
    """A start script's machine as its moves change it; axes that are not homed are unknown."""

    def __init__(self, printer: PrinterProfile) -> None:
        self._printer = printer
        self._place: dict[str, float] = {}
        self._e_mm, self._feed_mm_s = 0.0, 0.0
        self._absolute, self._absolute_e = True, True

    def wrong_with(self, line: str) -> Iterator[str]:
        """The limits that the next line breaks, as phrases."""
        name, rest = command_of(line)
        words = {letter: float(value) for letter, value in _CLOSE_WORD.findall(rest)}
        if "{" in rest:  # what a material fills in is judged with that material
            return
        if name in _HEATS:
            what = _HEATS[name]
            limit_c = getattr(self._printer, f"max_{what}_c")
            value_c = words.get("S", words.get("R", 0.0))
            if value_c > limit_c:
                yield f"the {what} at {value_c:g} °C, 'max_{what}_c' is {limit_c:g}"
        elif name in {"G90", "G91"}:
            self._absolute = name == "G90"
            if dialect_of(self._printer.dialect).g90_sets_e:
                self._absolute_e = self._absolute
        elif name in {"M82", "M83"}:
            self._absolute_e = name == "M82"
        elif name == "G92":
            self._e_mm = words.get("E", self._e_mm)
        elif name == "G28":
            self._place = {}
        elif name in {"G0", "G1"}:
            yield from self._moved(words)

    def _moved(self, words: dict[str, float]) -> Iterator[str]:
        printer = self._printer
        self._feed_mm_s = words.get("F", 60.0 * self._feed_mm_s) / 60.0
        told = {axis: words[axis] for axis in _AXES if axis in words}
        here = self._place
        if not self._absolute:
            told = {axis: here[axis] + by for axis, by in told.items() if axis in here}
        way_mm = [told[axis] - here[axis] for axis in told if axis in here]
        known = all(axis in here for axis in told)
        self._place = {**here, **told}
        yield from _out_of_reach(told, printer)
        e_mm = words.get("E", self._e_mm if self._absolute_e else 0.0)
        pushed_mm = e_mm - self._e_mm if self._absolute_e else e_mm
        self._e_mm += pushed_mm
        length_mm = math.hypot(*way_mm) if way_mm else 0.0
        if pushed_mm <= 0 or not known:
            return
        area_mm2 = math.pi / 4 * printer.filament_diameter_mm**2
        if length_mm <= UNMOVED_MM:
            most_mm = printer.max_extrude_only_mm
            if pushed_mm > most_mm:
                yield f"{pushed_mm:g} mm of filament standing still, 'max_extrude_only_mm' is " + (
                    f"{most_mm:g}"
                )
            return
        section_mm2 = pushed_mm * area_mm2 / length_mm
        limit_mm2 = printer.max_bead_section_mm2
        if section_mm2 > ROUNDED * limit_mm2:
            yield f"a bead of {section_mm2:.3f} mm², 'max_bead_section_mm2' is {limit_mm2:g}"
        flow, most = section_mm2 * self._feed_mm_s, printer.max_volumetric_mm3_s
        if flow > ROUNDED * most:
            yield f"{flow:.1f} mm³/s of plastic, 'max_volumetric_mm3_s' is {most:g}"
