"""Units at the boundary: feed rates are mm/min only where text is read or written.

Everything inside is millimetres, seconds, mm/s, degrees Celsius and ratios in 0..1.
"""

from __future__ import annotations

import math

SECONDS_PER_MINUTE = 60.0


def mm_min_from_mm_s(speed_mm_s: float) -> float:
    """Feed rate of a G-code `F` word, mm/min."""
    return speed_mm_s * SECONDS_PER_MINUTE


def mm_s_from_mm_min(feed_mm_min: float) -> float:
    """Speed, mm/s, of a G-code `F` word."""
    return feed_mm_min / SECONDS_PER_MINUTE


def filament_area_mm2(filament_diameter_mm: float) -> float:
    """Cross-section of a filament, mm²; an E of 1 mm carries this many mm³."""
    return math.pi * filament_diameter_mm**2 / 4.0
