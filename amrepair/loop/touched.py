"""From touches to a scan: what each touch says of the surface around it, and how surely.

A tip with a flat of radius r rests on the highest place below it. So a touch that is low says that
all within r is at least as low, one that is not that something within r is as high: the rim between
a low one at p and another at q lies anywhere from p + r to q + r, in the mean at their middle + r.
Each speaks as far as a bead beside its flat; farther off nothing is known, which is not to say that
it is missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Mask, Points, Values
from amrepair.loop.touch_design import DEFAULT_TOUCHES, Flats, ProbeOptions
from amrepair.regions.options import RegionOptions
from amrepair.scans import PROBE, Scan

SIGHT_MM = 3000.0
"""Touches come from straight above: as rays, from so high that they slant by no hundredth."""


@dataclass(frozen=True, slots=True)
class Touches:
    """What was felt at one look, build frame.

    Attributes
    ----------
    place_mm
        (n, 3) XY, and the height that was felt.
    planned_mm
        (n,) the job's own height there.
    sigma_mm
        Standard deviation of one touch.
    options
        By which one is told to be off.
    """

    place_mm: Points
    planned_mm: Values
    sigma_mm: float
    options: ProbeOptions = DEFAULT_TOUCHES

    @property
    def off_mm(self) -> Values:
        """(n,) higher than planned; negative: lower."""
        return np.asarray(self.place_mm[:, 2] - self.planned_mm)

    @property
    def is_off(self) -> Mask:
        """(n,) whether a touch is beyond what a region goes on to, and beyond noise."""
        region = RegionOptions()
        allowed_mm = region.top_allowance_mm + region.registration_sigma_mm
        least_mm = max(region.grow_share * allowed_mm, self.options.sure_sigmas * self.sigma_mm)
        return np.asarray(np.abs(self.off_mm) > least_mm)


def measured_sigma_mm(
    repeated_mm: Float[np.ndarray, " r"], told_mm: float, options: ProbeOptions = DEFAULT_TOUCHES
) -> float:
    """Standard deviation of one touch, from touches of one place and what the profile says.

    Its variance is the mean of its inverse-gamma posterior, the profile's value as prior.
    """
    spread_mm2 = float(((repeated_mm - repeated_mm.mean()) ** 2).sum()) if len(repeated_mm) else 0.0
    freedom = max(len(repeated_mm) - 1, 0)
    prior = options.prior_touches
    return float(np.sqrt((prior * told_mm**2 + spread_mm2) / (prior + freedom)))


def scan_of(
    touches: Touches, flats: Flats, *, tip_radius_mm: float, reach_mm: float, source: str
) -> Scan:
    """The touches as a scan: every cell of the grid that one of them speaks of.

    Parameters
    ----------
    reach_mm
        How far from its middle a touch speaks.
    """
    xy_mm, is_low = touches.place_mm[:, :2], touches.is_off & (touches.off_mm < 0)
    rows, columns = np.nonzero(np.isfinite(flats.top_mm))
    cells_mm, tops_mm = flats.xy_mm(rows, columns), flats.top_mm[rows, columns]
    best, nearest_mm = np.full(len(cells_mm), np.inf), np.full(len(cells_mm), np.inf)
    owner = np.full(len(cells_mm), -1)
    for k, place in enumerate(xy_mm):
        own = (
            np.abs(tops_mm - touches.planned_mm[k]) < flats.options.flat_mm
        )  # of another flat it says nothing
        away = np.linalg.norm(cells_mm - place, axis=1)
        lead = away - (tip_radius_mm if is_low[k] else -tip_radius_mm)
        nearer = own & (away <= reach_mm + tip_radius_mm) & (lead < best)
        best[nearer], owner[nearer] = lead[nearer], k
        nearest_mm[own] = np.minimum(nearest_mm[own], away[own])
    said = nearest_mm <= reach_mm
    points = np.column_stack([cells_mm[said], touches.place_mm[owner[said], 2]])
    # a touch itself, wherever it lies in its cell
    points = np.concatenate([points, touches.place_mm])
    middle = points.mean(axis=0) + np.array([0.0, 0.0, SIGHT_MM])
    return Scan(
        points,
        touches.sigma_mm,
        PROBE,
        sensors_mm=middle[None],
        sensor_index=np.zeros(len(points), np.int64),
        source=source,
    )
