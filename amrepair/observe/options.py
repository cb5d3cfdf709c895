"""What of a scan is not the part: each number once."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BackgroundOptions:
    """Bed, skirt and clutter around the part.

    Attributes
    ----------
    most_excess_mm
        Excess farther out than this is not part of the print (clutter, the bed's rim).
    band_mm
        Bed, skirt and first-layer ooze: one thick layer above the lowest plane of the part.
    noise_sigmas
        Of a plane's points one in 30,000 lies farther from it.
    below_mm
        Under the bed's band, what lies so far from the part is none of it.
    bed_cell_mm, bed_points
        What lies on the bed is told from it by places so wide, of so many points or more.
    bed_apart_mm
        So near to what stands on it the bed is not asked for a scan's errors.
    seen_underside, underside_rim_mm, foot_cell_mm, most_foot
        So much of the underside seen, so far from its rim: nothing lies under the part, there is no
        bed. It is counted in such cells, on so many points.
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


USUAL_BACKGROUND = BackgroundOptions()
"""What the test for regions goes by."""
