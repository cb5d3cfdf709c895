"""Observation: what a placed scan shows of its template, before anything is tested.

A scan says three things of the template. Its points give deviations; its rays, where sensors are
known, give surface that is gone; and without rays, the ends of broken thin walls do.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from amrepair.align.sizes import refuse_wrong_scale
from amrepair.arrays import Mask, Points, Values
from amrepair.errors import InputError
from amrepair.field.fused import Surfels, make_surfels
from amrepair.field.near import has_near, nearest_within
from amrepair.frames import unit_vectors
from amrepair.observe.background import background
from amrepair.observe.order import views_of
from amrepair.observe.rays import Passed, RangeImage, passed, range_images
from amrepair.observe.views import Shares
from amrepair.regions.options import RegionOptions
from amrepair.regions.other_pieces import other_pieces
from amrepair.regions.wall_ends import NO_ENDS, ShownSurface, WallEnds, wall_ends
from amrepair.scans import Scan
from amrepair.scans.range_grid import FLYING
from amrepair.template.port import Template

# A template point is present where scanned surface lies within so many cells of it.
PRESENT_CELLS = 1.8


@dataclass(frozen=True, slots=True)
class Observed:
    """What a scan shows of its template, before anything is tested.

    Attributes
    ----------
    scan, template
        Both in the template's frame.
    f_mm, keep
        (n,) signed distance of each point to the template, and whether the point belongs to the
        part (rather than to the bed or other background).
    surfels, outward
        The part's points condensed to cells of a grid, and (s, 3) the template's outward normal at
        each cell.
    images
        Range images of the sensors; empty where the sensors are not known.
    surface_mm, normals, each_mm2
        (m, 3) points spread over the template's surface, and their normals; the area of each.
    nearest
        (m,) for each surface point the cell of the scan that lies on it; −1 where none does.
    crossed
        Surface points without a cell through which rays passed: the surface is gone there.
    ends
        Ends of thin walls that broke off. Only looked for where there are no rays to tell.
    shares
        What each view contributes to each cell; None where views are not told apart.
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
    each_mm2: float
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
    """Measure a placed scan against its template: deviations, rays, broken wall ends.

    Parameters
    ----------
    scan
        In the template's frame.
    images, surface
        Range images of the scan, and points and normals of the template's surface, where the
        caller has them already; None makes them here.
    without
        Numbers of views that are left out.

    Raises
    ------
    InputError
        If the scan is in another frame, of another size, or nowhere near the template.
    """
    if scan.frame != "template":
        raise InputError(
            f"the scan {scan.source} is in frame '{scan.frame}'; align it to the template first"
        )
    refuse_wrong_scale(scan, template)
    with ThreadPoolExecutor(1) as beside:  # range images and distances do not need each other
        asked = None if images is not None else beside.submit(range_images, scan)
        told = beside.submit(views_of, scan, options.order)
        f_mm = template.distance(scan.points_mm)
        surface_mm, normals = surface or template.surface_points(options.spacing_mm)
        keep = ~background(scan, template, f_mm, surface_mm, options.background)
        low_z_mm = float(template.bounds_mm[0, 2])
        keep &= ~other_pieces(scan.points_mm, f_mm, keep, low_z_mm, options.background)
        if scan.edge is not None:  # pixels that hang between two surfaces lie on neither
            keep &= scan.edge & FLYING == 0
        view = told.result()
        if without:
            assert view is not None
            keep &= ~np.isin(view, without)
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
    apart_mm = max(surfels.spacing_mm, options.spacing_mm)
    if apart_mm > options.spacing_mm:
        surface_mm, normals = template.surface_points(apart_mm)
    present_mm = PRESENT_CELLS * surfels.cell_mm
    nearest = nearest_within(surface_mm, surfels.place_mm, present_mm)
    outward = unit_vectors(template.distance_and_gradient(surfels.place_mm)[1])
    crossed = _crossed(seen, surfels, outward, surface_mm, normals)
    planes = options.evidence.faces.plane_points
    on = ShownSurface(surface_mm, normals, nearest >= 0, present_mm)
    # where rays are known they tell what of a wall is gone
    ends = NO_ENDS if seen else wall_ends(scan, template, surfels, on, planes, options.wall_ends)
    shares = None if view is None else surfels.by_view(view)
    return Observed(
        scan, template, f_mm, keep, surfels, outward, seen, surface_mm, normals, apart_mm**2,
        nearest, crossed, ends, shares,
    )  # fmt: skip


def _crossed(
    images: tuple[RangeImage, ...],
    surfels: Surfels,
    outward: Float[np.ndarray, "s 3"],
    surface_mm: Float[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "m 3"],
) -> Passed:
    """Surface points that no cell of the scan lies on and that rays passed through.

    A cell lies on the surface point nearest to it, its foot. A surface point that is gone is no
    cell's foot, even where the wall broke off just below it; there the rays that should have ended
    at the point tell that it is gone.
    """
    feet_mm = surfels.place_mm - surfels.deviation_mm[:, None] * outward
    absent = np.flatnonzero(~has_near(surface_mm, feet_mm, surfels.cell_mm))
    found = passed(images, surface_mm[absent], normals[absent])
    return replace(found, which=absent[found.which])
