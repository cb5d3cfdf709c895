"""What each command does to the machine, and what of it is refused.

Tools, heaters, homing, waits, limits and shifts of the coordinate system; moves are `motion`'s.
"""

from __future__ import annotations

import math
import re

from gcode.check import touches, waits
from gcode.check.findings import Policy, Touch
from gcode.check.heads import Hotend
from gcode.check.motion import PLACE_SLACK_MM, STILL_S, Motion
from gcode.check.words import TOOL_ZEROES_E, TWO_HEATS
from gcode.moves import ModalState, Program
from gcode.profiles import PrintSetup

HEATER_COMMANDS = {
    **dict.fromkeys(("M104", "M104.1", "M109"), "hotend"),
    **dict.fromkeys(("M140", "M190"), "bed"),
    **dict.fromkeys(("M141", "M191"), "chamber"),
}
# Marlin's AUTOTEMP (B, F) and presets (I) set what no number here says.
UNSAID_HEATS = {
    (dialect, what): letters
    for dialect in ("marlin", "prusa")
    for what, letters in (("hotend", "BFI"), ("bed", "I"))
}
EXTRUDER_NAME = re.compile(r"EXTRUDER(\d{0,3})")
# Factors on flow (M221) and speed (M220), per cent.
FACTOR_LIMITS = {"M221": ("flow factor", 50.0, 150.0), "M220": ("speed factor", 10.0, 200.0)}
# Axes that no profile has, of idlers, turntables and second carriages.
OTHER_AXES = frozenset("ABCUVW")
# s per second of G4's words
DWELLS = {"S": 1.0, "P": 1e-3}
# Klipper's Pressure_Advance.md has 0.05 to 1 s, the most with bowden extruders.
MOST_ADVANCE_S = 2.0
# Sailfish's homing, of axes by name: to their least place, and to their greatest, which is Z's away
# from the bed.
TO_THE_FAR_END = "G162"
TO_AN_END = frozenset({"G161", TO_THE_FAR_END})
HOMING_SLACK_MM = 0.2  # as much as the tip may press into what it prints on


class Commands(Motion):
    """The machine as commands change it, and the refusals of what they may not do.

    Parameters
    ----------
    planned
        Where the program may feel with the nozzle for what stands on the bed. The others are those
        of `Motion`.
    """

    def __init__(
        self,
        program: Program,
        setup: PrintSetup,
        standing_top_mm: float | None,
        initial: ModalState | None,
        policy: Policy = Policy.STRICT,
        planned: tuple[Touch, ...] = (),
    ) -> None:
        super().__init__(program, setup, standing_top_mm, initial, policy)
        self._touches = planned
        self._laid_down = False  # whether the chosen head was put back into its dock
        self._waited_s, self._waited_at = 0.0, -1
        self._tool = None if initial is None else f"T{initial.tool}"
        # The line that homed Z at the end, and how far E had gone by then.
        self._end_homed: tuple[int, float] | None = None

    def _number(self, text: str | None) -> float | None:
        try:
            return None if text is None else float(text)
        except ValueError:
            self._refuse("word that is no number", text or "", "a number")
            return None

    def _choose(self, tool: str) -> None:
        """Change the head, or the filament of one nozzle; refused where the printer has only one.

        Where there is a single tool it may have any number. Filament changers load by themselves,
        so that filament pulled back before a change comes back with the next push. A head has its
        own heater and its own filament. After a change of heads X and Y are not known here, while
        firmware and slicer both take Z to be what it was.
        """
        printer, pushed = self._setup.printer, self.moves.sums.pushed
        before = self._tool or ("T0" if pushed or printer.heads > 1 else tool)
        if tool != before and printer.heads == 1:
            limit = f"{before}, as it began; where heads change, the profile's 'heads' says so, "
            limit += "where filaments do, 'one_nozzle' too"
            self._refuse("change of tool or filament", tool, limit)
            self._tool = before
            return
        if printer.docks:
            number = int(tool[1:])
            if number >= printer.heads:  # a firmware that is lenient goes on with the one it has
                self._refuse("another tool", tool, heads_told(printer.heads))
                return
            self._head, self._short_mm3, self._laid_down = self._heads[number], 0.0, False
            self._place[:2] = None, None
            if tool != before and self._dialect in TOOL_ZEROES_E:
                self._e = 0.0
        elif tool != before:
            self._head.loads = True
        self._tool = tool

    def _meant(self, told: float | None) -> Hotend | None:
        """The head whose heater a line means, by a number or without one; None if there is none.

        Where there is one heater, the number may be that of the filament or of the only tool.
        """
        printer = self._setup.printer
        if told is None:
            return self._head
        there = 0 <= told < printer.heads
        if printer.docks:
            return self._heads[int(told)] if there else None
        return self._head if there or f"T{told:g}" in {"T0", self._tool} else None

    def _raised(self, what: str, value: str, limit: str, over_ratio: float) -> None:
        """Judge a limit of the machine that a program raises; refuse an infinite one always."""
        gross = math.nextafter(math.inf, 0.0)
        self._beyond(what, value, limit, over_ratio, gross)

    def _other_axes(self, words: dict[str, float | None]) -> None:
        for letter in sorted(OTHER_AXES & words.keys()):
            self._refuse("axis that the machine does not have", letter, "X, Y, Z and E")
        for letter in "HS" if self._dialect == "reprap" else "":
            if words.get(letter):
                told = f"{letter}{words[letter]:g}"
                self._refuse("move past the end stops or of one motor", told, f"{letter}0")

    def _dwell(self, words: dict[str, float | None]) -> None:
        """Judge a wait; waits add up as long as nothing moves between them."""
        if self._waited_at != self.moves.told:
            self._waited_s, self._waited_at = 0.0, self.moves.told
        for letter, per_s in DWELLS.items():
            seconds = (words.get(letter) or 0.0) * per_s
            if seconds < 0:
                self._refuse("wait", f"{seconds:g} s", "0 s or more")
                continue
            self._waited_s += seconds
            limit_s = STILL_S if self._hot_on_part else waits.LONGEST_S
            if self._waited_s > limit_s:
                what = "hot wait on the part" if self._hot_on_part else "wait of more than a day"
                self._refuse(what, f"{self._waited_s:g} s", f"{limit_s:g} s")
                self._waited_s = 0.0

    def _advance(self, seconds: float | None) -> None:
        self._within("pressure advance", seconds, 0.0, MOST_ADVANCE_S, " s")

    def _within(self, what: str, value: float | None, low: float, high: float, unit: str) -> None:
        if value is not None and not low <= value <= high:
            self._refuse(what, f"{value:g}{unit}", f"{low:g} to {high:g}{unit}")

    def _tool_settings(self, name: str, words: dict[str, float | None]) -> None:
        """RepRapFirmware's G10 with P or L: a tool's temperatures, or a shift."""
        for letter in "XYZ":
            if "L" in words and letter in words:
                self._refuse("shift of the coordinate system", f"{name} L {letter}", "0 mm")
            else:
                self._shift(f"{name} {letter}", words.get(letter))
        if "L" not in words:
            standby_c = waits.switched_c(words.get("R"), self._dialect)
            tool = {"T": words["P"]} if self._setup.printer.heads > 1 else {}
            self._temperature("standby", standby_c)
            if standby_c is not None and (head := self._meant(tool.get("T"))) is not None:
                head.standby_c = standby_c
            if "S" in words:
                self._heat("M104", {"S": words["S"]} | tool, of_two=True)

    def _shift(self, what: str, value_mm: float | None) -> None:
        if value_mm is not None and abs(value_mm) > PLACE_SLACK_MM:
            self._refuse("shift of the coordinate system", f"{what}{value_mm:g}", "0 mm")

    def _offset(self, given: dict[str, str]) -> None:
        for letter in "XYZ":
            for key in (letter, f"{letter}_ADJUST"):
                value = self._number(given.get(key, "0"))
                if value is None or abs(value) > PLACE_SLACK_MM:
                    self._refuse("shift of the coordinate system", f"{key}={given[key]}", "0 mm")

    def _scale(self, name: str, percent: float) -> None:
        """Set a factor on all flow or speed from here on."""
        what, low, high = FACTOR_LIMITS[name]
        if low <= percent <= high:
            self._factor[name] = percent / 100.0
        else:
            self._refuse(what, f"{percent:g} %", f"{low:g} to {high:g} %")

    def _heat(self, name: str, words: dict[str, float | None], *, of_two: bool = False) -> None:
        """Set a heater's temperature; with `of_two` not also that of a head that waits."""
        value_c = waits.told_c(words, self._dialect)
        what = HEATER_COMMANDS[name]
        for refusal in waits.for_cooling(name, what, words, self._dialect):
            self._refuse(*refusal)
        if value_c is None:
            self._refuse(f"{what} temperature missing", "no S", "a temperature")
            return
        for letter in UNSAID_HEATS.get((self._dialect, what), ""):
            if words.get(letter) is None:
                continue
            self._refuse("temperature that the firmware chooses", f"{name} {letter}", "S alone")
        head = self._meant(words.get("T")) if what == "hotend" else None
        if what == "hotend" and head is None:
            if value_c != 0:  # firmwares pass over one that is not there
                heads = heads_told(self._setup.printer.heads)
                self._refuse("hotend of another tool", f"T{words['T']:g}", heads)
            return
        self._temperature(what, value_c)
        if what == "bed":
            self._bed_c = value_c
        elif what == "chamber":
            self._chamber_c = value_c
        elif head is not None:
            head.heat(value_c, waits=name == "M109")
            if self._dialect in TWO_HEATS and not of_two:
                head.standby_c = value_c

    def _temperature(self, what: str, value_c: float | None) -> None:
        """Judge a temperature; a chamber's limit is the bed's."""
        printer = self._setup.printer
        limit_c = printer.max_bed_c if what in {"bed", "chamber"} else printer.max_hotend_c
        if value_c is not None and not 0 <= value_c <= limit_c:
            self._refuse(f"{what} temperature", f"{value_c:g} °C", f"{limit_c:g} °C")

    def _wait_for_sensor(self, given: dict[str, str]) -> None:
        sensor = given.get("SENSOR", "").strip("\"'")
        low_c, high_c = (self._number(given.get(key)) for key in ("MINIMUM", "MAXIMUM"))
        heats = EXTRUDER_NAME.fullmatch(sensor)
        head = self._meant(float(heats[1] or 0)) if heats else None
        told_c = None if head is None else head.target_c
        if sensor == "HEATER_BED":
            told_c = self._bed_c
        if told_c is not None and self._heats_unsaid:  # a macro may have told it more
            printer = self._setup.printer
            told_c = None if sensor == "HEATER_BED" else printer.max_hotend_c
        for refusal in waits.for_sensor(sensor, low_c, high_c, told_c, self._setup.printer):
            self._refuse(*refusal)
        if head is not None and low_c is not None:
            head.ready_c = low_c

    def _home(self, words: dict[str, float | None], by: str) -> None:
        axes = [k for k, letter in enumerate("XYZ") if letter in words] or [0, 1, 2]
        printer = self._setup.printer
        if self._occupied and not (printer.delta or printer.homes_up):
            if 2 in axes and printer.ends_homing and self._lenient:
                self._end_homed = self._end_homed or (self._line, self.moves.sums.way_mm)
                self._warn("homing Z over the part, as the maker's end script does", by, "none")
            elif 2 in axes and by != TO_THE_FAR_END:
                unless = "" if self.policy is Policy.STRICT else ", or 'homes_up' in the profile"
                told = f"{by} with Z" if by in {"G28", *TO_AN_END} else by
                self._refuse("homing Z onto a standing part", told, f"G28 X Y only{unless}")
            else:
                self._homes_above(self._place[2])
        for axis in axes:
            self._homed[axis] = True
            self._place[axis] = None  # the place of an end stop is the firmware's business

    def _homes_above(self, z_mm: float | None) -> None:
        """Refuse homing X or Y, which crosses the bed, below the top of what stands there."""
        top_mm = self._top_mm
        if top_mm is None or (z_mm is None and self._standing_top_mm is None):
            return
        if z_mm is None or z_mm < top_mm - HOMING_SLACK_MM:
            told = "an unknown height" if z_mm is None else f"Z {z_mm:g} mm"
            self._refuse("homing X or Y below the top of what stands there", told, f"{top_mm:g} mm")

    def _touch(self, words: dict[str, float | None]) -> None:
        """Judge a touch, and have the head swept down to it; words are in mm and mm/min."""
        planned = touches.planned_at(self._touches, self._place)
        wrong = touches.refusal_of(
            planned,
            words,
            self._place[2],
            self._text,
            self._head.target_c,
            self._setup.printer.probe,
        )
        if not self._absolute:
            self._refuse("touch that is not straight down", "G91", "G90")
        elif wrong is not None:
            self._refuse(*wrong)
        elif planned is not None:
            feed = words["F"] or 0.0
            self._move({"Z": planned.surface_mm / self._unit, "F": feed / self._unit})

    def _set_place(self, words: dict[str, float | None]) -> None:
        for axis, letter in enumerate("XYZ"):
            if letter in words:
                value, here = words[letter] or 0.0, self._place[axis]
                if here is None or abs(value * self._unit - here) > PLACE_SLACK_MM:
                    self._refuse("shift of the coordinate system", f"G92 {letter}", "only G92 E")
        if "E" in words:
            self._e = (words["E"] or 0.0) * self._unit
        elif not {"X", "Y", "Z"} & words.keys():
            # Klipper, and older firmwares too, take all axes to be at 0 then
            self._refuse("shift of the coordinate system", "G92 without an axis", "only G92 E")


def heads_told(count: int) -> str:
    """Which tools a printer has, in words."""
    return "the only one, T0" if count == 1 else f"those of {count} heads, from T0 on"
