"""Systematic errors: what belongs to the whole part or to whole views is taken out of a scan.

A part that shrank, bowed or was placed slightly off deviates everywhere, and a view that is offset
deviates wherever it looked. Neither is a defect, so both are estimated and subtracted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from amrepair.arrays import Points, Values
from amrepair.field.groups import cell_numbers
from amrepair.field.scales import faced_places
from amrepair.frames import cells_of, unit_vectors
from amrepair.observe.as_made import as_made
from amrepair.observe.nuisance import Nuisance, fit_nuisance
from amrepair.observe.views import Contradiction, Shares, contradictions
from amrepair.regions.inspected import Inspected
from amrepair.regions.observation import Observed
from amrepair.regions.options import RegionOptions

# How well a scan's pose is known: as an alignment leaves it; as that of a part that stands on the
# bed that is seen with it; or told, so that nothing of the whole part is taken for it.
PoseKnown = Literal["free", "stands", "told"]


def without_systematic_errors(
    observe: Callable[[tuple[int, ...]], tuple[Observed, Inspected]],
    pose: PoseKnown,
    options: RegionOptions,
) -> tuple[Observed, Inspected, Nuisance | None, tuple[Contradiction, ...]]:
    """Observe a scan, and take out what belongs to the whole part or to whole views.

    Residual pose, scale, bow and offsets of views are estimated and subtracted, unless the pose is
    told. Views that contradict the others are left out one after another, and the scan is observed
    again without them, until the rest agree.

    Parameters
    ----------
    observe
        Observes the scan without the views of these numbers.

    Returns
    -------
    tuple
        What was observed, against the template as the whole part was made; the places to test;
        what was subtracted (None where the pose is told); and the views that were left out.
    """
    out: tuple[Contradiction, ...] = ()
    while True:
        seen, inspected = observe(tuple(one.view for one in out))
        nuisance = None
        if pose != "told":
            nuisance, inspected = _without_nuisance(seen, inspected, pose, options)
        shares = inspected.shares
        if out or shares is None:
            return _as_made(seen, nuisance), inspected, nuisance, out
        feet_mm = inspected.place_mm[: inspected.cells]
        place = cell_numbers(cells_of(feet_mm, 0.0, inspected.cell_mm))[shares.place]
        told = replace(shares, place=place)
        out = contradictions(told, point_sigma_mm=seen.surfels.spread_mm)
        if not out:
            return _as_made(seen, nuisance), inspected, nuisance, out


def _as_made(seen: Observed, nuisance: Nuisance | None) -> Observed:
    """The same observation against the template as the whole part was made, shrunk and bowed.

    Solids of what is missing or too much are cut against this template, not the nominal one.
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
    seen: Observed, inspected: Inspected, pose: PoseKnown, options: RegionOptions
) -> tuple[Nuisance, Inspected]:
    """Estimate pose, scale, bow and view offsets, and subtract them from all deviations."""
    n, views_known = inspected.cells, seen.shares is not None
    every = np.arange(n)
    told = seen.shares or Shares(every, 0 * every, inspected.value_mm[:n], seen.surfels.count)
    view = told.view if views_known else None
    place_mm, normal = inspected.place_mm[told.place], inspected.normal[told.place]
    whole_place_mm, whole_normal, whole = _halves_joined(inspected, told)
    found = fit_nuisance(
        whole_place_mm,
        whole_normal,
        whole.value_mm,
        whole.count.astype(np.float64),
        view=whole.view if views_known else None,
        tolerance_mm=float(np.median(inspected.tolerance_mm)),
        correlation_mm=options.correlation_mm,
        pose_known=pose == "stands",
    )
    share_mm = found.removed_mm(place_mm, normal, view)
    left = replace(told, value_mm=told.value_mm - share_mm)
    points = np.bincount(told.place, told.count, n)
    whole_mm = inspected.value_mm.copy()
    whole_mm[:n] -= np.bincount(told.place, told.count * share_mm, n) / points
    pose_mm = np.hypot(inspected.pose_mm, found.error_mm(inspected.place_mm, inspected.normal))
    if views_known:
        pose_mm = np.hypot(pose_mm, _between_views_mm(left, len(pose_mm), seen.surfels.spread_mm))
    shares = left if views_known else None
    return found, replace(inspected, value_mm=whole_mm, pose_mm=pose_mm, shares=shares)


def _halves_joined(inspected: Inspected, told: Shares) -> tuple[Points, Points, Shares]:
    """(j, 3) places, (j, 3) normals, and what was told of them, one over the other as one.

    Where noise is as thick as a cell, boundaries between cells cut it in two along the surface.
    Neither half lies about the surface: the median of such halves is that of the larger ones.
    """
    cells = slice(inspected.cells)
    feet_mm, normal = inspected.place_mm[cells], inspected.normal[cells]
    joined = faced_places(feet_mm, normal, inspected.cell_mm)
    whole = replace(told, place=joined[told.place]).gathered()
    points = np.bincount(joined, inspected.weight[cells])

    def mean(each: Points) -> Points:
        sums = [np.bincount(joined, inspected.weight[cells] * one) for one in each.T]
        return np.stack(sums, axis=1)[whole.place] / points[whole.place, None]

    return mean(feet_mm), unit_vectors(mean(normal)), whole


def _between_views_mm(shares: Shares, places: int, point_sigma_mm: float) -> Values:
    """(n,) standard error of each place from the disagreement of the views that saw it.

    The variance between views, less what the noise of their points explains, divided by the number
    of views; a place that only rays passed counts as seen by one.
    """
    apart_mm = shares.apart_mm
    if apart_mm is None:
        return np.zeros(places)
    noise_mm = point_sigma_mm * float(np.median(1.0 / np.sqrt(shares.count[shares.views > 1])))
    views = np.maximum(np.bincount(shares.place, minlength=places), 1)
    return np.asarray(np.sqrt(max(apart_mm**2 - noise_mm**2, 0.0) / views))
