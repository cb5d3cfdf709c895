"""Words of a machine's own, as the scripts of its preset name them: macros and heads.

A preset of a printer says what its maker's or owner's printer.cfg gives a meaning to
(`_ON_LAYER_CHANGE`, `CLEAN_NOZZLE`). What Klipper itself gives one to is no macro: a script does
not make known what the checker has left out.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping

# PrusaSlicer's and OrcaSlicer's keys of scripts.
_SCRIPT_KEY = re.compile(r"^(?!post_process)\w*gcode\w*$")
_LOGIC = re.compile(r"\{ *(?:if|elsif|else|endif)\b[^}]*\}")
_FIRST_WORD = re.compile(r"[A-Za-z_]\w*(?:\.\d+)?")
# Klipper: names, and numbered commands that it passes over unless there is a macro for them.
# RepRapFirmware looks on its card for numbers that it does not know. Neither it nor Marlin knows
# one of four digits, but for M1000 and M1001, which resume and end a job: what a preset has of them
# are its maker's (AnkerMake's M4899, a curve of acceleration; Geeetech's M2012, a light).
_FOUR_DIGITS = r"[GM]\d{4,}"
_MACROS_OF = {
    "klipper": re.compile(r"[A-Z_]\w{2,}|[GMP]\d+(?:\.\d+)?"),
    "reprap": re.compile(rf"{_FOUR_DIGITS}|M98"),
    "marlin": re.compile(_FOUR_DIGITS),
}
# klipper3d.org/G-Codes.html, and `[gcode_shell_command]`, which many add to it; and what changes a
# machine lastingly in other firmwares.
KLIPPERS_OWN = re.compile(
    r"ACCELEROMETER_\w+|ACTIVATE_EXTRUDER|ANGLE_(?:\w+_)?CALIBRATE|ANGLE_DEBUG_\w+|"
    r"AXIS_TWIST_COMPENSATION_CALIBRATE|BED_MESH_\w+|BED_SCREWS_ADJUST|BED_TILT_CALIBRATE|"
    r"BLTOUCH_\w+|CALC_MEASURED_SKEW|CANCEL_PRINT|CLEAR_PAUSE|DELTA_(?:ANALYZE|CALIBRATE)|"
    r"ENDSTOP_PHASE_CALIBRATE|EXCLUDE_OBJECT\w*|FIRMWARE_RESTART|FORCE_MOVE|GET_POSITION|"
    r"INIT_TMC|LOAD_CELL_\w+|MANUAL_PROBE|MANUAL_STEPPER|MEASURE_AXES_NOISE|PAUSE|"
    r"PID_CALIBRATE|PROBE|PROBE_(?:ACCURACY|CALIBRATE)|QUAD_GANTRY_LEVEL|RESPOND|RESTART|"
    r"RESTORE_(?:GCODE|DUAL_CARRIAGE)_STATE|RESUME|RUN_SHELL_COMMAND|SAVE_CONFIG|"
    r"SCREWS_TILT_CALCULATE|SDCARD_\w+|SET_(?:DIGIPOT|DISPLAY_\w+|DUAL_CARRIAGE|"
    r"EXTRUDER_ROTATION_DISTANCE|FAN_SPEED|FILAMENT_SENSOR|GCODE_OFFSET|HEATER_TEMPERATURE|"
    r"INPUT_SHAPER|KINEMATIC_POSITION|LED|LED_TEMPLATE|PRESSURE_ADVANCE|PRINT_STATS_INFO|"
    r"RETRACTION|SKEW|STEPPER_\w+|TEMPERATURE_FAN_TARGET|TMC_\w+|VELOCITY_LIMIT|"
    r"Z_THERMAL_ADJUST)|SHAPER_CALIBRATE|STEPPER_BUZZ|SYNC_EXTRUDER_MOTION|TEMPERATURE_WAIT|"
    r"TEST_RESONANCES|TUNING_TOWER|TURN_OFF_HEATERS|Z_ENDSTOP_CALIBRATE|Z_OFFSET_APPLY_\w+|"
    r"Z_TILT_ADJUST|M(?:92|110|112|206|30[1-5]|428|50[0-4]|66[56]|851|999|100[01])"
)


_TAKEN = re.compile(r"^[ \t]*T(\d+)\b", re.MULTILINE)
_HEATED = re.compile(r"^[ \t]*M10[49] .*?\bT[1-9]", re.MULTILINE)
_CHOSEN = re.compile(r"^[ \t]*(?:T|M10[49] .*?\bT)(\d+)\b", re.MULTILINE)
_OF_A_NOZZLE = re.compile(r"nozzle_diameter|(?:de)?retract(?:ion)?_\w+")
MOST_HEADS = 64  # beyond are Bambu Lab's signs, T255 and T1000


_END_SCRIPT = "machine_end_gcode"
_HOMES_Z = re.compile(r"^[ \t]*G28[ \t]*(?:;.*)?$|^[ \t]*G28\b[^;\n]*Z", re.MULTILINE)


def heads_of(settings: Mapping[str, str]) -> tuple[int, bool]:
    """How many heads there are, and whether they are filaments to one nozzle.

    There are as many as nozzles and as filaments were loaded; of one nozzle as scripts name. Those
    of several may name more, as they are written for a maker's largest machine.
    """
    nozzles, loaded = _told_for(settings)
    texts = list(_scripts(settings))
    tools = (int(tool) for text in texts for tool in _CHOSEN.findall(text))
    named = [1 + tool for tool in tools if tool < MOST_HEADS and nozzles == 1]
    shared = settings.get("single_extruder_multi_material", "0") == "1"
    heated = any(_HEATED.search(text) for text in texts)
    one_nozzle = not heated and (shared or nozzles == 1)
    return max(nozzles, loaded, *named), one_nozzle


def head_used(text: str) -> int:
    """The head, or the filament, that the most of a job's text is printed with."""
    printed = text[: text.rfind("\nG1 ") + 1]
    taken = [
        (int(found[1]), found.end())
        for found in _TAKEN.finditer(printed)
        if int(found[1]) < MOST_HEADS
    ]
    ends = [at for _, at in taken[1:]] + [len(printed)] * bool(taken)
    share: Counter[int] = Counter()
    for (tool, at), end in zip(taken, ends, strict=True):
        share[tool] += end - at
    return max(share, key=share.__getitem__, default=0)


def of_head(values: Mapping[str, str], head: int, filament_keys: Collection[str]) -> dict[str, str]:
    """A job's settings with those of one head, or filament, where a value is told for each.

    Parameters
    ----------
    filament_keys
        Keys that tell a value for each filament; what tells one for each nozzle is known.
    """
    nozzles, filaments = _told_for(values)
    made = dict(values)
    for key, text in values.items():
        of_nozzle = _OF_A_NOZZLE.fullmatch(key) is not None
        count = nozzles if of_nozzle else filaments
        if count < 2 or not (of_nozzle or key in filament_keys):
            continue
        several = text.split(";" if ";" in text else ",")
        if len(several) == count and head < count:
            made[key] = several[head].strip()
    return made


def _told_for(settings: Mapping[str, str]) -> tuple[int, int]:
    """For how many nozzles, and for how many filaments, settings tell values."""
    nozzles, filaments = settings.get("nozzle_diameter", ""), settings.get("filament_type", "")
    return len(nozzles.split(",")), len(filaments.split(";"))


def ends_homing(settings: Mapping[str, str]) -> bool:
    """Whether the end script that came with OrcaSlicer homes Z, the part still standing there.

    What a user has changed of a preset its jobs list; of that nothing is taken.
    """
    changed = settings.get("different_settings_to_system")
    if changed is None or _END_SCRIPT in re.split(r"[;,\"]", changed):
        return False
    return _HOMES_Z.search(settings.get(_END_SCRIPT, "").replace("\\n", "\n")) is not None


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
