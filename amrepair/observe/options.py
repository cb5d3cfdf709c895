"""Options of what is read off a scan: its background, and its views by the order of points."""

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


@dataclass(frozen=True, slots=True)
class OrderOptions:
    """Views told apart by the order of a cloud's points.

    Attributes
    ----------
    most_points
        Of more points every second, third … tells enough.
    most_across, points_across
        A place is a cell of this part of the cloud's diagonal: a few of a scanner's rows, of which
        a view has 200 and more; wider where a square of so many cells would have fewer points in
        each than this.
    most_parts
        A view begins at the boundary that parts the fewest pairs, in one of so many parts of the
        order.
    least_told
        A boundary must part this share of all pairs that are of two views.
    least_again
        Places must have been seen again so often, in the mean, or views hardly overlap.
    most_apart
        A view leaves several points at a place, so that at most this share of the pairs is of two.
    least_wide
        A view is so many cells wide, in the median of its views: a surface, not a line. Rows of a
        single view that were taken for views are 1 to 2 wide, real views 13 and more.
    most_beside
        Views lie in a cell one over the other, not side by side: by the variance between them over
        that within them (Fisher's F). Real views have 0.6 to 1.3, blocks of a fused cloud 3.8 and
        more.
    most_contradicted
        At most this share of the pairs that are of two views is contradicted. Ten real
        views, one after the other, leave 0.01; mixed points 0.14 and more.
    """

    most_points: int = 65_536
    most_across: float = 64.0
    points_across: float = 16.0
    most_parts: int = 512
    least_told: float = 0.002
    least_again: float = 0.2
    most_apart: float = 0.5
    least_wide: float = 4.0
    most_beside: float = 2.0
    most_contradicted: float = 0.05


DEFAULT_ORDER = OrderOptions()
"""The default of the test for regions."""
