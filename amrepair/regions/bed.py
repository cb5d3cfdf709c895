"""The bed beside a part: a plane that nothing lies below, by which a scan tells its own errors.

What a scan shows of a part may be errors or defects. What it shows under the bed can only be
errors, and the bed is seen in the same scan, by the same sensor, as well as the part is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from amrepair.arrays import Box, Mask, Points
from amrepair.field.fused import make_surfels
from amrepair.frames import cells_of, in_box
from amrepair.observe.incidence import incidence
from amrepair.observe.nuisance import fit_nuisance
from amrepair.observe.options import BackgroundOptions
from amrepair.observe.order import views_of
from amrepair.regions.error_calibration import BED_BESIDE, NORMAL_BY_BED, Calibration
from amrepair.regions.error_calibration_fit import (
    NONE_FAR_OFF,
    Sound,
    by_width,
    calibrated,
    sound_scales,
)
from amrepair.regions.inspected import Inspected
from amrepair.regions.options import RegionOptions
from amrepair.regions.significance import Level, tested
from amrepair.scans import Scan
from amrepair.scans.range_grid import FLYING

UP = np.array([0.0, 0.0, 1.0])


def of_bed(scan: Scan, part_mm: Box, tolerance_mm: float, options: RegionOptions) -> Sound | None:
    """What the bed beside a part shows of a scan's errors; None where too little of it is seen.

    Parameters
    ----------
    scan
        In the build frame, the bed at z = 0 to what a calibration of the scanner may be off.
    part_mm
        Box around the part.
    tolerance_mm
        δ, as the part is tested by.
    """
    levels = _levels(scan, part_mm, tolerance_mm, options)
    return None if levels is None else sound_scales(levels, options)


def by_beds(beds: Sequence[Sound], options: RegionOptions) -> Calibration:
    """What the bed in a run's looks tells of its scanner's errors.

    Returns
    -------
    Calibration
        How far window means wander and how what lies too low falls off, for too low and too high
        alike; `NORMAL_BY_BED` where there is neither.
    """
    found = calibrated(BED_BESIDE, beds, options)
    # the process leaves nothing there: of a part the test takes so much out
    process_mm = options.process_sigma_mm
    usual = all(
        told[0] <= np.hypot(process_mm, float(np.median([scale.window_mm for scale in alike])))
        for told, alike in zip(found.wander_mm, by_width(beds).values(), strict=True)
    )
    if usual and all(low == NONE_FAR_OFF for low, _ in found.far_off):
        return NORMAL_BY_BED
    both = [
        _and_process(*told, process_mm) for told in zip(found.wander_mm, found.freedom, strict=True)
    ]
    return replace(
        found,
        wander_mm=tuple(wander_mm for wander_mm, _ in both),
        freedom=tuple(freedom for _, freedom in both),
        # on the bed lies what a skirt, a brim or a nozzle left there; below it nothing does
        far_off=tuple((low, low) for low, _ in found.far_off),
    )


def _and_process(
    wander_mm: tuple[float, ...], freedom: tuple[float, ...], process_mm: float
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """What windows wander by where the process adds what is known, and its degrees of freedom."""
    told_mm = np.array(wander_mm)
    both_mm = np.hypot(told_mm, process_mm)
    known = np.full(len(told_mm), np.inf)
    np.divide(np.array(freedom) * both_mm**4, told_mm**4, out=known, where=told_mm > 0.0)
    return tuple(both_mm.tolist()), tuple(known.tolist())


def _levels(
    scan: Scan, part_mm: Box, tolerance_mm: float, options: RegionOptions
) -> tuple[Level, ...] | None:
    """The bed's tested scales: heights over a plane that is fitted, and bowed."""
    chosen = _beside(scan.points_mm, part_mm, options.far_mm, options.background)
    if scan.edge is not None:
        chosen &= scan.edge & FLYING == 0
    if not chosen.any():
        return None
    bed = scan.subset(chosen)
    every = np.ones(len(bed), bool)
    surfels = make_surfels(bed, bed.points_mm[:, 2], every, options.surfels)
    n = len(surfels)
    # narrower than windows are apart that tell by how much errors wander
    if n < options.least_cells or n * surfels.cell_mm**2 < (0.5 * options.far_mm) ** 2:
        return None
    normal = np.tile(UP, (n, 1))
    found = fit_nuisance(
        surfels.place_mm,
        normal,
        surfels.deviation_mm,
        surfels.count.astype(np.float64),
        tolerance_mm=tolerance_mm,
        correlation_mm=options.correlation_mm,
    )
    removed_mm = found.removed_mm(surfels.place_mm, normal, None)
    view = views_of(bed, options.order)
    shares = None if view is None else surfels.by_view(view)
    inspected = Inspected(
        cells=n,
        cell_mm=surfels.cell_mm,
        place_mm=surfels.place_mm,
        normal=normal,
        value_mm=surfels.deviation_mm - removed_mm,
        weight=surfels.count.astype(np.float64),
        tolerance_mm=np.full((2, n), tolerance_mm),
        facing=incidence(normal, surfels.toward_sensors(np.arange(n)), shares),
        pose_mm=np.zeros(n),
        shares=shares and replace(shares, value_mm=shares.value_mm - removed_mm[shares.place]),
    )
    return tested(
        inspected, replace(options, process_sigma_mm=0.0, most_windows=options.bed_windows), None
    )


def _beside(points_mm: Points, part_mm: Box, reach_mm: float, options: BackgroundOptions) -> Mask:
    """Points of the bed that lie so near to the part, and nothing stands there or beside."""
    apart_mm = options.bed_apart_mm
    low_mm, high_mm = part_mm[0, :2] - reach_mm, part_mm[1, :2] + reach_mm
    near = in_box(points_mm[:, :2], low_mm, high_mm)
    # of a part that is no higher as yet the foot is none of the bed, too
    near &= ~in_box(points_mm[:, :2], part_mm[0, :2] - apart_mm, part_mm[1, :2] + apart_mm)
    which = np.flatnonzero(near)
    found = np.zeros(len(points_mm), bool)
    cell = cells_of(points_mm[which, :2], low_mm, options.bed_cell_mm)
    stands = np.zeros(tuple(cells_of(high_mm[None], low_mm, options.bed_cell_mm)[0] + 1), bool)
    height_mm = points_mm[which, 2]
    stands[tuple(cell[height_mm > options.below_mm].T)] = True
    cells = round(apart_mm / options.bed_cell_mm)
    stands = ndimage.maximum_filter(stands, 2 * cells + 1)
    found[which] = ~stands[tuple(cell.T)] & (np.abs(height_mm) < options.below_mm)
    return found
