"""Sites: where the test looks, what it sees there, and what of that belongs to the whole part."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from amrepair.align.sizes import refuse_wrong_scale
from amrepair.arrays import Mask, Points, Values
from amrepair.errors import InputError
from amrepair.field.fused import Surfels, make_surfels
from amrepair.field.groups import cell_numbers
from amrepair.field.near import has_near, nearest_within
from amrepair.frames import cells_of, diagonal, unit_vectors
from amrepair.observe.as_made import as_made
from amrepair.observe.background import ON_PLANE_MM, background
from amrepair.observe.incidence import incidence
from amrepair.observe.nuisance import Nuisance, fit_nuisance
from amrepair.observe.rays import Passed, RangeImage, passed, range_images
from amrepair.observe.views import Contradiction, Shares, contradictions
from amrepair.regions.options import RegionOptions
from amrepair.regions.wall_ends import NO_ENDS, ShownSurface, WallEnds, wall_ends
from amrepair.scans import Scan
from amrepair.scans.range_grid import FLYING
from amrepair.template.learned import TOLERATED_SPREADS
from amrepair.template.port import Template

# Of places in the template's frame and their deviations: a length for each.
OffByJob = Callable[[Float[np.ndarray, "s 3"], Float[np.ndarray, " s"]], Float[np.ndarray, " s"]]
# How well a scan's pose is known: as an alignment leaves it; as that of a part that stands on the
# bed that is seen with it; or told, so that nothing of the whole part is taken for it.
PoseKnown = Literal["free", "stands", "told"]
# A template point is present where scanned surface lies within so many cells of it.
PRESENT_CELLS = 1.8
# Depths below a place are halved so often, and the place is the surface's nearest as long as the
# distance is so much of the depth: a grid's field is rounded where two surfaces are as near.
THICKNESS_HALVINGS = 8
STILL_NEAREST = 0.9


@dataclass(frozen=True, slots=True)
class Sites:
    """Where the test looks: cells of the field, template surface that rays saw through, and ends
    of thin walls.

    Attributes
    ----------
    cells, cell_mm
        How many of them are cells, and the edge of one.
    place_mm, normal, value_mm, weight
        (b, 3), (b, 3), (b,), (b,): the cells first, then the template's points, then the ends;
        places of cells are drawn to the template's surface by up to half a cell.
    tolerance_mm
        (2, b) δ for missing and for excess.
    facing
        (b,) cosine of the angle of incidence.
    pose_mm
        (b,) standard error of the value that neighbours share: by what is left open of the pose,
        the size and the bow, by what views say differently, and by where in their pixels rays
        passed.
    ends
        How many of them, the last, are ends.
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

    @property
    def apart(self) -> Mask:
        """(b,) those that are no neighbours of the others: ends of walls."""
        return np.arange(len(self.value_mm)) >= len(self.value_mm) - self.ends


@dataclass(frozen=True, slots=True)
class Observed:
    """What a scan shows of its template.

    Attributes
    ----------
    scan, template
        In the template's frame.
    f_mm, keep
        (n,) deviation of each point, and whether it is one of the part.
    surfels, outward
        The points of the part, condensed, and (s, 3) unit vectors away from the template there.
    images
        What rays saw.
    surface_mm, normals
        (m, 3) each: the template's surface.
    nearest
        (m,) the surfel that lies on each place of it, −1 where none does.
    crossed
        Places with none that rays passed.
    ends
        Where thin walls end inside the template; none where rays tell what is gone.
    shares
        What each view says; None where views are not known.
    """

    scan: Scan
    template: Template
    f_mm: Values
    keep: Mask
    surfels: Surfels
    outward: Float[np.ndarray, "s 3"]
    images: tuple[RangeImage, ...]
    surface_mm: Float[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "m 3"]
    nearest: Int[np.ndarray, " m"]
    crossed: Passed
    ends: WallEnds
    shares: Shares | None


def observed(
    scan: Scan,
    template: Template,
    options: RegionOptions,
    images: tuple[RangeImage, ...] | None,
    surface: tuple[Points, Points] | None,
    without: tuple[int, ...],
) -> Observed:
    """Deviations, rays, and what of the template they speak of; some views may be left out."""
    if scan.frame != "template":
        raise InputError(
            f"the scan {scan.source} is in frame '{scan.frame}'; align it to the template first"
        )
    refuse_wrong_scale(scan, template)
    with ThreadPoolExecutor(1) as beside:  # what rays saw needs no distances, nor they it
        asked = None if images is not None else beside.submit(range_images, scan)
        f_mm = template.distance(scan.points_mm)
        surface_mm, normals = surface or template.surface_points(options.spacing_mm)
        keep = ~background(scan, template, f_mm, surface_mm, options.background)
        if scan.edge is not None:  # pixels that hang between two surfaces lie on neither
            keep &= scan.edge & FLYING == 0
        if without:
            assert scan.view_index is not None
            keep &= ~np.isin(scan.view_index, without)
        if not keep.any():
            raise InputError(
                f"no point of the scan {scan.source} lies within "
                f"{options.background.most_excess_mm:g} mm of the template; check its frame, its "
                "unit and that it shows this part"
            )
        surfels = make_surfels(scan, f_mm, keep, options.surfels)
        seen = images or () if asked is None else asked.result()
        if without and seen:
            assert scan.sensors_mm is not None
            assert scan.sensor_index is not None
            sensors_mm = scan.sensors_mm[np.unique(scan.sensor_index[keep])]
            seen = tuple(i for i in seen if np.isclose(sensors_mm, i.sensor_mm).all(axis=1).any())
    if surfels.spacing_mm > options.spacing_mm:
        surface_mm, normals = template.surface_points(surfels.spacing_mm)
    present_mm = PRESENT_CELLS * surfels.cell_mm
    nearest = nearest_within(surface_mm, surfels.place_mm, present_mm)
    outward = unit_vectors(template.distance_and_gradient(surfels.place_mm)[1])
    crossed = _crossed(seen, surfels, outward, surface_mm, normals)
    planes = options.evidence.faces.plane_points
    on = ShownSurface(surface_mm, normals, nearest >= 0, present_mm)
    # where rays are known they tell what of a wall is gone
    ends = NO_ENDS if seen else wall_ends(scan, template, surfels, on, planes, options.wall_ends)
    shares = None if scan.view_index is None else surfels.by_view(scan.view_index)
    return Observed(
        scan, template, f_mm, keep, surfels, outward, seen, surface_mm, normals, nearest, crossed,
        ends, shares,
    )  # fmt: skip


def _crossed(
    images: tuple[RangeImage, ...],
    surfels: Surfels,
    outward: Float[np.ndarray, "s 3"],
    surface_mm: Float[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "m 3"],
) -> Passed:
    """Places that no cell speaks of and that rays passed.

    A cell speaks of the place nearest to it. Of what is gone none does, not even where a wall broke
    down to just below it: the ray that should have ended there says so.
    """
    feet_mm = surfels.place_mm - surfels.deviation_mm[:, None] * outward
    absent = np.flatnonzero(~has_near(surface_mm, feet_mm, surfels.cell_mm))
    found = passed(images, surface_mm[absent], normals[absent])
    return replace(found, which=absent[found.which])


def sites_of(
    seen: Observed, options: RegionOptions, top_z_mm: float | None, off_by_job: OffByJob | None
) -> Sites:
    """Cells and crossed template points, each with what a sound part may depart there."""
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
    facing = incidence(outward, surfels.toward_sensors(np.arange(len(surfels))))
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
    unknown = _behind_what_stands(seen, anywhere_mm, options)
    tolerance_mm[:, : len(surfels)][:, unknown] += diagonal(template.bounds_mm)
    if off_by_job is not None:
        side = np.array([value_mm < 0, value_mm > 0])
        tolerance_mm += np.where(side, off_by_job(place_mm, value_mm), 0.0)
    return Sites(
        cells=len(surfels),
        cell_mm=surfels.cell_mm,
        place_mm=np.concatenate([feet_mm, crossed_mm, ends.place_mm]),
        normal=np.concatenate([outward, seen.normals[crossed.which], ends.normal]),
        value_mm=value_mm,
        weight=np.concatenate([surfels.count, np.full(len(crossed_mm), usual_count), ends.count]),
        tolerance_mm=tolerance_mm,
        facing=np.append(facing, np.full(others, usual_facing)),
        pose_mm=np.concatenate([np.zeros(len(surfels)), crossed.error_mm, np.zeros(len(ends))]),
        ends=len(ends),
    )


def _at_most_through(
    template: Template, surface_mm: Points, normals: Points, depth_mm: Values
) -> Values:
    """(c,) how deep below places rays passed, no deeper than the template is thick there.

    What rays saw beyond a thin wall that is gone depends on what stands there. The wall is twice as
    thick as the way from the place to where another part of the surface is nearer.
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
    """(n,) whether a cell lies behind surface that stands, where nobody knows how thick it is.

    A template of scans is closed by a guess where no scan looked, as over the floor of a cup. What
    a later scan sees in there has the cup's outer wall for its nearest known surface; but that was
    seen to stand, so that nothing can be missing from that side.
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


def agreed(
    observe: Callable[[tuple[int, ...]], tuple[Observed, Sites]],
    pose: PoseKnown,
    options: RegionOptions,
) -> tuple[Observed, Sites, Nuisance | None, tuple[Contradiction, ...]]:
    """What was observed without views that contradict the others, and without nuisance.

    What belongs to the whole part or to whole views is told and taken out, unless the pose is told:
    from there on the part is held against the template as it was made.
    """
    out: tuple[Contradiction, ...] = ()
    while True:
        seen, sites = observe(tuple(one.view for one in out))
        nuisance, shares = None, seen.shares
        if pose != "told":
            nuisance, sites, shares = _without_nuisance(seen, sites, pose, options)
        if out or shares is None:
            return _as_made(seen, nuisance), sites, nuisance, out
        feet_mm = sites.place_mm[: sites.cells]
        place = cell_numbers(cells_of(feet_mm, 0.0, sites.cell_mm))[shares.place]
        told = replace(shares, place=place)
        out = contradictions(told, point_sigma_mm=seen.surfels.spread_mm)
        if not out:
            return _as_made(seen, nuisance), sites, nuisance, out


def _as_made(seen: Observed, nuisance: Nuisance | None) -> Observed:
    """The same against the template as the part was told to have been made: a solid of what stands
    out from there must not be made against the nominal size.
    """
    template = as_made(seen.template, nuisance)
    if nuisance is None or template is seen.template:
        return seen
    surfels = seen.surfels
    moved_mm = nuisance.removed_mm(surfels.place_mm, seen.outward)
    points_mm = surfels.point_deviation_mm - np.append(moved_mm, 0.0)[surfels.of_point]
    deviation_mm = surfels.deviation_mm - moved_mm
    return replace(
        seen,
        template=template,
        surfels=replace(surfels, deviation_mm=deviation_mm, point_deviation_mm=points_mm),
        surface_mm=(
            seen.surface_mm
            + nuisance.moves_mm(seen.surface_mm)
            + nuisance.common_offset_mm * seen.normals
        ),
    )


def _without_nuisance(
    seen: Observed, sites: Sites, pose: PoseKnown, options: RegionOptions
) -> tuple[Nuisance, Sites, Shares | None]:
    """What belongs to the whole part or to whole views, and what was seen without it."""
    n, views_known = sites.cells, seen.shares is not None
    every = np.arange(n)
    told = seen.shares or Shares(every, 0 * every, sites.value_mm[:n], seen.surfels.count)
    view = told.view if views_known else None
    place_mm, normal = sites.place_mm[told.place], sites.normal[told.place]
    found = fit_nuisance(
        place_mm,
        normal,
        told.value_mm,
        told.count.astype(np.float64),
        view=view,
        tolerance_mm=float(np.median(sites.tolerance_mm)),
        correlation_mm=options.correlation_mm,
        pose_known=pose == "stands",
    )
    share_mm = found.removed_mm(place_mm, normal, view)
    left = replace(told, value_mm=told.value_mm - share_mm)
    points = np.bincount(told.place, told.count, n)
    whole_mm = sites.value_mm.copy()
    whole_mm[:n] -= np.bincount(told.place, told.count * share_mm, n) / points
    pose_mm = np.hypot(sites.pose_mm, found.error_mm(sites.place_mm, sites.normal))
    if views_known:
        pose_mm = np.hypot(pose_mm, _between_views_mm(left, len(pose_mm), seen.surfels.spread_mm))
    sites = replace(sites, value_mm=whole_mm, pose_mm=pose_mm)
    return found, sites, left if views_known else None


def _between_views_mm(shares: Shares, sites: int, point_sigma_mm: float) -> Values:
    """(n,) standard error of each site by what several views say differently of one place.

    The views' own component of the variance, without the points' noise, over the root of how many
    saw it: one, of what rays passed.
    """
    apart_mm = shares.apart_mm
    if apart_mm is None:
        return np.zeros(sites)
    noise_mm = point_sigma_mm * float(np.median(1.0 / np.sqrt(shares.count[shares.views > 1])))
    views = np.maximum(np.bincount(shares.place, minlength=sites), 1)
    return np.asarray(np.sqrt(max(apart_mm**2 - noise_mm**2, 0.0) / views))


def tolerances(options: RegionOptions, template: Template) -> tuple[float, float]:
    """δ anywhere, and under the plane of the layer just printed, mm."""
    if options.tolerance_mm is not None:
        return options.tolerance_mm, options.tolerance_mm
    sigma_mm = options.registration_sigma_mm
    anywhere_mm = options.allowance_mm + float(np.hypot(2 * sigma_mm, template.bias_mm))
    return anywhere_mm, min(options.allowance_mm, options.top_allowance_mm) + sigma_mm
