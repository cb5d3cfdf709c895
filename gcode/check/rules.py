"""The rules of commands: one pass over the text, with the machine's state (`motion`)."""

from __future__ import annotations

import math
import re

from gcode.check import limits, touches, waits
from gcode.check.findings import Policy, Text, Touch
from gcode.check.heads import Hotend, switching_off
from gcode.check.motion import PLACE_SLACK_MM, STILL_S, Motion
from gcode.check.words import (
    CHOOSES,
    G90_SETS_E,
    KNOWN_COMMANDS,
    LENIENT_OF_MOVES,
    LENIENT_OF_TOOLS,
    LINE_LIMIT,
    NO_INCHES,
    PARKS,
    PROBES,
    STARTS,
    TOOL_ZEROES_E,
    TWO_HEATS,
    parameters,
    start_heats,
    without_lists,
    words_of,
)
from gcode.dialects import AS_LENGTH, volume_line
from gcode.moves import ModalState, Program
from gcode.profiles import PrintSetup
from gcode.profiles.own_settings import SAME_NOZZLE_MM
from gcode.reader.text_kernels import INCH_MM

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
_COMMAND_HEAD = re.compile(r"([GMTP])\s*0*(\d+)(?:\.(\d+))?(?![\d._]|[A-Z][A-Z_])")
_NUMBERED_LINE = re.compile(r"N\s*\d")
# M486 A tells an object's name
FREE_TEXT = frozenset({"M117", "M118", "M486", "M708", "M862.3", "M862.6", "M115"})
_TOOL = re.compile(r"T\d+")
_NAMED = re.compile(r"([A-Z_]{3,}[A-Z0-9_]*)")
# A letter and a number, or a name and named words: some firmware's command.
_OF_SOME_FIRMWARE = re.compile(r"[A-Z]\s*-?\d.*|[A-Z_]\w*(?: +\w+=\S+)*")
_PLAIN = re.compile(r"^[\x20-\x7e\t]*$")
_EXTRUDER = re.compile(r"EXTRUDER(\d{0,3})")
KLIPPER_HEATERS = {"HEATER_BED": "M140"}
# Factors on flow (M221) and speed (M220), per cent.
FACTOR_LIMITS = {"M221": ("flow factor", 50.0, 150.0), "M220": ("speed factor", 10.0, 200.0)}
TO_PLACES = frozenset({"G0", "G1", "G2", "G3"})
MOTORS_OFF = frozenset({"M18", "M84"})
# Axes that no profile has, of idlers, turntables and second carriages.
OTHER_AXES = frozenset("ABCUVW")
# s per second of G4's words
DWELLS = {"S": 1.0, "P": 1e-3}
# Klipper's Pressure_Advance.md has 0.05 to 1 s, the most with bowden extruders.
MOST_ADVANCE_S = 2.0
# Prusa's scripts let filament be pushed from 155 °C on, to probe with a nozzle that does not ooze;
# PLA melts at 150 to 160 °C.
LEAST_COLD_C = 150.0
MOST_CURRENT_A = 2.0  # as much as the drivers bear that printers mostly have (TMC2209)
FULL_FAN = 255.0
# Sailfish's homing, of axes by name: to their least place, and to their greatest, which is Z's away
# from the bed.
TO_THE_FAR_END = "G162"
TO_AN_END = frozenset({"G161", TO_THE_FAR_END})
HOMING_SLACK_MM = 0.2  # as much as the tip may press into what it prints on


class Judge(Motion):
    """Follows a program line by line; parameters are those of `Motion`."""

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
        self._laid_down = False  # the head that was chosen
        self._volume_line = volume_line(program.text)
        self.added: tuple[str, ...] = ()
        macros = {macro.split(maxsplit=1)[0].upper() for macro in setup.printer.macros}
        self._begins, self._ends = setup.printer.start_macro, setup.printer.end_macro
        own = {self._begins.name if self._begins else "", self._ends or ""}
        self._macros = macros | STARTS - {self._begins.name.upper() if self._begins else ""}
        self._numbered_macros = self._macros - KNOWN_COMMANDS[program.dialect]
        self._waited_s, self._waited_at = 0.0, -1
        self._known = KNOWN_COMMANDS[program.dialect] | macros | {name.upper() for name in own}
        self._feels = touches.TOUCH_COMMANDS.get(program.dialect, "") if planned else ""
        if self._feels:
            self._known |= {self._feels}
        self._tool = None if initial is None else f"T{initial.tool}"
        # The line that homed Z at the end, and how far E had gone by then.
        self._end_homed: tuple[int, float] | None = None
        if setup.printer.heads > 1:
            self._known |= {f"T{k}" for k in range(setup.printer.heads)}
            self._known |= PARKS.get(program.dialect, frozenset())
            self._known |= CHOOSES.get(program.dialect, frozenset())

    def read(self, number: int, raw: str) -> None:
        """Judge one line."""
        self._line, self._text = number, raw
        command = raw.partition(";")[0].strip()
        if not command or command.startswith("@"):  # a host's own: the link sends none of it
            return
        self.commands += 1
        if not _PLAIN.match(command):
            self._refuse("character that firmwares do not take", repr(command), "plain ASCII")
            return
        if len(command) > LINE_LIMIT[self._dialect]:
            limit = LINE_LIMIT[self._dialect]
            self._refuse("line too long", f"{len(command)} characters", f"{limit}")
        upper = command.upper()
        if _NUMBERED_LINE.match(upper):
            self._numbered("line number of its own", upper)
            return
        if self._dialect == "reprap" and upper.startswith("T-1"):
            upper = f"P0 {upper[3:]}"
        head = _COMMAND_HEAD.match(upper)
        if head is None:
            self._named(upper)
            return
        name = head.group(1) + head.group(2) + (f".{head.group(3)}" if head.group(3) else "")
        tool = _TOOL.fullmatch(name) is not None
        if name in self._numbered_macros:
            self._heats_unsaid = True
            if self._occupied and name.partition(".")[0] in PROBES:
                self._refuse("probing over a standing part", name, "nothing may stand there")
            if name == "M98" and not self._occupied:  # it begins the job, as Klipper's START_PRINT
                self._home({}, name)
            return
        if name not in self._known and not (tool and self._dialect in LENIENT_OF_TOOLS):
            if tool:
                self._refuse("another tool", name, _heads_told(self._setup.printer.heads))
            else:
                self._refuse("command unknown or not allowed", name, f"those of {self._dialect}")
            return
        if name in FREE_TEXT:
            return
        if "*" in upper:
            self._numbered("checksum of its own", upper[upper.index("*") :])
            return
        rest = upper[head.end() :]
        if self._dialect == "reprap" and name not in TO_PLACES:
            rest = without_lists(rest)
        words, wrong = words_of(rest)
        if wrong is not None:
            self._refuse(*wrong)
        else:
            self._act(name, words)

    def _numbered(self, what: str, told: str) -> None:
        """The link puts its own around each line, and firmwares read both."""
        self._refuse(what, told.split(maxsplit=1)[0], "none: the link adds it")

    def end(self, text: Text, *, leave_heaters: bool = False) -> None:
        """Judge what the program is as a whole, and what it leaves behind after its last line.

        Heaters that a user's job leaves on are switched off by lines that are `added`, unless
        somebody asked to leave them.
        """
        self._backwards(text)
        if self._volume_line is not None:
            self._line, self._text = self._volume_line, text.line(self._volume_line)
            self._refuse("extrusion told as a volume", "mm³", AS_LENGTH)
        if self._end_homed and self.moves.sums.way_mm > self._end_homed[1]:
            self._line, self._text = self._end_homed[0], text.line(self._end_homed[0])
            self._refuse("homing Z onto a standing part", "printing goes on", "at the end alone")
        self._line, self._text = len(text), text.line(len(text))
        if not self._alone:
            return
        heaters = (
            *switching_off(self._heads, None if self._laid_down else self._head, self._dialect),
            ("bed", self._bed_c, "M140 S0"),
            ("chamber", self._chamber_c, "M141 S0"),
        )
        for what, value_c, off in heaters:
            if value_c <= 0:
                continue
            told = f"{what} left on at the end, {off} is"
            if leave_heaters:
                self._warn(f"{told} left out as asked", f"{value_c:g} °C", "0 °C")
            elif self.policy is Policy.STRICT:
                self._refuse(f"{told} lacking", f"{value_c:g} °C", "0 °C")
            else:
                self._warn(f"{told} added", f"{value_c:g} °C", "0 °C")
                self.added += (off,)

    def _named(self, command: str) -> None:
        match = _NAMED.match(command)
        name = match.group(1) if match else command.split(maxsplit=1)[0]
        given = parameters(command)
        if name not in self._known:
            self._unknown(name, command)
        elif name == self._feels:
            told = {key: self._number(value) for key, value in given.items()}
            self._touch(touches.words_of_macro(told, self._place[2]))
        elif name in PROBES and self._occupied:
            self._refuse("probing over a standing part", name, "nothing may stand there")
        elif self._begins is not None and name == self._begins.name.upper():
            self._home({}, name)
            for heat, key in (("M109", self._begins.hotend), ("M190", self._begins.bed)):
                self._heat(heat, {"S": self._number(given.get(key.upper()))})
        elif name in STARTS:
            self._home({}, name)
            for heat, key in start_heats(given):
                several = [self._number(value) for value in given[key].split(",")]
                self._heat(heat, {"S": max(several, key=lambda value: value or 0.0)})
        elif name == "TURN_OFF_HEATERS" or (self._ends and name == self._ends.upper()):
            self._bed_c = self._chamber_c = 0.0
            for head in self._heads:
                head.off()
            if name != "TURN_OFF_HEATERS":
                self._place = [None] * 3  # it goes where it parks
        elif name == "SET_HEATER_TEMPERATURE":
            # Where no target is given, Klipper takes 0.
            target_c = self._number(given.get("TARGET", "0"))
            heater = given.get("HEATER", "")
            tool = _EXTRUDER.fullmatch(heater)
            which = "M104" if tool else KLIPPER_HEATERS.get(heater, "M141")
            self._heat(which, {"S": target_c} | ({"T": float(tool[1] or 0)} if tool else {}))
        elif name == "ACTIVATE_EXTRUDER":
            tool = _EXTRUDER.fullmatch(given.get("EXTRUDER", ""))
            chosen = f"T{int(tool[1] or 0)}" if tool else ""
            if chosen in self._known:
                self._choose(chosen)
            else:
                heads = _heads_told(self._setup.printer.heads)
                self._refuse("another tool", given.get("EXTRUDER", "no EXTRUDER"), heads)
        elif name == "SET_PRESSURE_ADVANCE":
            self._advance(self._number(given.get("ADVANCE")))
        elif name == "SET_TMC_CURRENT":
            for key in ("CURRENT", "HOLDCURRENT"):
                current_a = self._number(given.get(key))
                self._within(f"motor's {key.lower()}", current_a, 0.0, MOST_CURRENT_A, " A")
        elif name == "SET_GCODE_OFFSET":
            self._offset(given)
        elif name == "TEMPERATURE_WAIT":
            self._wait_for_sensor(given)
        elif name == "SET_VELOCITY_LIMIT":
            told = {key: self._number(value) for key, value in given.items()}
            for raised in limits.raised_by_klipper(told, self._setup.printer):
                self._raised(*raised)

        if name in self._macros:
            self._heats_unsaid = True

    def _unknown(self, name: str, command: str) -> None:
        stray = _OF_SOME_FIRMWARE.fullmatch(command) is None
        if stray and self._dialect in LENIENT_OF_MOVES:
            self._beyond("no command, which the firmware passes over", name, "none", 1.0)
            return
        own = "; a macro of the printer's own is told in its profile's 'macros'"
        limit = f"those of {self._dialect}{own if self._dialect == 'klipper' else ''}"
        self._refuse("command unknown or not allowed", name, limit)

    def _wait_for_sensor(self, given: dict[str, str]) -> None:
        sensor = given.get("SENSOR", "").strip("\"'")
        low_c, high_c = (self._number(given.get(key)) for key in ("MINIMUM", "MAXIMUM"))
        heats = _EXTRUDER.fullmatch(sensor)
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
        """Each head, and each of several filaments to one nozzle, may be taken at any time.

        The only tool may have any number. What changes the filament loads it behind our back, so
        what was pulled back of the last one comes back as far as the next one is pushed here. A
        head has its own heater and its own filament; where it is after a change the firmware and
        the job's slicer know, who both take its height for what it was.
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
                self._refuse("another tool", tool, _heads_told(printer.heads))
                return
            self._head, self._short_mm3, self._laid_down = self._heads[number], 0.0, False
            self._place[:2] = None, None
            if tool != before and self._dialect in TOOL_ZEROES_E:
                self._e = 0.0
        elif tool != before:
            self._head.loads = True
        self._tool = tool

    def _meant(self, told: float | None) -> Hotend | None:
        """The head whose heater a line means, by its number or none; None where it is not there.

        Of one heater the filament, or the only tool, may have its number.
        """
        printer = self._setup.printer
        if told is None:
            return self._head
        there = 0 <= told < printer.heads
        if printer.docks:
            return self._heads[int(told)] if there else None
        return self._head if there or f"T{told:g}" in {"T0", self._tool} else None

    # ------------------------------------------------------------------ commands

    def _act(self, name: str, words: dict[str, float | None]) -> None:
        if name in TO_PLACES:
            self._other_axes(words)
        if name in {"G0", "G1"}:
            self._move(words)
        elif name in {"G2", "G3"}:
            self._arc(words, clockwise=name == "G2")
        elif name == "G4":
            self._dwell(words)
        elif name == "G28" or name in TO_AN_END:
            self._home(words, name)
        elif name == self._feels:
            self._touch({letter: v and v * self._unit for letter, v in words.items()})
        elif name in PROBES and self._occupied:
            self._refuse("probing over a standing part", name, "nothing may stand there")
        elif name in {"G90", "G91"}:
            self._absolute = name == "G90"
            if self._dialect in G90_SETS_E:
                self._absolute_e = self._absolute
        elif name in {"M82", "M83"}:
            self._absolute_e = name == "M82"
        elif name in {"G20", "G21"}:
            if name == "G20" and self._dialect in NO_INCHES:
                self._refuse("inches, which the firmware reads as millimetres", name, "G21")
                return
            self._unit = INCH_MM if name == "G20" else 1.0
        elif name == "G92":
            self._set_place(words)
        elif name in HEATER_COMMANDS:
            self._heat(name, words)
        elif name in {"M116", "M6"}:  # wait for all heaters, and for the nozzle's
            for head in self._heads if name == "M116" else (self._head,):
                head.ready_c = head.target_c
        elif name in {"G10", "M568"} and self._dialect == "reprap" and {"P", "L"} & words.keys():
            self._tool_settings(name, words)
        elif name in {"G10", "G11"}:
            told = "firmware retraction, whose length no program tells"
            self._refuse(told, name, "G1 E: switch it off in the slicer")
        elif name in limits.LIMIT_COMMANDS:
            for raised in limits.raised_by(name, words, self._setup.printer, self._dialect):
                self._raised(*raised)
        elif name in FACTOR_LIMITS and words.get("S") is not None:
            self._scale(name, words["S"] or 0.0)
        elif name in MOTORS_OFF and "S" not in words:
            off = [k for k, letter in enumerate("XYZ") if letter in words]
            for axis in off or ([] if "E" in words else range(3)):
                self._homed[axis] = False
        elif _TOOL.fullmatch(name):
            self._choose(name)
        else:
            self._set_one(name, words)

    def _raised(self, what: str, value: str, limit: str, over_ratio: float) -> None:
        """A limit of the machine's; what never arrives is refused in any job."""
        gross = math.nextafter(math.inf, 0.0)
        self._beyond(what, value, limit, over_ratio, gross)

    def _set_one(self, name: str, words: dict[str, float | None]) -> None:
        """Commands that set one thing."""
        if name == "M290":
            for letter in "XYZS":
                self._shift(f"M290 {letter}", words.get(letter))
        elif name == "M106":
            self._within("fan", words.get("S"), 0.0, FULL_FAN, "")
        elif name == "M572":
            self._advance(words.get("S"))
        elif name == "M302":
            if words.get("P") or (words.get("S") or 0.0) < LEAST_COLD_C:
                told = " ".join(f"{letter}{value or 0:g}" for letter, value in words.items())
                self._refuse("cold extrusion allowed", told or name, f"S{LEAST_COLD_C:g} and more")
        elif name == "M200" and (words.get("D") or words.get("S")):
            self._refuse("extrusion told as a volume", name, AS_LENGTH)
        elif name in {"G27", "M132", "P0"}:  # where it parks, and where its end stops are
            self._place = [None, None, self._place[2] if name == "P0" else None]
            self._laid_down = self._laid_down or name == "P0"
        elif name == "G5" and words:
            self._refuse("curve that nothing here follows", name, "G1, G2 and G3")
        elif name == "M211" and 0.0 in words.values():
            self._refuse("end stops in software off", name, "S1")
        elif name == "M108" and "T" not in words:  # Marlin's, which ends a wait for heat
            self._refuse("end of a wait for heat", name, "the wait")
        elif name == "M558" and "P" in words:
            self._refuse("type of the probe that homes Z", name, "the machine's own")
        elif name == "M862.1":
            nozzle_mm = self._setup.printer.nozzle_diameter_mm
            low_mm, high_mm = nozzle_mm - SAME_NOZZLE_MM, nozzle_mm + SAME_NOZZLE_MM
            self._within("nozzle that it was made for", words.get("P"), low_mm, high_mm, " mm")

    def _other_axes(self, words: dict[str, float | None]) -> None:
        for letter in sorted(OTHER_AXES & words.keys()):
            self._refuse("axis that the machine does not have", letter, "X, Y, Z and E")
        for letter in "HS" if self._dialect == "reprap" else "":
            if words.get(letter):
                told = f"{letter}{words[letter]:g}"
                self._refuse("move past the end stops or of one motor", told, f"{letter}0")

    def _dwell(self, words: dict[str, float | None]) -> None:
        """Waits add up as long as nothing moves between them."""
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

    def _scale(self, name: str, percent: float) -> None:
        """A factor on all flow or speed from here on."""
        what, low, high = FACTOR_LIMITS[name]
        if low <= percent <= high:
            self._factor[name] = percent / 100.0
        else:
            self._refuse(what, f"{percent:g} %", f"{low:g} to {high:g} %")

    def _heat(self, name: str, words: dict[str, float | None], *, of_two: bool = False) -> None:
        """A heater's temperature; of two that a head has, `of_two`, or the only one."""
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
                heads = _heads_told(self._setup.printer.heads)
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
        """No chamber gets as hot as a bed."""
        printer = self._setup.printer
        limit_c = printer.max_bed_c if what in {"bed", "chamber"} else printer.max_hotend_c
        if value_c is not None and not 0 <= value_c <= limit_c:
            self._refuse(f"{what} temperature", f"{value_c:g} °C", f"{limit_c:g} °C")

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

    def _touch(self, words: dict[str, float | None]) -> None:
        """The head is swept down to what it is to feel; words in mm and mm/min."""
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

    def _homes_above(self, z_mm: float | None) -> None:
        """X and Y are homed across the bed: above all that stands there."""
        top_mm = self._top_mm
        if top_mm is None or (z_mm is None and self._standing_top_mm is None):
            return
        if z_mm is None or z_mm < top_mm - HOMING_SLACK_MM:
            told = "an unknown height" if z_mm is None else f"Z {z_mm:g} mm"
            self._refuse("homing X or Y below the top of what stands there", told, f"{top_mm:g} mm")

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


def _heads_told(count: int) -> str:
    return "the only one, T0" if count == 1 else f"those of {count} heads, from T0 on"
