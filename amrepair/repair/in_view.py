"""What of a scan is held against what: without the infill's floor, skirts, and what lies below."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float

from amrepair.align import AlignOptions, SoFar
from amrepair.arrays import Mask, Points, Values
from amrepair.frames import Transform, unit_vectors
from amrepair.regions.sites import OffByJob
from amrepair.repair.options import RepairOptions
from amrepair.repair.site import Site
from amrepair.scans import Scan
from amrepair.template.laid import LaidBeads
from amrepair.template.port import Template, is_off_bed
from gcode.surfaces import HeightField


def so_far(site: Site) -> SoFar | None:
    """What the job's own beads have made of the part, to lay a scan on; None of a finished part."""
    if site.planned is None:
        return None
    return SoFar(site.planned, _trusted_from(site.planned, site) if is_cut(site) else -np.inf)


def _trusted_from(planned: Template, site: Site) -> float:
    return float(planned.bounds_mm[0, 2]) + site.options.planned_edge_mm


def is_cut(site: Site) -> bool:
    """Whether what is expected ends in mid-air, and not at the bed."""
    return site.planned is not None and is_off_bed(site.planned)


def without_finished(scan: Scan, site: Site, template_from_scan: Transform) -> Scan:
    """Without the objects of the job that have come to their end: they were judged then.

    Parameters
    ----------
    scan
        In any frame.
    template_from_scan
        Where it lies, to some millimetres: they are as far apart as the head is wide.
    """
    if site.finished is None or site.build_from_template is None:
        return scan
    placed = site.build_from_template @ template_from_scan
    return scan.subset(~site.finished.own(placed.apply(scan.points_mm)[:, :2]))


def of_the_part(scan: Scan, site: Site) -> Scan:
    """Without what the job laid beside the part."""
    aside = laid_aside(site)
    if aside is None:
        return scan
    beside = aside(scan.points_mm)
    return scan.subset(~beside) if beside.any() else scan


def laid_aside(site: Site) -> Callable[[Points], Mask] | None:
    """Which points, template frame, lie on what the job laid beside the part; None where nothing.

    Below its top seen from above, off the bed, and off the part.
    """
    beside, placed, options = site.beside, site.build_from_template, site.options
    if beside is None or placed is None:
        return None

    def aside(points_mm: Points) -> Mask:
        height_mm = points_mm @ placed.rotation[2] + placed.translation_mm[2]
        # what lies nearly on the bed is taken for it anyhow
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

    return aside


def off_by_job(site: Site, placed: Transform) -> OffByJob | None:
    """How far off the job's own path goes, as `detect` asks it; with no more than it needs."""
    if site.laid is None:
        return None
    return partial(_off_by_job, site, site.laid, placed)


def _off_by_job(
    site: Site,
    laid: LaidBeads,
    placed: Transform,
    place_mm: Float[np.ndarray, "s 3"],
    deviation_mm: Float[np.ndarray, " s"],
) -> Float[np.ndarray, " s"]:
    """(s,) how far off what is expected, out or in, the job's own path may put each place."""
    off_mm, least_mm = np.zeros(len(place_mm)), 0.5 * site.allowance_mm
    low, high = deviation_mm < -least_mm, deviation_mm > least_mm
    if not (low | high).any():
        return off_mm
    normal = placed.rotate(unit_vectors(site.expected.distance_and_gradient(place_mm)[1]))
    in_build = placed.apply(place_mm)
    if low.any():
        off_mm[low] = laid.sunk_mm(in_build, normal, deviation_mm, low)[low]
        off_mm[low] = np.maximum(off_mm[low], _strays(site, place_mm[low], in_build[low]))
    if high.any():
        off_mm[high] = _laid_beyond(site, laid, in_build[high], normal[high], deviation_mm[high])
    return off_mm


def _strays(site: Site, place_mm: Points, in_build: Points) -> Values:
    """(s,) how far in strands of supports may lie of where they were planned; none of the part."""
    off_mm, near = np.zeros(len(place_mm)), np.flatnonzero(_by_supports(site, in_build))
    if len(near):
        off = site.template.distance(place_mm[near]) >= site.options.off_the_part_mm
        off_mm[near[off]] = site.options.stray_mm
    return off_mm


def _by_supports(site: Site, in_build: Points) -> Mask:
    """(s,) which places lie no higher than supports that are planned, too, and strands of them."""
    if site.strands is None:
        return np.zeros(len(in_build), bool)
    top_mm = site.strands.sample(in_build[:, :2], outside_mm=-np.inf)
    return np.asarray(in_build[:, 2] < top_mm + site.options.over_beside_mm)


def _laid_beyond(
    site: Site,
    laid: LaidBeads,
    in_build: Float[np.ndarray, "s 3"],
    normal: Float[np.ndarray, "s 3"],
    deviation_mm: Float[np.ndarray, " s"],
) -> Float[np.ndarray, " s"]:
    """(s,) how far out of what is expected the job's own path may put each place.

    What is seen on or beside supports, within how far strands stray, is no evidence of the part.
    """
    offset_mm, tolerance_mm = laid.expected_offset_mm(in_build, normal, deviation_mm)
    least_mm, over_mm = np.zeros(len(in_build)), site.options.over_beside_mm
    least_mm[_by_supports(site, in_build)] = site.options.stray_mm
    if site.beside is not None:
        beside = in_build[:, 2] < _highest_around(site.beside, in_build, site.options) + over_mm
        least_mm[beside] = np.maximum(least_mm[beside], deviation_mm[beside])
    return np.asarray(np.maximum(offset_mm + tolerance_mm, least_mm))


def _highest_around(beside: HeightField, in_build: Points, options: RepairOptions) -> Values:
    """(s,) how high what lies beside the part stands, within how far its strands stray."""
    around = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 2), axis=-1).reshape(-1, 2)
    around /= np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1.0)
    found = [
        beside.sample(in_build[:, :2] + options.stray_mm * way, outside_mm=-np.inf)
        for way in around
    ]
    return np.asarray(np.max(found, axis=0))


def of_layer(scan: Scan, site: Site) -> Scan:
    """What a planned template can judge: its own last millimetres; all of it otherwise."""
    if not is_cut(site):
        return scan
    assert site.planned is not None
    return scan.subset(scan.points_mm[:, 2] > _trusted_from(site.planned, site))


def aligning(site: Site) -> AlignOptions:
    """How a scan is aligned: of a low print, points from half its height on are the part's.

    After the first layer of 0.2 mm nothing of it is higher over the bed than a finished part's
    points have to be. Where the part stands on a raft, the bed lies deeper, and farther out.
    """
    top_mm, options = top_of_layer(site), site.options.align
    if site.raft is not None:
        bed, raft = options.bed, site.raft
        bed = replace(bed, under_foot_mm=raft.height_mm, skirt_mm=max(bed.skirt_mm, raft.reach_mm))
        options = replace(options, bed=bed)
    if top_mm is None:
        return options
    half_mm = 0.5 * (top_mm - float(site.template.bounds_mm[0, 2]))
    guess = replace(options.guess, above_bed_mm=min(options.guess.above_bed_mm, half_mm))
    return replace(options, guess=guess)


def top_of_layer(site: Site) -> float | None:
    """Height of the layer just printed, template frame; None where none is, or it is tilted."""
    placed = site.build_from_template
    if (
        placed is None
        or site.printed_z_mm is None
        or abs(placed.matrix[2, 2] - 1.0) > site.options.upright
    ):
        return None
    return site.printed_z_mm - float(placed.translation_mm[2])
