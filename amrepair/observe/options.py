"""Options of the background, that is of the points of a scan that are not the part."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BackgroundOptions:
    """Bed, skirt and clutter around the part.

    Attributes
    ----------
    most_excess_mm
        Points farther outside the template than this are clutter, or the bed's rim.
    band_mm
        Points up to this far above the part's lowest plane are the bed, a skirt or first-layer
        ooze: one thick layer.
    noise_sigmas
        The band is at least this many standard deviations of the scan's noise: of a plane's points
        one in 30,000 lies farther off.
    below_mm
        Below that band, points farther than this from the part do not belong to it.
    bed_cell_mm, bed_points
        The bed is told from what lies on it in cells of this width with this many points or more.
    bed_apart_mm
        Where something stands nearer than this, the bed does not tell the scan's errors.
    seen_underside, underside_rim_mm, foot_cell_mm, most_foot
        Where this share of the underside was seen, by points farther than `underside_rim_mm` from
        its rim, nothing lies under the part, so there is no bed. The share is counted in cells of
        `foot_cell_mm`, on about `most_foot` points.
    """

    most_excess_mm: float = 12.0
    band_mm: float = 0.35
    noise_sigmas: float = 4.0
    below_mm: float = 1.0
    bed_cell_mm: float = 1.0
    bed_points: int = 3
    bed_apart_mm: float = 1.0
    seen_underside: float = 0.3
    underside_rim_mm: float = 0.15
    foot_cell_mm: float = 1.0
    most_foot: int = 20_000


DEFAULT_BACKGROUND = BackgroundOptions()
"""The default of the test for regions."""
