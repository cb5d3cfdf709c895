"""Which points of a scan are compared with the part, and what alignment is told of it.

A scan shows more than the part: finished objects of the same job, skirts, supports, and below the
layer just printed what was judged earlier. The functions here leave that out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from amrepair.align import AlignOptions, SoFar
from amrepair.arrays import Mask, Points
from amrepair.frames import Transform
from amrepair.repair.site import Site
from amrepair.scans import Scan
from amrepair.template.port import Template, is_off_bed


def planned_so_far(site: Site) -> SoFar | None:
    """The part as the job's beads have built it so far, for alignment; None for a finished part."""
    if site.planned is None:
        return None
    trusted_from_mm = _trusted_from_mm(site.planned, site) if ends_in_air(site) else -np.inf
    return SoFar(site.planned, trusted_from_mm)


def _trusted_from_mm(planned: Template, site: Site) -> float:
    """The height, template frame, from which on a planned template's distances hold."""
    return float(planned.bounds_mm[0, 2]) + site.options.planned_edge_mm


def ends_in_air(site: Site) -> bool:
    """Whether the planned template reaches down to the last layers only, and not to the bed."""
    return site.planned is not None and is_off_bed(site.planned)


def without_finished_objects(scan: Scan, site: Site, template_from_scan: Transform) -> Scan:
    """Leave out the objects of a sequential job that are finished: they were judged at their end.

    Parameters
    ----------
    scan
        In any frame.
    template_from_scan
        Its pose. A few millimetres of error do no harm, since the objects of a sequential job
        stand at least as far apart as the head is wide.
    """
    if site.finished is None or site.build_from_template is None:
        return scan
    placed = site.build_from_template @ template_from_scan
    return scan.subset(~site.finished.own(placed.apply(scan.points_mm)[:, :2]))


def without_beside(scan: Scan, site: Site) -> Scan:
    """Leave out skirts, brims, supports and towers that the job laid beside the part."""
    is_beside = beside_part(site)
    if is_beside is None:
        return scan
    beside = is_beside(scan.points_mm)
    return scan.subset(~beside) if beside.any() else scan


def beside_part(site: Site) -> Callable[[Points], Mask] | None:
    """A function that says which points, template frame, lie on what was laid beside the part.

    Those are points above the bed, off the part, and no higher than the job's skirt, brim, support
    or tower stands at that place. None where the job laid nothing beside the part.
    """
    beside, placed, options = site.beside, site.build_from_template, site.options
    if beside is None or placed is None:
        return None

    def is_beside(points_mm: Points) -> Mask:
        height_mm = points_mm @ placed.rotation[2] + placed.translation_mm[2]
        # points this near to the bed are taken for the bed by the alignment itself
        over_mm = options.over_beside_mm
        over_bed = (height_mm > options.on_bed_mm) & (height_mm < beside.top_mm + over_mm)
        low = np.flatnonzero(over_bed)
        xy_mm = placed.apply(points_mm[low])[:, :2]
        high_mm = beside.sample(xy_mm, outside_mm=-np.inf) + over_mm
        low = low[height_mm[low] < high_mm]
        found = np.zeros(len(points_mm), dtype=bool)
        if len(low):
            found[low] = site.template.distance(points_mm[low]) >= options.off_the_part_mm
        return found

    return is_beside


def within_planned(scan: Scan, site: Site) -> Scan:
    """Leave out what lies below the last layers that a planned template covers, if it covers few.

    Those layers were judged when they were printed.
    """
    if not ends_in_air(site):
        return scan
    assert site.planned is not None
    return scan.subset(scan.points_mm[:, 2] > _trusted_from_mm(site.planned, site))


def align_options(site: Site, scan: Scan) -> AlignOptions:
    """The site's alignment options, adapted to a raft and to a print that is still low.

    By default a point must be some way above the bed to count as the part's. After a first layer of
    0.2 mm no point is, so for a low print half the printed height is enough. On a raft the bed lies
    deeper below the part's foot, and what is not the part reaches farther out. A finished part that
    is scanned in the bed's frame stands upright there, unless it lies on a fixture.
    """
    top_mm, options = layer_top_mm(site), site.options.align
    if scan.frame == "build" and site.printed_z_mm is None and not site.on_fixture:
        options = replace(options, stands_upright=True)
    if site.raft is not None:
        bed, raft = options.bed, site.raft
        bed = replace(bed, under_foot_mm=raft.height_mm, skirt_mm=max(bed.skirt_mm, raft.reach_mm))
        options = replace(options, bed=bed)
    if top_mm is None:
        return options
    half_mm = 0.5 * (top_mm - float(site.template.bounds_mm[0, 2]))
    guess = replace(options.guess, above_bed_mm=min(options.guess.above_bed_mm, half_mm))
    return replace(options, guess=guess)


def layer_top_mm(site: Site) -> float | None:
    """Height of the layer just printed, template frame; None for a finished or tilted part."""
    placed = site.build_from_template
    if (
        placed is None
        or site.printed_z_mm is None
        or abs(placed.matrix[2, 2] - 1.0) > site.options.upright
    ):
        return None
    return site.printed_z_mm - float(placed.translation_mm[2])
