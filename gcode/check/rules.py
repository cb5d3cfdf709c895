"""The rules that need no geometry of the part: one pass over the text with the machine's state."""

from __future__ import annotations

import math
import re

import numpy as np
from jaxtyping import Float

from gcode.check import plain_kernels as plain
from gcode.check.arcs import points_of_arc
from gcode.check.findings import Moves, Refusal, Text
from gcode.check.words import (
    COMMANDS,
    G90_SETS_E,
    G91_MOVES_E,
    LENIENT_OF_TOOLS,
    LINE_LIMIT,
    PROBES,
    STARTS,
    parameters,
    words_of,
)
from gcode.moves import ModalState, Program
from gcode.profiles import PrintSetup

# Plastic is told in five digits: what is shorter than this is judged with its neighbours.
SHORT_MM = 0.05
# Rounding of E and XYZ in the text, and a firmware's own flow, stay within this.
SECTION_SLACK = 1.05
FLOW_SLACK = 1.05
PLACE_SLACK_MM = 0.011
FASTEST_MM_S = 1000.0  # a feed beyond this is a slip of units, whatever the firmware clamps
INCH_MM = 25.4
HEATER_COMMANDS = {"M104": "hotend", "M109": "hotend", "M140": "bed", "M190": "bed"}
_HEAD = re.compile(r"(?:N\d+\s*)?([GMT])\s*0*(\d+)(?:\.(\d+))?(?![A-Z_])")
_TOOL = re.compile(r"T\d+")
_NAMED = re.compile(r"([A-Z_]{3,}[A-Z0-9_]*)")
_PLAIN = re.compile(r"^[\x20-\x7e\t]*$")
KLIPPER_HEATERS = {"EXTRUDER": "M104", "HEATER_BED": "M140"}
_MACHINE_LIMITS = {"M201": "max_acceleration_mm_s2", "M203": "max_speed_mm_s"}


class Judge:
    """Follows a program line by line; collects refusals and moves.

    Parameters
    ----------
    standing_top_mm
        Height of what stands on the bed; None for a bare bed.
    initial
        The machine's state before the first line; None: cold and not homed.
    """

    def __init__(
        self,
        program: Program,
        setup: PrintSetup,
        standing_top_mm: float | None,
        initial: ModalState | None,
    ) -> None:
        self.refusals: list[Refusal] = []
        self.moves = Moves()
        self.commands = 0
        self._setup, self._dialect = setup, program.dialect
        macros = {macro.split(maxsplit=1)[0].upper() for macro in setup.printer.macros}
        self._begins, self._ends = setup.printer.start_macro, setup.printer.end_macro
        own = {self._begins.name if self._begins else "", self._ends or ""}
        self._known = COMMANDS[program.dialect] | macros | {name.upper() for name in own}
        self._area_mm2 = math.pi / 4 * setup.printer.filament_diameter_mm**2
        self._alone = initial is None
        self._standing_top_mm = standing_top_mm
        self._occupied = initial is not None or standing_top_mm is not None
        state = initial
        self._place: list[float | None] = [None] * 3 if state is None else [*state.position_mm]
        # a standing part on a machine that is not switched off: its Z is still true
        self._homed = [state is not None] * 2 + [self._occupied]
        self._absolute = state.absolute_xyz if state else True
        self._absolute_e = state.absolute_e if state else True
        self._e = state.e_mm if state else 0.0
        self._feed_mm_s = state.feed_mm_s if state else 0.0
        self._unit = 1.0 if state is None or state.units_mm else INCH_MM
        self._hotend_c = state.hotend_c if state else 0.0
        self._ready_c = self._hotend_c  # what the hotend was waited for
        self._bed_c = state.bed_c if state else 0.0
        self._pulled_mm = 0.0
        self._short_mm3 = 0.0
        self._tool: str | None = None
        self._line, self._text = 0, ""
        printer = setup.printer
        x0, y0, x1, y1 = printer.reach_box_mm
        low = (x0 - PLACE_SLACK_MM, y0 - PLACE_SLACK_MM, -PLACE_SLACK_MM)
        high = (x1 + PLACE_SLACK_MM, y1 + PLACE_SLACK_MM, printer.max_z_mm + PLACE_SLACK_MM)
        self._limits_of_moves = (
            *low, *high, FASTEST_MM_S, self._area_mm2, SHORT_MM,
            SECTION_SLACK * printer.max_bead_section_mm2,
            FLOW_SLACK * setup.max_volumetric_mm3_s,
            printer.max_extrude_only_mm, LINE_LIMIT[program.dialect],
        )  # fmt: skip

    # ------------------------------------------------------------------ one line

    def read(self, number: int, raw: str) -> None:
        """Judge one line."""
        self._line, self._text = number, raw
        command = raw.partition(";")[0].strip()
        if not command:
            return
        self.commands += 1
        if not _PLAIN.match(command):
            self._refuse("character that firmwares do not take", repr(command), "plain ASCII")
            return
        if len(command) > LINE_LIMIT[self._dialect]:
            limit = LINE_LIMIT[self._dialect]
            self._refuse("line too long", f"{len(command)} characters", f"{limit}")
        upper = command.upper()
        head = _HEAD.match(upper)
        if head is None:
            self._named(upper)
            return
        name = head.group(1) + head.group(2) + (f".{head.group(3)}" if head.group(3) else "")
        lenient = self._dialect in LENIENT_OF_TOOLS and _TOOL.fullmatch(name) is not None
        if name not in self._known and not lenient:
            self._refuse("command unknown or not allowed", name, f"those of {self._dialect}")
            return
        if lenient:
            self._choose(name)
        if name in {"M117", "M118", "M862.3", "M115"}:
            return  # free text
        words, wrong = words_of(upper[head.end() :])
        if wrong is not None:
            self._refuse(*wrong)
        else:
            self._act(name, words)

    def follow(self, text: Text, first: int, end: int) -> int:
        """Judge plain moves among the lines first to end - 1; returns the first other line.

        What `read` would refuse is left to it, so that both say the same.
        """
        if None in self._place or not all(self._homed):
            return first
        state = self._state()
        counts = np.array([0, self.moves.count])
        rows = self.moves.with_room_for(end - first)
        at = plain.follow(
            text.data, text.starts, first - 1, end - 1, self._plain_limits(), state, rows, counts
        )
        self.commands += int(counts[0])
        self.moves.count = int(counts[1])
        x, y, z, self._e, self._feed_mm_s, self._pulled_mm, self._short_mm3 = state[:7].tolist()
        self._place = [x, y, z]
        return int(at) + 1

    def _state(self) -> Float[np.ndarray, " n"]:
        modes = (self._absolute, self._e_is_absolute, self._unit)
        used = (self._e, self._feed_mm_s, self._pulled_mm, self._short_mm3)
        return np.array([*self._place, *used, *modes], dtype=np.float64)

    def _plain_limits(self) -> Float[np.ndarray, " n"]:
        cold = self._ready_c < self._setup.printer.min_extrude_c
        return np.array([*self._limits_of_moves, cold], dtype=np.float64)

    def end(self, number: int, raw: str) -> None:
        """Judge what the program leaves behind after its last line."""
        self._line, self._text = number, raw
        if not self._alone:
            return
        heaters = (("hotend", self._hotend_c, "M104 S0"), ("bed", self._bed_c, "M140 S0"))
        for what, value_c, off in heaters:
            if value_c > 0:
                self._refuse(
                    f"{what} left on at the end, {off} is lacking", f"{value_c:g} °C", "0 °C"
                )

    def _refuse(self, what: str, value: str, limit: str) -> None:
        self.refusals.append(Refusal(self._line, self._text, what, value, limit))

    def _named(self, command: str) -> None:
        match = _NAMED.match(command)
        name = match.group(1) if match else command.split(maxsplit=1)[0]
        given = parameters(command)
        if name not in self._known:
            self._refuse("command unknown or not allowed", name, f"those of {self._dialect}")
        elif name in PROBES and self._occupied:
            self._refuse("probing over a standing part", name, "nothing may stand there")
        elif self._begins is not None and name == self._begins.name.upper():
            self._home({}, name)
            for heat, key in (("M109", self._begins.hotend), ("M190", self._begins.bed)):
                self._heat(heat, {"S": self._number(given.get(key.upper()))})
        elif name in STARTS and self._occupied:
            self._refuse("homing Z onto a standing part", name, "nothing may stand there")
        elif name == "TURN_OFF_HEATERS" or (self._ends and name == self._ends.upper()):
            self._hotend_c = self._ready_c = self._bed_c = 0.0
            if name != "TURN_OFF_HEATERS":
                self._place = [None] * 3  # it goes where it parks
        elif name == "SET_HEATER_TEMPERATURE" and given.get("HEATER") in KLIPPER_HEATERS:
            # without a target Klipper takes 0
            target_c = self._number(given.get("TARGET", "0"))
            self._heat(KLIPPER_HEATERS[given["HEATER"]], {"S": target_c})
        elif name == "SET_GCODE_OFFSET":
            self._offset(given)

    def _offset(self, given: dict[str, str]) -> None:
        for letter in "XYZ":
            for key in (letter, f"{letter}_ADJUST"):
                value = self._number(given.get(key, "0"))
                if value is None or abs(value) > PLACE_SLACK_MM:
                    self._refuse("shift of the coordinate system", f"{key}={given[key]}", "0 mm")

    def _number(self, text: str | None) -> float | None:
        try:
            return None if text is None else float(text)
        except ValueError:
            self._refuse("word that is no number", text or "", "a number")
            return None

    def _choose(self, tool: str) -> None:
        """The only tool may have any number, but another one later would be another colour."""
        used = bool(self.moves.pushed_mm3.any())
        before = self._tool or ("T0" if used else tool)
        if tool != before:
            self._refuse("change of tool", tool, f"one tool: {before}")
        self._tool = before

    # ------------------------------------------------------------------ commands

    def _act(self, name: str, words: dict[str, float | None]) -> None:
        if name in {"G0", "G1"}:
            self._move(words)
        elif name in {"G2", "G3"}:
            self._arc(words, clockwise=name == "G2")
        elif name == "G28":
            self._home(words)
        elif name in PROBES and self._occupied:
            self._refuse("probing over a standing part", name, "nothing may stand there")
        elif name in {"G90", "G91"}:
            self._absolute = name == "G90"
            if self._dialect in G90_SETS_E:
                self._absolute_e = self._absolute
        elif name in {"M82", "M83"}:
            self._absolute_e = name == "M82"
        elif name in {"G20", "G21"}:
            self._unit = INCH_MM if name == "G20" else 1.0
        elif name == "G92":
            self._set_place(words)
        elif name in HEATER_COMMANDS:
            self._heat(name, words)
        elif name in {"G10", "G11"}:
            self._refuse("firmware retraction", name, "its length is not in the program")
        elif name in _MACHINE_LIMITS:
            self._limits(name, words)
        elif name == "M221" and not 50 <= (words.get("S") or 100.0) <= 150:
            self._refuse("flow factor", f"{words.get('S'):g} %", "50 to 150 %")
        elif name == "M220" and not 10 <= (words.get("S") or 100.0) <= 200:
            self._refuse("speed factor", f"{words.get('S'):g} %", "10 to 200 %")

    def _limits(self, name: str, words: dict[str, float | None]) -> None:
        """Machine limits may be lowered, not raised far above what the profile says."""
        limits = getattr(self._setup.printer, _MACHINE_LIMITS[name])
        for letter in "XYZE":
            value, limit = words.get(letter), getattr(limits, letter.lower())
            if value is not None and value > 20 * limit:
                self._refuse(f"machine limit of {letter}", f"{value:g}", f"{limit:g}")

    def _heat(self, name: str, words: dict[str, float | None]) -> None:
        value_c = words.get("S", words.get("R"))
        what = HEATER_COMMANDS[name]
        if value_c is None:
            self._refuse(f"{what} temperature missing", "no S", "a temperature")
            return
        printer = self._setup.printer
        limit_c = printer.max_hotend_c if what == "hotend" else printer.max_bed_c
        if not 0 <= value_c <= limit_c:
            self._refuse(f"{what} temperature", f"{value_c:g} °C", f"{limit_c:g} °C")
        if what == "bed":
            self._bed_c = value_c
        else:
            self._hotend_c = value_c
            # waited for, or cooling from now on
            if name == "M109" or value_c < self._ready_c:
                self._ready_c = value_c

    def _home(self, words: dict[str, float | None], by: str = "G28 with Z") -> None:
        axes = [k for k, letter in enumerate("XYZ") if letter in words] or [0, 1, 2]
        if 2 in axes and self._occupied:
            self._refuse("homing Z onto a standing part", by, "G28 X Y only")
        for axis in axes:
            self._homed[axis] = True
            self._place[axis] = None  # the place of an end stop is the firmware's business

    def _set_place(self, words: dict[str, float | None]) -> None:
        for axis, letter in enumerate("XYZ"):
            if letter in words:
                value, here = words[letter] or 0.0, self._place[axis]
                if here is None or abs(value * self._unit - here) > PLACE_SLACK_MM:
                    self._refuse("shift of the coordinate system", f"G92 {letter}", "only G92 E")
        if "E" in words:
            self._e = (words["E"] or 0.0) * self._unit
        elif not words:
            self._e = 0.0

    # ------------------------------------------------------------------ moves

    def _target(self, words: dict[str, float | None]) -> list[float | None]:
        target = list(self._place)
        for axis, letter in enumerate("XYZ"):
            value = words.get(letter)
            if value is None:
                continue
            here = self._place[axis]
            if self._absolute:
                target[axis] = value * self._unit
            elif here is not None:
                target[axis] = here + value * self._unit
            elif axis == 2 and value < 0:
                what = "relative move down from an unknown height"
                self._refuse(what, f"{value:g} mm", "up only")
        return target

    def _pushed(self, words: dict[str, float | None]) -> float:
        value = words.get("E")
        if value is None:
            return 0.0
        value *= self._unit
        pushed = value - self._e if self._e_is_absolute else value
        self._e += pushed
        return pushed

    @property
    def _e_is_absolute(self) -> bool:
        return self._absolute_e and (self._absolute or self._dialect not in G91_MOVES_E)

    def _feed(self, words: dict[str, float | None]) -> None:
        value = words.get("F")
        if value is None:
            if "F" in words:
                self._refuse("feed without a number", "F", "mm/min")
            return
        feed_mm_s = value * self._unit / 60.0
        if not 0 < feed_mm_s <= FASTEST_MM_S:
            self._refuse("feed", f"{feed_mm_s:g} mm/s", f"0 to {FASTEST_MM_S:g} mm/s")
        self._feed_mm_s = max(feed_mm_s, 1e-3)

    def _move(self, words: dict[str, float | None]) -> None:
        for letter in "XYZE":
            if letter in words and words[letter] is None:
                self._refuse("axis without a number", letter, "a number")
                return
        self._feed(words)
        moved = [axis for axis, letter in enumerate("XYZ") if letter in words]
        for axis in moved:
            if not self._homed[axis]:
                self._refuse("move before homing", "XYZ"[axis], "home first")
                self._homed[axis] = True  # said once
        target = self._target(words)
        self._go(target, self._pushed(words), moved=bool(moved))

    def _arc(self, words: dict[str, float | None], *, clockwise: bool) -> None:
        self._feed(words)
        target, here = self._target(words), self._place
        pushed = self._pushed(words)
        if None in here or None in target or (not self._absolute and "R" in words):
            self._refuse("arc from an unknown place", "G2/G3", "a known place")
            return
        x0, y0, z0 = (float(v or 0.0) for v in here)
        x1, y1, z1 = (float(v or 0.0) for v in target)
        if words.get("R") is not None:
            self._refuse("arc told by its radius", "R", "I and J")
            return
        centre = tuple((words.get(letter) or 0.0) * self._unit for letter in "IJ")
        start, end = (x0, y0, z0), (x1, y1, z1)
        apart_mm, points = points_of_arc(start, end, (centre[0], centre[1]), clockwise=clockwise)
        if not points:
            self._refuse("arc whose ends lie on two circles", f"{apart_mm:.3f} mm", "0.05 mm")
            return
        for k, point in enumerate(points, 1):
            last = k == len(points)
            self._go(target if last else [*point], pushed / len(points), moved=True)

    def _go(self, target: list[float | None], pushed_mm: float, *, moved: bool) -> None:
        here = self._place
        if moved:
            self._bounds(target)
        length_mm = 0.0
        known = None not in here and None not in target
        if known:
            start = (float(here[0] or 0), float(here[1] or 0), float(here[2] or 0))
            end = (float(target[0] or 0), float(target[1] or 0), float(target[2] or 0))
            length_mm = math.dist(start, end)
            if length_mm > 0:
                self.moves.add(self._line, start, end, max(pushed_mm, 0.0) * self._area_mm2)
        elif moved and self._standing_top_mm is not None and pushed_mm <= 0:
            z = target[2]
            if z is not None and z < self._standing_top_mm:
                self._refuse(
                    "move at an unknown place below the top of what stands there",
                    f"Z {z:g} mm",
                    f"{self._standing_top_mm:g} mm",
                )
        self._place = target
        if pushed_mm:
            self._extrude(pushed_mm, length_mm, known=known)

    def _bounds(self, target: list[float | None]) -> None:
        x0, y0, x1, y1 = self._setup.printer.reach_box_mm
        for axis, low, high in ((0, x0, x1), (1, y0, y1), (2, 0.0, self._setup.printer.max_z_mm)):
            value = target[axis]
            if value is not None and not low - PLACE_SLACK_MM <= value <= high + PLACE_SLACK_MM:
                letter = "XYZ"[axis]
                self._refuse(f"{letter} out of reach", f"{value:g} mm", f"{low:g} to {high:g} mm")

    def _extrude(self, pushed_mm: float, length_mm: float, *, known: bool) -> None:
        printer = self._setup.printer
        if pushed_mm > 0 and self._ready_c < printer.min_extrude_c:
            self._refuse(
                "cold extrusion", f"hotend waited for at {self._ready_c:g} °C",
                f"{printer.min_extrude_c:g} °C",
            )  # fmt: skip
            self._ready_c = math.inf  # said once
        if length_mm <= SHORT_MM:
            self._short(pushed_mm)
            return
        self._short_mm3 = 0.0
        if pushed_mm < 0:
            self._pull(pushed_mm)
            return
        back_mm = min(pushed_mm, self._pulled_mm)  # a wipe or an unretraction on the move
        self._pulled_mm -= back_mm
        volume_mm3 = (pushed_mm - back_mm) * self._area_mm2
        section_mm2 = volume_mm3 / length_mm
        limit_mm2 = printer.max_bead_section_mm2
        if section_mm2 > SECTION_SLACK * limit_mm2:
            self._refuse("bead too thick", f"{section_mm2:.3f} mm²", f"{limit_mm2:g} mm²")
        flow = section_mm2 * self._feed_mm_s
        limit = self._setup.max_volumetric_mm3_s
        if flow > FLOW_SLACK * limit:
            self._refuse("melts more than the hotend can", f"{flow:.1f} mm³/s", f"{limit:g} mm³/s")

    def _short(self, pushed_mm: float) -> None:
        """Standing, or nearly so: plastic adds up until the nozzle has moved on."""
        printer = self._setup.printer
        if pushed_mm < 0:
            self._pull(pushed_mm)
            return
        back_mm = min(pushed_mm, self._pulled_mm)
        self._pulled_mm -= back_mm
        self._short_mm3 += (pushed_mm - back_mm) * self._area_mm2
        allowed_mm3 = printer.max_extrude_only_mm * self._area_mm2
        if self._short_mm3 > allowed_mm3:
            self._refuse(
                "pushes filament standing still",
                f"{self._short_mm3 / self._area_mm2:.1f} mm",
                f"{printer.max_extrude_only_mm:g} mm",
            )
            self._short_mm3 = 0.0

    def _pull(self, pushed_mm: float) -> None:
        self._pulled_mm -= pushed_mm
        limit_mm = self._setup.printer.max_extrude_only_mm
        if self._pulled_mm > limit_mm:
            self._refuse("pulls filament back", f"{self._pulled_mm:.1f} mm", f"{limit_mm:g} mm")
            self._pulled_mm = 0.0
