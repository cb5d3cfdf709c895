"""Inspected places: where the test looks, with deviation, tolerance and weight of each place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Mask, Points, Values
from amrepair.field.near import nearest_within
from amrepair.field.scales import WINDOW_FACING
from amrepair.frames import diagonal
from amrepair.observe.background import ON_PLANE_MM
from amrepair.observe.incidence import incidence
from amrepair.observe.views import Shares
from amrepair.regions.observation import PRESENT_CELLS, Observed
from amrepair.regions.options import RegionOptions
from amrepair.template.learned import TOLERATED_SPREADS
from amrepair.template.port import Template

# Of places in the template's frame and their deviations: a length for each.
OffByJob = Callable[[Float[np.ndarray, "s 3"], Float[np.ndarray, " s"]], Float[np.ndarray, " s"]]
# Depths below a place are halved so often, and the place is the surface's nearest as long as the
# distance is so much of the depth: a grid's field is rounded where two surfaces are as near.
THICKNESS_HALVINGS = 8
STILL_NEAREST = 0.9


@dataclass(frozen=True, slots=True)
class Inspected:
    """All places that the test looks at, in one order, with what was measured at each.

    Three kinds of places are tested together: occupied cells of the scan, points of the template's
    surface that rays passed through, and ends of broken thin walls. The arrays hold them in this
    order; b is their number.

    Attributes
    ----------
    cells, cell_mm
        How many of the places are cells, and the edge of a cell.
    place_mm, normal
        (b, 3) each: places on the template's surface, and its outward normals. A cell is drawn to
        the surface by up to half its edge.
    value_mm
        (b,) signed deviation, negative where material is missing.
    weight
        (b,) how many points measured it.
    tolerance_mm
        (2, b) δ, by how much a sound part may deviate there: for missing and for excess.
    facing
        (b,) cosine of the angle of incidence.
    pose_mm
        (b,) standard error that neighbouring places share: from the pose, the size and the bow of
        the part, from views that disagree (where the pose was fitted), and from where in a pixel
        its ray passed.
    ends
        How many of the places, the last ones, are ends of walls.
    shares
        What each view says of each cell; None where views are not told apart.
    """

    cells: int
    cell_mm: float
    place_mm: Points
    normal: Points
    value_mm: Values
    weight: Values
    tolerance_mm: Float[np.ndarray, "2 b"]
    facing: Values
    pose_mm: Values
    ends: int = 0
    shares: Shares | None = None

    @property
    def apart(self) -> Mask:
        """(b,) which places are ends of walls: they share no averaging window with the others."""
        return np.arange(len(self.value_mm)) >= len(self.value_mm) - self.ends


def inspected_of(
    seen: Observed, options: RegionOptions, top_z_mm: float | None, off_by_job: OffByJob | None
) -> Inspected:
    """The places to test, with what each deviates by and what a sound part may deviate there.

    Parameters
    ----------
    top_z_mm
        Height of the layer just printed, where the template ends there: directly under that plane
        a smaller tolerance holds for what is missing.
    off_by_job
        How far off the template the job's own path may put the surface at places with such
        deviations; added to the tolerance.
    """
    surfels, template, outward = seen.surfels, seen.template, seen.outward
    # cells that noise alone put one above the other are one place; no more: at a broken rim of a
    # thin wall the sound surface beside would outvote the break
    half_mm = 0.5 * surfels.cell_mm
    aside_mm = np.clip(surfels.deviation_mm, -half_mm, half_mm)
    feet_mm = surfels.place_mm - aside_mm[:, None] * outward
    crossed, ends = seen.crossed, seen.ends
    crossed_mm = seen.surface_mm[crossed.which]
    deep_mm = _at_most_through(template, crossed_mm, seen.normals[crossed.which], crossed.depth_mm)
    value_mm = np.concatenate([surfels.deviation_mm, -deep_mm, -ends.depth_mm])
    # what rays passed has no points of its own: it was seen as most places were, as were ends
    facing = incidence(outward, surfels.toward_sensors(np.arange(len(surfels))), seen.shares)
    usual_count, usual_facing = (float(np.median(told)) for told in (surfels.count, facing))
    others = len(crossed_mm) + len(ends)
    anywhere_mm, top_mm = tolerances(options, template)
    tolerance_mm = np.full((2, len(value_mm)), anywhere_mm)
    if top_z_mm is not None:
        under = surfels.place_mm[:, 2] - top_z_mm
        top = np.abs(surfels.deviation_mm - under) < ON_PLANE_MM
        tolerance_mm[0, : len(surfels)][top] = top_mm
    spread = getattr(template, "spread_mm", None)
    place_mm = np.concatenate([surfels.place_mm, crossed_mm, ends.place_mm])
    if spread is not None:
        tolerance_mm += TOLERATED_SPREADS * spread(place_mm)
    sheets_mm = _sheets_apart_mm(seen, anywhere_mm, options)
    unknown = _behind_what_stands(seen, anywhere_mm, options)
    tolerance_mm[:, : len(surfels)][:, unknown] += diagonal(template.bounds_mm)
    if off_by_job is not None:
        side = np.array([value_mm < 0, value_mm > 0])
        tolerance_mm += np.where(side, off_by_job(place_mm, value_mm), 0.0)
    return Inspected(
        cells=len(surfels),
        cell_mm=surfels.cell_mm,
        place_mm=np.concatenate([feet_mm, crossed_mm, ends.place_mm]),
        normal=np.concatenate([outward, seen.normals[crossed.which], ends.normal]),
        value_mm=value_mm,
        weight=np.concatenate([surfels.count, np.full(len(crossed_mm), usual_count), ends.count]),
        tolerance_mm=tolerance_mm,
        facing=np.append(facing, np.full(others, usual_facing)),
        pose_mm=np.concatenate([sheets_mm, crossed.error_mm, np.zeros(len(ends))]),
        ends=len(ends),
        shares=seen.shares,
    )


def _at_most_through(
    template: Template, surface_mm: Points, normals: Points, depth_mm: Values
) -> Values:
    """(c,) how deep rays passed below surface points, but at most the template's thickness there.

    Where a thin wall is gone, rays run on to whatever stands behind it, and only the wall's own
    thickness is missing. The thickness is twice the depth at which another part of the surface
    becomes nearer than the point itself; the depth is found by bisection.
    """
    least_mm, most_mm = np.zeros(len(depth_mm)), depth_mm.copy()
    for k in range(THICKNESS_HALVINGS):
        middle_mm = most_mm if k == 0 else 0.5 * (least_mm + most_mm)
        inside_mm = -template.distance(surface_mm - middle_mm[:, None] * normals)
        is_nearest = inside_mm > STILL_NEAREST * middle_mm
        least_mm = np.where(is_nearest, middle_mm, least_mm)
        most_mm = np.where(is_nearest, most_mm, middle_mm)
    return np.minimum(depth_mm, 2.0 * least_mm)


def _behind_what_stands(seen: Observed, tolerance_mm: float, options: RegionOptions) -> Mask:
    """(n,) whether a cell seems deep only because the template guesses the surface there.

    A template made from scans is closed by a guess where no scan looked, as over the floor of a
    cup. A later scan that looks into the cup sees its floor; the nearest known surface is then the
    cup's outer wall, and the floor seems to lie deep behind it. But that wall was seen to stand,
    so nothing is missing from its side.
    """
    surfels = seen.surfels
    found = np.zeros(len(surfels), bool)
    coverage = getattr(seen.template, "coverage", None)
    if coverage is None:
        return found
    deep = np.flatnonzero(surfels.deviation_mm < -tolerance_mm)
    depth_mm = -surfels.deviation_mm[deep]
    feet_mm = surfels.place_mm[deep] + depth_mm[:, None] * seen.outward[deep]
    near = nearest_within(feet_mm, surfels.place_mm, PRESENT_CELLS * surfels.cell_mm)
    stands = (near >= 0) & (np.abs(surfels.deviation_mm[near]) <= tolerance_mm)
    to_guess_mm = coverage.to_guess_mm(surfels.place_mm[deep])
    found[deep] = stands & (to_guess_mm < options.guess_depths * depth_mm)
    return found


def _sheets_apart_mm(seen: Observed, tolerance_mm: float, options: RegionOptions) -> Values:
    """(s,) standard error of cells where two sheets of points lie along the template.

    Nobody sees through plastic, and what is thinner than two beads seldom stands for itself: of
    two sheets at one place, one on the template's surface and one along it above or below, no
    farther apart than that, one is off. Which, the points do not tell, so that either is as
    uncertain as their spread about their mean.
    """
    surfels, outward, off_mm = seen.surfels, seen.outward, seen.surfels.deviation_mm
    found = np.zeros(len(surfels))
    on = np.abs(off_mm) <= tolerance_mm
    most_mm = options.sheet_beads * options.evidence.occupancy.bead_mm
    apart = np.abs(off_mm) > max(tolerance_mm, surfels.cell_mm)
    far = np.flatnonzero(apart & (np.abs(off_mm) < most_mm))
    sound = np.flatnonzero(on)
    feet_mm = surfels.place_mm[far] - off_mm[far, None] * outward[far]
    under = nearest_within(feet_mm, surfels.place_mm[sound], surfels.cell_mm)
    far, under = far[under >= 0], sound[under[under >= 0]]
    # a break's sides stand across the surface that they begin at
    others = replace(surfels, moments=np.where(on[:, None], 0.0, surfels.moments))
    along = np.abs((others.planes(far) * outward[far]).sum(axis=1)) > WINDOW_FACING
    far, under = far[along], under[along]
    share = surfels.count[far] / (surfels.count[far] + surfels.count[under])
    spread_mm = np.abs(off_mm[far] - off_mm[under]) * np.sqrt(share * (1.0 - share))
    for sheet in (far, under):
        np.maximum.at(found, sheet, spread_mm)
    return found


def tolerances(options: RegionOptions, template: Template) -> tuple[float, float]:
    """δ anywhere, and under the plane of the layer just printed, mm."""
    if options.tolerance_mm is not None:
        return options.tolerance_mm, options.tolerance_mm
    sigma_mm = options.registration_sigma_mm
    anywhere_mm = options.allowance_mm + float(np.hypot(2 * sigma_mm, template.bias_mm))
    return anywhere_mm, min(options.allowance_mm, options.top_allowance_mm) + sigma_mm
