"""Which commands a program may hold, by dialect.

What changes the machine lastingly, or switches a protection off, is left out on purpose: EEPROM
(M500, M502), steps per mm (M92), homing offsets (M206, M428), PID tuning, the numbers of lines
(M110). So are curves whose course nothing here follows (G5 with words; without, some makers'
Marlins are told to resume after a power failure by it).

Sources: marlinfw.org/docs/gcode; klipper3d.org/G-Codes.html; Duet's G-code dictionary; Prusa's
`lib/Marlin` and `src/common/marlin_server` of Prusa-Firmware-Buddy, whose jobs slicers call Marlin;
and the scripts of PrusaSlicer's bundles, which every job of their printers begins with.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

_OPTIONAL_WORD = re.compile(r"([A-Z])\s*([-+]?(?:\d+\.?\d*|\.\d+))?")
_GIVEN = re.compile(r"""(?<=\s)([^\s=]+)(?:=("[^"]*"|'[^']*'|\S*))?""")
_LIST = re.compile(r"[-+]?[\d.]+(?::[-+]?[\d.]+)+")
_MOTION = "G0 G1 G2 G3 G4 G10 G11 G17 G20 G21 G28 G90 G91 G92"
_COMMON = (
    "M17 M18 M73 M82 M83 M84 M104 M105 M106 M107 M109 M114 M115 M117 M118 M140 M141 M190 "
    "M191 M201 M203 M204 M205 M220 M221 M300 M400 M900 T0 M155 M150 M486 M600 M601 M25"
)
_PROBING = "G29 G32 G34 G80 G81"
# Print timers, what a firmware reports, what it watches the filament with.
_MARLINS = (
    "M0 M1 M31 M75 M76 M77 M78 M80 M85 M113 M119 M123 M142 M145 M192 M200 M202 M302 M355 "
    "M412 M413 M911"
)
# Of Sailfish, and its heirs in Flashforge's and Dremel's printers: homing to the least and the
# greatest end stop, waits for nozzle and bed, the tool's number, places kept of end stops, motor
# currents, a fan of the housing; and end stops in software on.
_MARLINS_HEIRS = "G161 G162 M6 M7 M108 M132 M907 M651 M652 M211"
# Checks of printer, nozzle and firmware; the mass of the part, the area that is probed, pressure
# advance; a stuck filament; a multi-material unit's own commands; what another head is to be at
# soon.
_PRUSAS = (
    "M862.1 M862.2 M862.3 M862.4 M862.5 M862.6 M74 M555 M569 M572 M591 M593 "
    "M403 M701 M702 M708 TX TC T? M104.1"
)

KNOWN_COMMANDS: dict[str, frozenset[str]] = {
    "marlin": frozenset(f"{_MOTION} {_COMMON} {_PROBING} {_MARLINS} {_PRUSAS} {_MARLINS_HEIRS} "
                        "M217 M420 G5 G12 G27 G30 G33".split()),
    "prusa": frozenset(f"{_MOTION} {_COMMON} {_PROBING} {_MARLINS} {_PRUSAS} M907 G76".split()),
    "klipper": frozenset(
        f"{_MOTION} {_COMMON} {_PROBING} SET_VELOCITY_LIMIT SET_PRESSURE_ADVANCE "
        "BED_MESH_CALIBRATE BED_MESH_PROFILE BED_MESH_CLEAR SET_HEATER_TEMPERATURE "
        "TEMPERATURE_WAIT TURN_OFF_HEATERS "
        "QUAD_GANTRY_LEVEL PROBE SET_TMC_CURRENT SET_GCODE_OFFSET EXCLUDE_OBJECT_DEFINE "
        "EXCLUDE_OBJECT_START "
        "EXCLUDE_OBJECT_END SET_PRINT_STATS_INFO CLEAR_PAUSE PRINT_START PRINT_END START_PRINT "
        "END_PRINT PAUSE AMREPAIR_SCAN Z_TILT_ADJUST SET_FILAMENT_SENSOR SET_INPUT_SHAPER "
        "SET_DISPLAY_TEXT SET_LED SET_FAN_SPEED RESPOND TIMELAPSE_TAKE_FRAME "
        "TIMELAPSE_RENDER".split()
    ),
    "reprap": frozenset(f"{_MOTION} {_COMMON} {_PROBING} M116 M144 M207 M290 M561 M562 M566 M568 "
                        "M572 M376 M557 M558 M593 M0 M1 M226 G30 M75 M119 M122".split()),
}  # fmt: skip
# What measures or moves against the bed with a probe or the nozzle: never over a standing part.
PROBES = frozenset(
    {
        *("G12", "G29", "G30", "G32", "G33", "G34", "G76", "G80", "G81"),
        *("BED_MESH_CALIBRATE", "QUAD_GANTRY_LEVEL", "Z_TILT_ADJUST", "PROBE"),
    }
)
# Macros that begin a job by convention: they home all axes, most of them probe, and they heat to
# what their parameters say.
STARTS = frozenset({"START_PRINT", "PRINT_START"})
# What names those parameters: EXTRUDER, EXTRUDER_TEMP, HOTEND, NOZZLE_TEMP; BED, BED_TEMP.
_START_HEATS = {"M109": ("EXTRUDER", "HOTEND", "NOZZLE"), "M190": ("BED",)}
# Of a machine with several heads: what lays the present one down (Prusa's XL; RepRapFirmware's
# `T-1`, which is read as this).
PARKS = {"marlin": frozenset({"P0"}), "prusa": frozenset({"P0"}), "reprap": frozenset({"P0"})}
# What else chooses one of several heads; the next one's E is then 0 (klippy/extras/gcode_move.py,
# _handle_activate_extruder).
CHOOSES = {"klipper": frozenset({"ACTIVATE_EXTRUDER"})}
TOOL_ZEROES_E = frozenset({"klipper"})
# RepRapFirmware's heads have another temperature while they wait, which M104 and M109 set as well:
# who uses them knows of no two (GCodes2.cpp, case 104).
TWO_HEATS = frozenset({"reprap"})
# Klipper has none: what came of a line is kept until its end (klippy/gcode.py, _process_data;
# klippy/extras/virtual_sdcard.py). OrcaSlicer tells outlines in 9,000 characters.
LINE_LIMIT = {"marlin": 95, "prusa": 95, "klipper": math.inf, "reprap": 255}
# Marlin's G90 and G91 set the extruder's mode too.
G90_SETS_E = frozenset({"marlin"})
# Marlin's software end stops cut a move short at the machine's own, it moves axes that are not
# homed, and it answers that stray words are no command and goes on; Klipper gives the job up at the
# first, and refuses the second ("Must home axis first").
LENIENT_OF_MOVES = frozenset({"marlin", "prusa"})
# Whatever is configured ("Must home axis first").
GIVES_UP_UNHOMED = frozenset({"klipper"})
# Klipper's gcode_arcs.py: "G2/G3 does not support R moves"; the MK3's firmware reads I and J alone.
NO_ARCS_BY_RADIUS = frozenset({"klipper", "prusa"})
# "G2/G3 does not support relative move mode" (klippy/extras/gcode_arcs.py).
NO_ARCS_AFTER_G91 = frozenset({"klipper"})
# Klipper refuses G20 (klippy/extras/gcode_move.py), the MK3's firmware passes over it; both go on
# in millimetres.
NO_INCHES = frozenset({"klipper", "prusa"})
# Klipper's G91 makes E relative while it lasts, whatever M82 says.
G91_MOVES_E = frozenset({"klipper"})
# A tool that is not there is reported and the only one goes on (klippy/gcode.py, cmd_default).
LENIENT_OF_TOOLS = frozenset({"klipper"})


def parameters(command: str) -> dict[str, str]:
    """KEY=VALUE pairs of a named command, keys and values in capitals; quotes are kept."""
    return {key: value or "" for key, value in _GIVEN.findall(command.upper())}


def start_heats(given: dict[str, str]) -> Iterator[tuple[str, str]]:
    """The heaters that a macro of `STARTS` waits for: the command, and the parameter's key."""
    for command, names in _START_HEATS.items():
        for key, value in given.items():  # what is quoted is a plate's name
            if any(name in key for name in names) and value[:1] not in {'"', "'"}:
                yield command, key


def without_lists(rest: str) -> str:
    """RepRapFirmware's lists (`X10:90`, of several heaters or drives) as their largest value."""
    return _LIST.sub(lambda found: max(found[0].split(":"), key=float), rest)


def words_of(rest: str) -> tuple[dict[str, float | None], tuple[str, str, str] | None]:
    """Words after a command, and what is wrong with them: what, value, limit.

    A letter without a number is a flag.
    """
    words: dict[str, float | None] = {}
    at = 0
    while at < len(rest):
        if rest[at] in " \t":
            at += 1
            continue
        match = _OPTIONAL_WORD.match(rest, at)
        if match is None or (match.end() < len(rest) and rest[match.end()] in ".0123456789"):
            return words, ("word that is no number", rest.strip(), "a letter and one number")
        letter, text = match.groups()
        if letter in words and (text, words[letter]) != (None, None):  # flags, of stray words
            return words, ("word given twice", letter, "once")
        words[letter] = None if text is None else float(text)
        at = match.end()
    return words, None
