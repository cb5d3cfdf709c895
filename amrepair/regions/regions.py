"""Regions: labelled cells and template points grouped into defects with size and type.

Figures here come from the surface alone (area × depth); `deficit` measures volume by solids.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from amrepair.arrays import Mask, Numbers, Values
from amrepair.field.groups import group_points, touching_mm
from amrepair.field.near import nearest_within
from amrepair.frames import box_of
from amrepair.regions.anomaly import DefectType, Label, Region
from amrepair.regions.error_calibration import Calibration
from amrepair.regions.noise import Noise
from amrepair.regions.observation import Observed
from amrepair.regions.significance import Level
from amrepair.template.port import Template

# Template points alone (seen through by rays) need this much surface to be a region.
MIN_AREA_MM2 = 2.0
# How dense a scan is at a place so many of the template's points around tell: 2 mm at 0.6 mm.
AREA_POINTS = 12


@dataclass(frozen=True, slots=True)
class Tested:
    """The result of the test on one scan.

    Attributes
    ----------
    levels, noise
        What was tested at each scale, and the scan's errors in a summary.
    calibration
        The calibration that was used; None where the scan's own errors were.
    missing, excess
        (s,) cells of scanned surface that belong to a region.
    gone, gone_p_value
        (m,) template points that rays went through and that belong to a region, and the expected
        number of false regions as significant.
    log_p
        (2, b) logarithm of the expected number of false regions as significant, for missing and
        for excess, at each inspected place.
    limit_mm, top_mm
        The depth at which half of the places would be significant over a few cells; and the same
        under the top of the layer just printed.
    """

    levels: tuple[Level, ...]
    calibration: Calibration | None
    noise: Noise
    missing: Mask
    excess: Mask
    gone: Bool[np.ndarray, " m"]
    gone_p_value: Float[np.ndarray, " m"]
    log_p: Float[np.ndarray, "2 all"]
    limit_mm: float
    top_mm: float


def find_regions(seen: Observed, test: Tested, surface_label: Numbers) -> tuple[Region, ...]:
    """Group labelled cells and template points to regions, the largest first."""
    s = seen.surfels
    labelled = surface_label == int(Label.MISSING)
    gone, gone_p = seen.surface_mm[labelled], test.gone_p_value[labelled]
    found: list[Region] = []
    for side, (label, cells, extra) in enumerate(
        ((Label.MISSING, test.missing, gone), (Label.EXCESS, test.excess, gone[:0]))
    ):
        which = np.flatnonzero(cells)
        points = np.concatenate([s.place_mm[which], extra])
        group = group_points(points, reach_mm=touching_mm(s.cell_mm))
        area_mm2 = _area_of(which, seen)
        for g in range(int(group.max()) + 1 if len(group) else 0):
            mine = group == g
            own = which[mine[: len(which)]]
            n_gone = int(mine[len(which) :].sum())
            if len(own) == 0 and n_gone * seen.each_mm2 < MIN_AREA_MM2:
                continue
            region = _region(label, seen, own, area_mm2[mine[: len(which)]], points[mine])
            sure = np.append(
                np.exp(test.log_p[side, own]), gone_p[: len(extra)][mine[len(which) :]]
            )
            found.append(replace(region, p_value=float(sure.min(initial=1.0))))
    return tuple(sorted(found, key=lambda r: -r.volume_mm3))


def _region(
    label: Label,
    seen: Observed,
    own: Numbers,
    area_mm2: Values,
    points_mm: Float[np.ndarray, "p 3"],
) -> Region:
    """Measure one group, of the cells `own` that stand for so much area each, and classify it."""
    box = box_of(points_mm)
    off_mm = np.abs(seen.surfels.deviation_mm[own])
    depth = float(off_mm.max()) if len(own) else float(np.ptp(box, 0).min())
    area = float(area_mm2.sum())
    kind = classify(label, depth, area, box, seen.template)
    return Region(label, kind, float((area_mm2 * off_mm).sum()), area, depth, box)


def _area_of(which: Int[np.ndarray, " c"], seen: Observed) -> Float[np.ndarray, " c"]:
    """(c,) the area of the template, mm², that the points of some cells stand for.

    That is their share of all points over the template around: noise spreads one place over several
    cells, one above the other, so that cells themselves are more than the surface holds.
    """
    s = seen.surfels
    feet_mm = s.place_mm - s.deviation_mm[:, None] * seen.outward
    over = nearest_within(feet_mm, seen.surface_mm, touching_mm(s.cell_mm))
    points = np.bincount(over[over >= 0], s.count[over >= 0], len(seen.surface_mm))
    shown = (points > 0) | (seen.nearest >= 0)
    every = min(AREA_POINTS, len(shown))
    around = cKDTree(seen.surface_mm).query(feet_mm[which], every)[1].reshape(-1, every)
    each = points[around].sum(axis=1) / np.maximum(shown[around].sum(axis=1), 1)
    return s.count[which] * seen.each_mm2 / np.maximum(each, 1.0)


def classify(
    label: Label,
    depth_mm: float,
    area_mm2: float,
    box_mm: Float[np.ndarray, "2 3"],
    template: Template,
) -> DefectType:
    """The type of a defect by its geometry: shallow and wide, at the part's rim, or within."""
    if label is Label.EXCESS:
        return DefectType.BLOB
    if depth_mm < 0.05 * np.sqrt(area_mm2):
        return DefectType.UNDER_EXTRUSION
    # a chip reaches the part's outline seen from above, a void lies within it
    middle_z = float(box_mm[:, 2].mean())
    around = np.array([[box_mm[i, 0], box_mm[j, 1], middle_z] for i in (0, 1) for j in (0, 1)])
    at_rim = bool((template.distance(around) > -0.5).any())
    return DefectType.CHIP if at_rim else DefectType.VOID
