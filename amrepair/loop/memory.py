"""What a run keeps of a look once it is over: all that a report shows, a fraction of the points.

A job of hundreds of layers is looked at hundreds of times, half a million points a time: kept
whole, they would fill any memory. The scans themselves are on the disk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from amrepair.deficit import Standing, as_built_heights
from amrepair.loop.looks import Look
from amrepair.repair import AS_BUILT_CELL_MM, RepairPlan, Site
from amrepair.scans import Scan
from gcode.surfaces import HeightField

CLEAN_POINTS, FOUND_POINTS = 8_000, 120_000
"""Points that are kept of a look at which nothing was found, and of another."""


def settled(look: Look, site: Site) -> Look:
    """The look with its points thinned and its working data let go.

    Heights that nobody has asked for yet come from the points that are kept.
    """
    plan, anomaly, deficit = look.plan, look.plan.anomaly, look.plan.deficit
    most = FOUND_POINTS if deficit.regions else CLEAN_POINTS
    every = max(1, -(-len(plan.scan) // most))
    apart = max(1, -(-len(anomaly.template_points_mm) // most))
    thin = _thinned(plan.scan, every)
    if plan.patch is None and anomaly.evidence is not None:
        spacing_mm = anomaly.evidence.spacing_mm * float(np.sqrt(every))
        deficit = replace(deficit, stands=Standing(_heights_later(plan, thin, site, spacing_mm)))
    return replace(
        look,
        scan=_thinned(look.scan, every),
        plan=replace(
            plan,
            scan=thin,
            deficit=deficit,
            anomaly=replace(
                anomaly,
                points_mm=thin.points_mm,
                deviation_mm=anomaly.deviation_mm[::every].copy(),
                score=anomaly.score[::every].copy(),
                label=anomaly.label[::every].copy(),
                template_points_mm=anomaly.template_points_mm[::apart].copy(),
                template_label=anomaly.template_label[::apart].copy(),
                evidence=None,
                surfel_label=None,
            ),
        ),
    )


def _heights_later(
    plan: RepairPlan, scan: Scan, site: Site, spacing_mm: float
) -> Callable[[], HeightField]:
    """How what stood on the bed can be made of a thinned scan."""
    template, printed_z_mm = site.template, site.printed_z_mm
    placed = plan.build_from_scan @ plan.registration.template_from_scan.inverse()
    return lambda: as_built_heights(
        scan,
        template,
        spacing_mm,
        build_from_template=placed,
        printed_z_mm=printed_z_mm,
        cell_mm=AS_BUILT_CELL_MM,
    )


def _thinned(scan: Scan, every: int) -> Scan:
    """Every so-many-th point of a scan; its own memory."""
    if every == 1:
        return scan
    return replace(
        scan,
        points_mm=scan.points_mm[::every].copy(),
        normals=None if scan.normals is None else scan.normals[::every].copy(),
        sensor_index=None if scan.sensor_index is None else scan.sensor_index[::every].copy(),
    )
