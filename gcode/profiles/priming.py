"""The line that a job primes with at the bed's edge, from a printer's and a material's limits.

A start script asks for it by a line `{prime_line}`. It draws within limits and judges nothing.
"""

from __future__ import annotations

import math

from gcode.profiles.schema import MaterialProfile, PrinterProfile

# As PrusaSlicer's and Cura's start scripts draw it: 60 mm thin, 40 mm thick, along X. A nozzle with
# a wide limit gets as thick as 0.72 mm² by these shares, of which two thirds lie on the bed.
THIN_MM, THICK_MM = 60.0, 40.0
THIN_LINE_RATIO, THICK_LINE_RATIO = 0.45, 0.9  # of the thickest bead that the profile allows
FLOW_RATIO = 0.9  # of what hotend and filament can melt: the hotend has only just become hot
# The speeds of those scripts, which a slower machine or filament goes below.
THIN_MM_S, THICK_MM_S, TRAVEL_MM_S = 1000.0 / 60.0, 10.0, 50.0
PRIME_EDGE_MM = 5.0  # from where the nozzle may no longer go
PRIME_LIFT_MM = 1.0


def prime_line(printer: PrinterProfile, material: MaterialProfile) -> tuple[str, ...]:
    """Commands, in absolute millimetres, from `prime_mm` along X; the extruder is left relative.

    Where the bed has no room for the whole line, it is as long as there is room for.
    """
    x_mm, y_mm, z_mm = printer.prime_mm
    room_mm = max(printer.reach_box_mm[2] - PRIME_EDGE_MM - x_mm, 0.0)
    share = min(1.0, room_mm / (THIN_MM + THICK_MM))
    flow_mm3_s = FLOW_RATIO * min(printer.max_volumetric_mm3_s, material.max_volumetric_mm3_s)
    area_mm2 = math.pi / 4 * printer.filament_diameter_mm**2
    up = f"F{_feed(printer.z_speed_mm_s)}"
    lines = [
        "M83",
        "G92 E0",
        f"G1 Z{z_mm:g} {up}",
        f"G1 X{x_mm:g} Y{y_mm:g} F{_feed(min(TRAVEL_MM_S, printer.travel_speed_mm_s))}",
    ]
    for length_mm, ratio, fast_mm_s in (
        (THIN_MM, THIN_LINE_RATIO, THIN_MM_S),
        (THICK_MM, THICK_LINE_RATIO, THICK_MM_S),
    ):
        section_mm2 = ratio * printer.max_bead_section_mm2
        speed_mm_s = min(fast_mm_s, flow_mm3_s / section_mm2, printer.max_speed_mm_s.x)
        along_mm = share * length_mm
        x_mm += along_mm
        if along_mm > 0:
            e_mm = section_mm2 * along_mm / area_mm2
            lines.append(f"G1 X{x_mm:.6g} E{e_mm:.5f} F{_feed(speed_mm_s)}")
    return (*lines, "G92 E0", f"G1 Z{max(z_mm, PRIME_LIFT_MM):g} {up}")


def _feed(speed_mm_s: float) -> int:
    """mm/min, rounded down."""
    return max(1, int(60.0 * speed_mm_s))
