"""Touches of a standing part: only those are allowed that the caller has planned."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from gcode.check.findings import Touch
from gcode.check.motion import PLACE_SLACK_MM
from gcode.moves import Program
from gcode.profiles import ProbeProfile

TOUCH_COMMANDS = {"marlin": "G38.2", "reprap": "G38.2", "klipper": "AMREPAIR_TOUCH"}
"""By dialect: touches whose depth the program tells.

G38.2 is a straight move until something is felt (Marlin's G38.cpp; RepRapFirmware has it too).
AMREPAIR_TOUCH is a macro of ours around Klipper's PROBE, which alone goes down to the
`position_min` of Z. Prusa's firmware has neither: G30 feels down to 2 or 5 mm below the bed, at up
to forty places some millimetres around, and lowers the nozzle to 2 mm above the bed afterwards
(Z_PROBE_LOW_POINT, offset_for_probe_try, Z_AFTER_PROBING), wherever the part's top is.
"""
FASTEST_TOUCH_MM_S = 4.0  # Z_PROBE_FEEDRATE_FAST of Marlin's Configuration.h


def touch_lines(program: Program) -> list[int]:
    """Which lines of a program are touches."""
    command = TOUCH_COMMANDS.get(program.dialect)
    if command is None or command not in program.text:
        return []
    lines = program.text.split("\n")
    return [k for k, line in enumerate(lines) if line.startswith(command + " ")]


def planned_at(touches: Sequence[Touch], place: Sequence[float | None]) -> Touch | None:
    """The touch that is planned where the nozzle is."""
    x_mm, y_mm = place[:2]
    if x_mm is None or y_mm is None:
        return None
    near = (t for t in touches if math.hypot(t.x_mm - x_mm, t.y_mm - y_mm) <= PLACE_SLACK_MM)
    return next(near, None)


def words_of_macro(
    given: Mapping[str, float | None], z_mm: float | None
) -> dict[str, float | None]:
    """Z and F, mm and mm/min, of what DEPTH and SPEED tell; other parameters stay as they are."""
    words = {key: value for key, value in given.items() if key not in {"DEPTH", "SPEED"}}
    depth_mm, speed_mm_s = given.get("DEPTH"), given.get("SPEED")
    words["Z"] = None if depth_mm is None or z_mm is None else z_mm - depth_mm
    words["F"] = None if speed_mm_s is None else 60.0 * speed_mm_s
    return words


def refusal_of(
    planned: Touch | None,
    words: Mapping[str, float | None],
    z_mm: float | None,
    text: str,
    hotend_c: float,
    probe: ProbeProfile | None,
) -> tuple[str, str, str] | None:
    """What is wrong with a touch, its value and the limit; None where nothing is.

    Parameters
    ----------
    words
        Of the command, mm and mm/min.
    z_mm
        Where the nozzle is.
    probe
        The printer's; None: the nozzle itself.
    """
    depth_mm, feed = words.get("Z"), words.get("F") or 0.0
    if planned is None:
        return "touch where none is planned", text, "the planned places"
    if words.keys() != {"Z", "F"} or depth_mm is None:
        return "touch that is not straight down", text, "Z and F alone"
    if depth_mm < planned.lowest_mm - PLACE_SLACK_MM:
        return "touch below its planned depth", f"Z {depth_mm:g} mm", f"{planned.lowest_mm:g} mm"
    if z_mm is None or z_mm < planned.surface_mm:
        return "touch from below what it is to feel", text, f"Z {planned.surface_mm:g} mm or more"
    if hotend_c > 0 and (probe is None or probe.kind == "nozzle"):
        return "touch with a hot nozzle", f"{hotend_c:g} °C", "heater off"
    if not 0 < feed <= 60.0 * FASTEST_TOUCH_MM_S:
        return "touch too fast", f"{feed / 60.0:g} mm/s", f"{FASTEST_TOUCH_MM_S:g} mm/s"
    return None
