"""What speaks against a touch of a standing part: only what its caller planned is allowed."""

from __future__ import annotations

import math
from collections.abc import Sequence

from gcode.check.findings import Touch
from gcode.check.motion import PLACE_SLACK_MM

COMMAND = "G38.2"
"""A straight move until something is felt (Marlin's G38.cpp; RepRapFirmware has it too)."""
DIALECTS = frozenset({"marlin", "reprap"})
FASTEST_MM_S = 4.0  # Z_PROBE_FEEDRATE_FAST of Marlin's Configuration.h


def planned_at(touches: Sequence[Touch], place: Sequence[float | None]) -> Touch | None:
    """The touch that is planned where the nozzle is."""
    x_mm, y_mm = place[:2]
    if x_mm is None or y_mm is None:
        return None
    near = (t for t in touches if math.hypot(t.x_mm - x_mm, t.y_mm - y_mm) <= PLACE_SLACK_MM)
    return next(near, None)


def refusal_of(
    planned: Touch | None,
    words: dict[str, float | None],
    z_mm: float | None,
    text: str,
    hotend_c: float,
) -> tuple[str, str, str] | None:
    """What is wrong with a touch, its value and the limit; None where nothing is.

    Parameters
    ----------
    words
        Of the command, mm and mm/min.
    z_mm
        Where the nozzle is.
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
    if hotend_c > 0:
        return "touch with a hot nozzle", f"{hotend_c:g} °C", "heater off"
    if not 0 < feed <= 60.0 * FASTEST_MM_S:
        return "touch too fast", f"{feed / 60.0:g} mm/s", f"{FASTEST_MM_S:g} mm/s"
    return None
