"""Words of a machine's own, as the scripts of its preset name them: macros and heads.

A preset of a printer says what its maker's or owner's printer.cfg gives a meaning to
(`_ON_LAYER_CHANGE`, `CLEAN_NOZZLE`). What Klipper itself gives one to is no macro: a script does
not make known what the checker has left out.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

# PrusaSlicer's and OrcaSlicer's keys of scripts.
_SCRIPT_KEY = re.compile(r"^(?!post_process)\w*gcode\w*$")
_LOGIC = re.compile(r"\{ *(?:if|elsif|else|endif)\b[^}]*\}")
_FIRST_WORD = re.compile(r"[A-Za-z_]\w*")
# Klipper: names, and numbered commands that it passes over unless there is a macro for them.
# RepRapFirmware looks on its card for numbers that it does not know, and knows none of four digits.
_MACROS_OF = {"klipper": re.compile(r"[A-Z_]\w{2,}|[GM]\d+"), "reprap": re.compile(r"[GM]\d{4,}")}
# klipper3d.org/G-Codes.html, and `[gcode_shell_command]`, which many add to it; and what changes a
# machine lastingly in other firmwares.
KLIPPERS_OWN = re.compile(
    r"ACCELEROMETER_\w+|ACTIVATE_EXTRUDER|ANGLE_\w+|AXIS_TWIST_\w+|BED_\w+|BLTOUCH_\w+|"
    r"CALC_MEASURED_SKEW|CLEAR_PAUSE|CANCEL_PRINT|DELTA_\w+|DUMP_\w+|ENDSTOP_PHASE_\w+|"
    r"EXCLUDE_OBJECT\w*|FIRMWARE_RESTART|FORCE_MOVE|GET_\w+|HELP|INIT_TMC|LDC_\w+|"
    r"LOAD_CELL_\w+|MANUAL_PROBE|MANUAL_STEPPER|MEASURE_AXES_NOISE|PALETTE_\w+|PAUSE|"
    r"PID_CALIBRATE|PROBE(?:_\w+)?|QUAD_GANTRY_LEVEL|QUERY_\w+|RESPOND|RESTART|"
    r"RESTORE_GCODE_STATE|RESUME|RUN_SHELL_COMMAND|SAVE_\w+|SCREWS_TILT_\w+|SDCARD_\w+|"
    r"SET_(?!GCODE_VARIABLE|PIN|IDLE_TIMEOUT|SERVO)\w+|SHAPER_CALIBRATE|STATUS|STEPPER_BUZZ|"
    r"M(?:92|110|112|206|30[1-5]|428|50[0-4]|66[56]|851|999)|SYNC_\w+|"
    r"TEMPERATURE_\w+|TEST_RESONANCES|TUNING_TOWER|TURN_OFF_HEATERS|UPDATE_\w+|Z_\w+"
)


_CHOSEN = re.compile(r"^[ \t]*(?:T|M10[49] .*?\bT)(\d+)\b", re.MULTILINE)


def heads_named(settings: Mapping[str, str]) -> int:
    """How many heads, or filaments, the scripts choose among or heat by number."""
    tools = (int(tool) for text in _scripts(settings) for tool in _CHOSEN.findall(text))
    return 1 + max(tools, default=0)


def macros_named(settings: Mapping[str, str], dialect: str) -> tuple[str, ...]:
    """What a preset's scripts begin lines with, in capitals, but for what no macro is named."""
    macro = _MACROS_OF.get(dialect)
    if macro is None:
        return ()
    lines = (line.lstrip('" \t') for text in _scripts(settings) for line in text.split("\n"))
    found = {word[0].upper() for word in map(_FIRST_WORD.match, lines) if word is not None}
    return tuple(
        sorted(name for name in found if macro.fullmatch(name) and not KLIPPERS_OWN.fullmatch(name))
    )


def _scripts(settings: Mapping[str, str]) -> Iterator[str]:
    """The texts of all scripts, a line for each command, without the slicer's conditions."""
    for key, text in settings.items():
        if _SCRIPT_KEY.match(key):
            yield _LOGIC.sub("\n", text.replace("\\n", "\n").replace('";"', "\n"))
