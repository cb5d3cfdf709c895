"""Judging a program line by line: which command each line is, in which dialect, and if allowed.

What a command then does to the machine, and what of that is refused, is in `commands`.
"""

from __future__ import annotations

import re

from gcode.check import limits, touches
from gcode.check.commands import (
    EXTRUDER_NAME,
    FACTOR_LIMITS,
    HEATER_COMMANDS,
    TO_AN_END,
    Commands,
    heads_told,
)
from gcode.check.findings import Policy, Text, Touch
from gcode.check.heads import switching_off
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

_COMMAND_HEAD = re.compile(r"([GMTP])\s*0*(\d+)(?:\.(\d+))?(?![\d._]|[A-Z][A-Z_])")
_NUMBERED_LINE = re.compile(r"N\s*\d")
# M486 A tells an object's name
FREE_TEXT = frozenset({"M117", "M118", "M486", "M708", "M862.3", "M862.6", "M115"})
_TOOL = re.compile(r"T\d+")
_NAMED = re.compile(r"([A-Z_]{3,}[A-Z0-9_]*)")
# A letter and a number, or a name and named words: some firmware's command.
_OF_SOME_FIRMWARE = re.compile(r"[A-Z]\s*-?\d.*|[A-Z_]\w*(?: +\w+=\S+)*")
_PLAIN = re.compile(r"^[\x20-\x7e\t]*$")
KLIPPER_HEATERS = {"HEATER_BED": "M140"}
TO_PLACES = frozenset({"G0", "G1", "G2", "G3"})
MOTORS_OFF = frozenset({"M18", "M84"})
# Prusa's scripts let filament be pushed from 155 °C on, to probe with a nozzle that does not ooze;
# PLA melts at 150 to 160 °C.
LEAST_COLD_C = 150.0
MOST_CURRENT_A = 2.0  # as much as the drivers bear that printers mostly have (TMC2209)
FULL_FAN = 255.0


class Judge(Commands):
    """Follows a program line by line: recognises each command, and judges it.

    The parameters are those of `Commands`.
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
        super().__init__(program, setup, standing_top_mm, initial, policy, planned)
        self._volume_line = volume_line(program.text)
        self.added: tuple[str, ...] = ()
        macros = {macro.split(maxsplit=1)[0].upper() for macro in setup.printer.macros}
        self._begins, self._ends = setup.printer.start_macro, setup.printer.end_macro
        own = {self._begins.name if self._begins else "", self._ends or ""}
        self._macros = macros | STARTS - {self._begins.name.upper() if self._begins else ""}
        self._numbered_macros = self._macros - KNOWN_COMMANDS[program.dialect]
        self._known = KNOWN_COMMANDS[program.dialect] | macros | {name.upper() for name in own}
        self._feels = touches.TOUCH_COMMANDS.get(program.dialect, "") if planned else ""
        if self._feels:
            self._known |= {self._feels}
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
                self._refuse("another tool", name, heads_told(self._setup.printer.heads))
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
            tool = EXTRUDER_NAME.fullmatch(heater)
            which = "M104" if tool else KLIPPER_HEATERS.get(heater, "M141")
            self._heat(which, {"S": target_c} | ({"T": float(tool[1] or 0)} if tool else {}))
        elif name == "ACTIVATE_EXTRUDER":
            tool = EXTRUDER_NAME.fullmatch(given.get("EXTRUDER", ""))
            chosen = f"T{int(tool[1] or 0)}" if tool else ""
            if chosen in self._known:
                self._choose(chosen)
            else:
                heads = heads_told(self._setup.printer.heads)
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
