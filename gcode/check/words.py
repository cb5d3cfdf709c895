"""Which commands a program may hold, by dialect.

What changes the machine lastingly, or switches a protection off, is left out on purpose: EEPROM
(M500, M502), steps per mm (M92), cold extrusion (M302), homing offsets (M206, M428), PID tuning,
the numbers of lines (M110).
So are curves whose course nothing here follows (G5).
"""

from __future__ import annotations

import re

_OPTIONAL_WORD = re.compile(r"([A-Z])\s*([-+]?(?:\d+\.?\d*|\.\d+))?")
_MOTION = "G0 G1 G2 G3 G4 G10 G11 G17 G20 G21 G28 G90 G91 G92"
_COMMON = (
    "M17 M18 M73 M82 M83 M84 M104 M105 M106 M107 M109 M114 M115 M117 M118 M140 M141 M190 "
    "M191 M201 M203 M204 M205 M220 M221 M300 M400 M900 T0 M155 M150 M486 M600 M601 M25"
)
_PROBING = "G29 G32 G34 G80 G81"

KNOWN_COMMANDS: dict[str, frozenset[str]] = {
    "marlin": frozenset(f"{_MOTION} {_COMMON} {_PROBING} M0 M1 M31 M85 M113 M145 M420 M569 M593 "
                        "M862.1 M862.3 M413 M142".split()),
    "prusa": frozenset(f"{_MOTION} {_COMMON} {_PROBING} M0 M1 M31 M85 M862.1 M862.2 M862.3 M862.4 "
                       "M862.5 M907 M572 M142 G76".split()),
    "klipper": frozenset(
        f"{_MOTION} {_COMMON} {_PROBING} SET_VELOCITY_LIMIT SET_PRESSURE_ADVANCE "
        "BED_MESH_CALIBRATE BED_MESH_PROFILE BED_MESH_CLEAR SET_HEATER_TEMPERATURE "
        "TEMPERATURE_WAIT TURN_OFF_HEATERS "
        "QUAD_GANTRY_LEVEL SET_GCODE_OFFSET EXCLUDE_OBJECT_DEFINE EXCLUDE_OBJECT_START "
        "EXCLUDE_OBJECT_END SET_PRINT_STATS_INFO CLEAR_PAUSE PRINT_START PRINT_END START_PRINT "
        "END_PRINT PAUSE AMREPAIR_SCAN".split()
    ),
    "reprap": frozenset(f"{_MOTION} {_COMMON} {_PROBING} M116 M144 M207 M290 M561 M562 M566 M568 "
                        "M572 M376 M557 M558 M593 M0 M1 M226".split()),
}  # fmt: skip
# What measures or moves against the bed with a probe or the nozzle: never over a standing part.
PROBES = frozenset(
    {"G29", "G32", "G34", "G76", "G80", "G81", "BED_MESH_CALIBRATE", "QUAD_GANTRY_LEVEL"}
)
# Macros that begin a job by convention: they home all axes, and most of them probe.
STARTS = frozenset({"START_PRINT", "PRINT_START"})
LINE_LIMIT = {"marlin": 95, "prusa": 95, "klipper": 4095, "reprap": 255}
# Marlin's G90 and G91 set the extruder's mode too.
G90_SETS_E = frozenset({"marlin"})
# Klipper refuses G20 (klippy/extras/gcode_move.py), the MK3's firmware passes over it; both go on
# in millimetres.
NO_INCHES = frozenset({"klipper", "prusa"})
# Klipper's G91 makes E relative while it lasts, whatever M82 says.
G91_MOVES_E = frozenset({"klipper"})
# A tool that is not there is reported and the only one goes on (klippy/gcode.py, cmd_default).
LENIENT_OF_TOOLS = frozenset({"klipper"})


def parameters(command: str) -> dict[str, str]:
    """KEY=VALUE pairs of a named command, keys and values in capitals."""
    pairs = (word.partition("=") for word in command.upper().split()[1:])
    return {key: value for key, _, value in pairs}


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
        if letter in words:
            return words, ("word given twice", letter, "once")
        words[letter] = None if text is None else float(text)
        at = match.end()
    return words, None
