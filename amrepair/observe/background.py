"""Background: points of a scan that are none of the part: bed, skirt, far clutter."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Mask, Points, Values
from amrepair.frames import cells_of
from amrepair.observe.options import DEFAULT_BACKGROUND, BackgroundOptions
from amrepair.scans import Scan
from amrepair.template.port import Template

# The template's distance is the height under a plane: to rounding.
ON_PLANE_MM = 1e-4


def background(
    scan: Scan,
    template: Template,
    f_mm: Values,
    surface_mm: Float[np.ndarray, "m 3"],
    options: BackgroundOptions = DEFAULT_BACKGROUND,
) -> Mask:
    """Bed, skirt and far clutter: outside the part, near its lowest plane or far away."""
    low_z = float(template.bounds_mm[0, 2])
    if _shows_underside(scan, template, f_mm, surface_mm, options):
        # what lies beside the part in its lowest plane is where it stood when seen from above
        rim_mm = _rim_mm(scan, options)
        in_plane = np.abs(scan.points_mm[:, 2] - low_z) < rim_mm
        beside = in_plane & (f_mm > max(rim_mm, options.band_mm / 2))
        return np.asarray((f_mm > options.most_excess_mm) | beside)
    band_mm = max(options.band_mm, options.noise_sigmas * scan.sigma_mm)
    off = f_mm > band_mm / 2
    bed = off & (scan.points_mm[:, 2] < low_z + band_mm)
    bed |= _of_bed(scan.points_mm, low_z, off, band_mm, options)
    inside_band = scan.points_mm[:, 2] > low_z - band_mm
    # below the part there is no print; a whole-part scan has its own underside at f ≈ 0
    return bed | (f_mm > options.most_excess_mm) | (~inside_band & (f_mm > options.below_mm))


def _of_bed(
    points_mm: Points, low_z_mm: float, beside: Mask, band_mm: float, options: BackgroundOptions
) -> Mask:
    """Points over places of the bed that lie no higher, as a whole, than noise lifts them.

    A real scanner's errors hang together and have long tails: single points stand out of any band.
    How far they go the bed itself says, since nothing lies below it.
    """
    height_mm = points_mm[:, 2] - low_z_mm
    of_bed = np.zeros(len(points_mm), bool)
    near = np.flatnonzero(beside & (np.abs(height_mm) < options.below_mm))
    if len(near) == 0:
        return of_bed
    xy_mm = points_mm[near, :2]
    cell = cells_of(xy_mm, xy_mm.min(axis=0), options.bed_cell_mm)
    key = np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1))
    # by cell, and in each by height: sixteen bits are sorted by counting
    by_height = np.argsort(height_mm[near])
    key = key.astype(np.min_scalar_type(int(key.max())))[by_height]
    by_cell = near[by_height[np.argsort(key, kind="stable")]]
    count = np.bincount(key)
    count = count[count > 0]
    middle_mm = height_mm[by_cell[np.cumsum(count) - count + count // 2]]
    known = count >= options.bed_points
    lowest_mm = float(middle_mm[known].min(initial=0.0))
    low = known & (middle_mm < max(band_mm, -lowest_mm))
    of_bed[by_cell] = np.repeat(low, count)
    return of_bed


def _rim_mm(scan: Scan, options: BackgroundOptions) -> float:
    """How far from the lowest plane a point may lie that is on it."""
    return max(options.underside_rim_mm, options.noise_sigmas * scan.sigma_mm)


def _shows_underside(
    scan: Scan,
    template: Template,
    f_mm: Values,
    surface_mm: Float[np.ndarray, "m 3"],
    options: BackgroundOptions,
) -> bool:
    """Whether the part was seen from below: then what bulges there is no bed."""
    low_z = float(template.bounds_mm[0, 2])
    rim_mm = _rim_mm(scan, options)
    near = np.flatnonzero((np.abs(f_mm) < rim_mm) & (scan.points_mm[:, 2] < low_z + rim_mm))

    def cells_within(points_mm: Points) -> set[tuple[int, int]]:
        above = points_mm.copy()
        above[:, 2] = low_z + rim_mm + options.underside_rim_mm
        under = above[template.distance(above) < -rim_mm, :2] if len(above) else above[:, :2]
        index = np.unique(np.floor(under / options.foot_cell_mm).astype(np.int64), axis=0)
        return {(int(x), int(y)) for x, y in index}

    seen = cells_within(scan.points_mm[near[:: len(near) // options.most_foot + 1]])
    if not seen:
        return False
    foot = cells_within(surface_mm[surface_mm[:, 2] < low_z + ON_PLANE_MM])
    return len(seen & foot) > options.seen_underside * max(len(foot), 1)
