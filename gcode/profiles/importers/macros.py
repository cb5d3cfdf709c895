"""Words of a Klipper machine's own, as the scripts of its preset name them.

A preset of a printer says what its maker's or owner's printer.cfg gives a meaning to
(`_ON_LAYER_CHANGE`, `CLEAN_NOZZLE`). What Klipper itself gives one to is no macro: a script does
not make known what the checker has left out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

# PrusaSlicer's and OrcaSlicer's keys of scripts.
_SCRIPT_KEY = re.compile(r"^(?!post_process)\w*gcode\w*$")
_LOGIC = re.compile(r"\{ *(?:if|elsif|else|endif)\b[^}]*\}")
_FIRST_WORD = re.compile(r"[A-Za-z_]\w*")
# Names, and numbered commands that Klipper passes over unless there is a macro for them.
_MACRO = re.compile(r"[A-Z_]\w{2,}|[GM]\d+")
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
    r"M(?:92|110|112|206|30[1-5]|428|50[0-4]|66[56]|851|999)|SYNC_\w+|TEMPERATURE_\w+|TEST_RESONANCES|TUNING_TOWER|TURN_OFF_HEATERS|UPDATE_\w+|Z_\w+"
)


def macros_named(settings: Mapping[str, str]) -> tuple[str, ...]:
    """The names that a preset's scripts begin lines with, in capitals, but for Klipper's own."""
    found = set()
    for key, text in settings.items():
        if not _SCRIPT_KEY.match(key):
            continue
        lines = _LOGIC.sub("\n", text.replace("\\n", "\n").replace('";"', "\n")).split("\n")
        words = (_FIRST_WORD.match(line.lstrip('" \t')) for line in lines)
        found |= {word[0].upper() for word in words if word is not None}
    return tuple(
        sorted(
            name for name in found if _MACRO.fullmatch(name) and not KLIPPERS_OWN.fullmatch(name)
        )
    )
