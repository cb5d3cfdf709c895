"""Rays: which space each sensor saw to be empty, from its own points alone.

A scan point says that the straight line from the sensor to it was empty. One range image for each
sensor turns this into a look-up: how far in front of the surface seen there does a point lie?
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Numbers, Points, Values
from amrepair.frames import Transform, box_of, unit_vectors, ways_across
from amrepair.observe import range_kernels as kernels
from amrepair.scans import Scan
from gcode.compiled import get_num_threads

MAX_PIXELS = 4_000_000
LEAST_RAY_POINTS = 16
# A ray that grazes the surface says little about depth across it: 80° is the limit used.
MIN_COSINE = 0.17
# A ray may have gone anywhere in its pixel: standard deviation of an even distribution over it.
PIXEL_SIGMA = 1.0 / np.sqrt(12.0)
# How deep rays pass is found to this power of two of a pixel, or of what they have passed.
DEPTH_HALVINGS = 5


@dataclass(frozen=True, slots=True)
class RangeImage:
    """Depths seen from one sensor on a plane that faces the scan's middle.

    Attributes
    ----------
    sensor_mm, axes
        (3,) origin; (3, 3) rows right, up, forward.
    low, pixel
        (2,) tangent of the first pixel; size of a pixel in tangents.
    depth_mm, least_mm
        Distance along the ray to what was seen (inf where nothing was); least of 3×3.
    cosine
        |cos| between ray and surface, per pixel.
    step_mm
        Edge of a pixel at the scan's median distance.
    """

    sensor_mm: Float[np.ndarray, " 3"]
    axes: Float[np.ndarray, "3 3"]
    low: Float[np.ndarray, " 2"]
    pixel: float
    depth_mm: Float[np.ndarray, "r c"]
    least_mm: Float[np.ndarray, "r c"]
    cosine: Float[np.ndarray, "r c"]
    blend_mm: float
    step_mm: float

    def moved(self, target_from_source: Transform) -> RangeImage:
        """The same image of a scan in another frame."""
        return replace(
            self,
            sensor_mm=target_from_source.apply(self.sensor_mm[None])[0],
            axes=target_from_source.rotate(self.axes),
        )

    def passing_error(self, points_mm: Points, normals: Points) -> Values:
        """(n,) standard error of how deep rays pass below surface with such normals, mm.

        A ray is known to its pixel, sideways. Where it grazes the surface all of that is depth,
        where it meets it squarely none: the sine of the angle of incidence.
        """
        ways = points_mm - self.sensor_mm
        along = (unit_vectors(ways) * normals).sum(axis=1)
        sideways_mm = PIXEL_SIGMA * self.pixel * np.linalg.norm(ways, axis=1)
        return np.asarray(sideways_mm * np.sqrt(np.maximum(1.0 - along**2, 0.0)))


def range_images(scan: Scan) -> tuple[RangeImage, ...]:
    """One range image per sensor that saw points; none where the sensors are unknown."""
    if scan.sensors_mm is None or scan.sensor_index is None:
        return ()
    with ThreadPoolExecutor(get_num_threads()) as pool:  # the kernels let go of the interpreter
        found = pool.map(lambda k: _image(scan, k), range(len(scan.sensors_mm)))
        return tuple(image for image in found if image is not None)


def clearances(
    images: tuple[RangeImage, ...], points_mm: Points, unseen_mm: float
) -> tuple[Values, Values]:
    """How far points lie in front of the seen surface, mm: a best and a cautious estimate.

    Of several range images the one counts that shows the most empty space. The cautious estimate
    takes the least depth around a pixel. Distances are measured across the seen surface;
    `unseen_mm` is the answer where no image shows anything.
    """
    best, least = (np.full(len(points_mm), unseen_mm) for _ in range(2))
    for image in images:
        kernels.look_up(
            points_mm, image.sensor_mm, image.axes, image.low, image.pixel, image.depth_mm,
            image.least_mm, image.cosine, image.blend_mm, MIN_COSINE, best, least,
        )  # fmt: skip
    return best, least


def rays_crossing(
    scan: Scan, near_mm: Float[np.ndarray, "a 2"], within_mm: float, height_mm: float, top_mm: float
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "k 2"]]:
    """Points below `top_mm` whose rays cross a height near some places, and where they cross it.

    All that cross it within a distance of any of the places, as seen from above, and a few more.
    There are none where the sensors are not known.
    """
    if scan.sensors_mm is None or scan.sensor_index is None:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    corner = near_mm.min(axis=0) - 2.0 * within_mm
    at = np.floor((near_mm - corner) / within_mm).astype(np.int64)
    marked = np.zeros(at.max(axis=0) + 2, bool)
    for x in range(-1, 2):
        for y in range(-1, 2):
            marked[at[:, 0] + x, at[:, 1] + y] = True
    return kernels.crossings(
        scan.points_mm, scan.sensor_index, scan.sensors_mm, height_mm, top_mm, corner, within_mm,
        marked,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Passed:
    """Surface points through which rays passed, though they should have ended there.

    Attributes
    ----------
    which
        (c,) the numbers of these surface points.
    depth_mm, error_mm
        (c,) how deep below each of them rays still pass, and the standard error of that depth.
    """

    which: Numbers
    depth_mm: Values
    error_mm: Values


def passed(images: tuple[RangeImage, ...], surface_mm: Points, normals: Points) -> Passed:
    """Find the surface points through which rays passed, and how deep below each they still pass.

    A ray that cuts an edge by a hair's breadth may end far beyond it, so where a ray ends says
    little. What counts is the depth below the surface down to which rays pass without a gap; on the
    far side of a sound part rays pass again. The depth is searched from the surface down, first by
    a pixel, then in doubling steps, and at last by bisection.
    """
    beyond_mm = clearances(images, surface_mm, -np.inf)[1]
    which = np.flatnonzero(beyond_mm > 0)
    surface_mm, normals, most_mm = surface_mm[which], normals[which], 2.0 * beyond_mm[which]

    def passes(among: Numbers, deep_mm: Values) -> Any:
        below_mm = surface_mm[among] - deep_mm[:, None] * normals[among]
        return clearances(images, below_mm, -np.inf)[1] > 0

    every = np.arange(len(which))
    passed_mm = np.zeros(len(which))
    stopped_mm = np.full(len(which), min((image.step_mm for image in images), default=0.0))
    going = every
    while len(going):
        going = going[passes(going, stopped_mm[going]) & (stopped_mm[going] < most_mm[going])]
        passed_mm[going] = stopped_mm[going]
        stopped_mm[going] *= 2.0
    for _ in range(DEPTH_HALVINGS):
        middle_mm = 0.5 * (passed_mm + stopped_mm)
        deeper = passes(every, middle_mm)
        passed_mm = np.where(deeper, middle_mm, passed_mm)
        stopped_mm = np.where(deeper, stopped_mm, middle_mm)
    at_mm = surface_mm - passed_mm[:, None] * normals
    error_mm = np.full(len(which), np.inf)
    for image in images:  # of the rays that went so deep the squarest one tells the depth best
        went = clearances((image,), at_mm, -np.inf)[1] > 0
        own_mm = np.where(went, image.passing_error(at_mm, normals), np.inf)
        error_mm = np.minimum(error_mm, own_mm)
    return Passed(which, passed_mm, error_mm)


def _image(scan: Scan, k: int) -> RangeImage | None:
    """Bin one sensor's points by direction; None where it saw next to nothing."""
    assert scan.sensors_mm is not None
    sensor_mm = scan.sensors_mm[k].copy()
    count, mean = kernels.mean_seen_by(scan.points_mm, scan.sensor_index, k)
    if count < LEAST_RAY_POINTS:
        return None
    axes = _facing(mean - sensor_mm)
    rays = kernels.directions(scan.points_mm, scan.sensor_index, k, sensor_mm, axes, count)
    low, high = box_of(rays[:, :2])
    # the pixel holds one to two points on average: spacing measured in the image itself
    pixel = _image_spacing(rays, low, high) * 1.15
    extent = high - low
    pixel = max(pixel, float(np.sqrt(np.prod(np.maximum(extent, 1e-12)) / MAX_PIXELS)))
    low = low - 1.5 * pixel
    columns, rows = (int(n) + 3 for n in np.floor((high - low) / pixel + 0.5))
    image = kernels.close_pinholes(kernels.fill(rays, low, pixel, rows, columns), 5)
    step_mm = pixel * float(np.median(rays[:, 2]))
    blend_mm = 3.0 * step_mm + 4.0 * scan.sigma_mm
    smooth = kernels.smooth(image, 2.0 * step_mm + 4.0 * scan.sigma_mm)
    return RangeImage(
        sensor_mm=sensor_mm,
        axes=axes,
        low=low,
        pixel=pixel,
        depth_mm=smooth,
        least_mm=kernels.least_of_nine(smooth),
        cosine=kernels.incidence(smooth, low, pixel, blend_mm),
        blend_mm=blend_mm,
        step_mm=step_mm,
    )


def _image_spacing(
    rays: Points, low: Float[np.ndarray, " 2"], high: Float[np.ndarray, " 2"]
) -> float:
    """Mean spacing of directions from the share of a coarse grid that they fill."""
    extent = np.maximum(high - low, 1e-9)
    cell = float(np.sqrt(np.prod(extent) / max(len(rays) / 16, 1)))
    filled = np.zeros((extent / cell).astype(np.int64) + 1, bool)
    at = ((rays[:, :2] - low) / cell).astype(np.int64)
    filled[tuple(np.minimum(at, np.array(filled.shape) - 1).T)] = True
    return float(np.sqrt(np.count_nonzero(filled) * cell**2 / len(rays)))


def _facing(forward: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Rows right, up, forward of a view along `forward`."""
    forward = forward / np.linalg.norm(forward)
    left, down = ways_across(forward)
    return np.stack([-left, -down, forward])
