"""What a run keeps of a look once it is over: all that a report shows, a fraction of the points.

A job of hundreds of layers is looked at hundreds of times, half a million points a time: kept
whole, they would fill any memory. The scans themselves are on the disk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Int

from amrepair.deficit import Standing, as_built_heights
from amrepair.frames import in_box
from amrepair.loop.looks import Look
from amrepair.repair import RepairPlan, Site
from amrepair.scans import Scan
from gcode.surfaces import HeightField

CLEAN_POINTS, FOUND_POINTS = 8_000, 120_000
"""Points that are kept of a look at which nothing was found, and of another."""
MEMORY_MARGIN_MM = 10.0
"""So far beside the part a scan is kept; the bed beyond is most of it, and tells nothing."""


def settled(look: Look, site: Site, *, compared: bool = False) -> Look:
    """The look with its points thinned and its working data let go.

    Heights that nobody has asked for yet come from the points that are kept.

    Parameters
    ----------
    compared
        Somebody will hold it against an earlier look at the same stop, or it is the part's last:
        kept as well as if something had been found.
    """
    plan, anomaly, deficit = look.plan, look.plan.anomaly, look.plan.deficit
    most = FOUND_POINTS if deficit.regions or compared else CLEAN_POINTS
    chosen, every = _around_the_part(plan, most)
    apart = max(1, -(-len(anomaly.template_points_mm) // most))
    thin = plan.scan.subset(chosen)
    if plan.patch is None and anomaly.evidence is not None:
        spacing_mm = anomaly.evidence.spacing_mm * float(np.sqrt(every))
        deficit = replace(deficit, stands=Standing(_heights_later(plan, thin, site, spacing_mm)))
    return replace(
        look,
        scan=look.scan.subset(chosen if len(look.scan) == len(plan.scan) else _some(look, most)),
        scanned_points=len(look.scan),
        plan=replace(
            plan,
            scan=thin,
            deficit=deficit,
            anomaly=replace(
                anomaly,
                points_mm=thin.points_mm,
                deviation_mm=anomaly.deviation_mm[chosen],
                score=anomaly.score[chosen],
                label=anomaly.label[chosen],
                template_points_mm=anomaly.template_points_mm[::apart].copy(),
                template_label=anomaly.template_label[::apart].copy(),
                evidence=None,
                surfel_label=None,
                inspected=None,
            ),
        ),
    )


def _heights_later(
    plan: RepairPlan, scan: Scan, site: Site, spacing_mm: float
) -> Callable[[], HeightField]:
    """How what stood on the bed can be made of a thinned scan."""
    template, printed_z_mm = site.template, site.printed_z_mm
    options = site.options.deficit.heights
    placed = plan.build_from_template
    return lambda: as_built_heights(
        scan,
        template,
        spacing_mm,
        build_from_template=placed,
        printed_z_mm=printed_z_mm,
        options=options,
    )


def _around_the_part(plan: RepairPlan, most: int) -> tuple[Int[np.ndarray, " k"], int]:
    """Indices of at most so many points, evenly out of those around the part; and one of how many.

    All around it are as dense as each other: heights are read from them later.
    """
    expected_mm = plan.anomaly.template_points_mm
    near = np.arange(len(plan.scan))
    if len(expected_mm):
        points_mm = plan.scan.points_mm  # in the template's frame, as planned
        low, high = (
            expected_mm.min(axis=0) - MEMORY_MARGIN_MM,
            expected_mm.max(axis=0) + MEMORY_MARGIN_MM,
        )
        inside = np.flatnonzero(in_box(points_mm, low, high))
        near = inside if len(inside) else near
    every = max(1, -(-len(near) // most))
    return near[::every], every


def _some(look: Look, most: int) -> Int[np.ndarray, " k"]:
    """Indices of at most so many points of a scan of which only a part was planned with."""
    return np.arange(0, len(look.scan), max(1, -(-len(look.scan) // most)))
