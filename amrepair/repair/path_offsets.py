"""How far off the drawing a job's own path puts the surface, and how far supports may stray.

A slicer rounds heights, lays beads that have no room, and lets strands of supports hang. What lies
off the template for such a reason is neither missing nor too much.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Mask, Points, Values
from amrepair.frames import Transform, unit_vectors
from amrepair.regions.inspected import OffByJob
from amrepair.repair.options import RepairOptions
from amrepair.repair.site import Site
from amrepair.template.laid import LaidBeads
from gcode.surfaces import HeightField


def off_by_job(site: Site, placed: Transform) -> OffByJob | None:
    """The function that `detect` asks how far off the template the job's path may put the surface.

    None where the job's beads are not known.
    """
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
    """(s,) how far out of, or into, the expected surface the job's path may put each place.

    Only places that deviate by more than half the allowance are looked at: the others are within
    tolerance whatever the path does.
    """
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
    """(s,) how far inside their planned place strands of supports may lie; 0 on the part itself."""
    off_mm, near = np.zeros(len(place_mm)), np.flatnonzero(_by_supports(site, in_build))
    if len(near):
        off = site.template.distance(place_mm[near]) >= site.options.off_the_part_mm
        off_mm[near[off]] = site.options.stray_mm
    return off_mm


def _by_supports(site: Site, in_build: Points) -> Mask:
    """(s,) which places lie no higher than the planned supports stand there."""
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
    """(s,) how far out of the expected surface the job's path may put each place.

    A surface seen on supports, or as near to them as their strands stray, is no evidence of too
    much material: there any deviation is allowed.
    """
    offset_mm, tolerance_mm = laid.expected_offset_mm(in_build, normal, deviation_mm)
    least_mm, over_mm = np.zeros(len(in_build)), site.options.over_beside_mm
    least_mm[_by_supports(site, in_build)] = site.options.stray_mm
    if site.beside is not None:
        beside = in_build[:, 2] < _highest_around(site.beside, in_build, site.options) + over_mm
        least_mm[beside] = np.maximum(least_mm[beside], deviation_mm[beside])
    return np.asarray(np.maximum(offset_mm + tolerance_mm, least_mm))


def _highest_around(beside: HeightField, in_build: Points, options: RepairOptions) -> Values:
    """(s,) how high anything beside the part stands, within how far its strands may stray."""
    around = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 2), axis=-1).reshape(-1, 2)
    around /= np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1.0)
    found = [
        beside.sample(in_build[:, :2] + options.stray_mm * way, outside_mm=-np.inf)
        for way in around
    ]
    return np.asarray(np.max(found, axis=0))
