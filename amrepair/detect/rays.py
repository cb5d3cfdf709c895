"""Rays: what each sensor saw through, from its own points alone.

A scan point says that the straight line from the sensor to it was empty. A range image per
sensor makes that a question of one look-up: how far in front of the seen surface does x lie?
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.detect import surfel_kernels as kernels
from amrepair.scans import Scan

MAX_PIXELS = 4_000_000
# A ray that grazes the surface says little about depth across it: 80° is the limit used.
MIN_COSINE = 0.17


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

    def clearance(
        self, points_mm: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """How far x lies in front of what was seen: best estimate, and the least around it.

        Measured across the seen surface, mm; −inf where the sensor saw nothing along that line.
        """
        local = (points_mm - self.sensor_mm) @ self.axes.T
        ahead = local[:, 2] > 1e-6
        z = np.where(ahead, local[:, 2], 1.0)
        place = (local[:, :2] / z[:, None] - self.low) / self.pixel
        place[~ahead] = -10.0
        seen, least, cosine = kernels.look_up_depth(
            self.depth_mm,
            self.least_mm,
            self.cosine,
            np.clip(place[:, 1], -10, 1e8),
            np.clip(place[:, 0], -10, 1e8),
            self.blend_mm,
        )
        range_mm = np.linalg.norm(local, axis=1)
        across = np.maximum(cosine, MIN_COSINE)
        return (seen - range_mm) * across, (least - range_mm) * across


def range_images(scan: Scan, *, spacing_mm: float) -> tuple[RangeImage, ...]:
    """One range image per sensor that saw points; none where the sensors are unknown."""
    if scan.sensors_mm is None or scan.sensor_index is None:
        return ()
    images = []
    for k, sensor_mm in enumerate(scan.sensors_mm):
        points = scan.points_mm[scan.sensor_index == k]
        if len(points) >= 16:
            images.append(_image(points, sensor_mm, spacing_mm=spacing_mm, sigma_mm=scan.sigma_mm))
    return tuple(images)


def _image(
    points_mm: Float[np.ndarray, "n 3"],
    sensor_mm: Float[np.ndarray, " 3"],
    *,
    spacing_mm: float,
    sigma_mm: float,
) -> RangeImage:
    """Bin one sensor's points by direction."""
    axes = _facing(points_mm.mean(axis=0) - sensor_mm)
    local = (points_mm - sensor_mm) @ axes.T
    local = local[local[:, 2] > 1e-6]
    tangent = local[:, :2] / local[:, 2:]
    depth = np.linalg.norm(local, axis=1)
    low, high = tangent.min(axis=0), tangent.max(axis=0)
    # the pixel holds one to two points on average: spacing measured in the image itself
    pixel = _image_spacing(tangent) * 1.15
    extent = high - low
    pixel = max(pixel, float(np.sqrt(np.prod(np.maximum(extent, 1e-12)) / MAX_PIXELS)))
    low = low - 1.5 * pixel
    index = np.floor((tangent - low) / pixel + 0.5).astype(np.int64)
    shape = np.array([index[:, 1].max() + 3, index[:, 0].max() + 3])
    image, side = kernels.fill_range_image(
        index[:, 1], index[:, 0], depth, np.zeros(len(depth)), shape
    )
    image, side = kernels.close_pinholes(image, side, 5)
    step_mm = pixel * float(np.median(depth))
    blend_mm = 3.0 * step_mm + 4.0 * sigma_mm
    smooth = kernels.smooth_depth(image, 2.0 * step_mm + 4.0 * sigma_mm)
    return RangeImage(
        sensor_mm=sensor_mm,
        axes=axes,
        low=low,
        pixel=pixel,
        depth_mm=smooth,
        least_mm=kernels.least_of_nine(smooth),
        cosine=_incidence(smooth, low, pixel, blend_mm),
        blend_mm=blend_mm,
        step_mm=step_mm,
    )


def _image_spacing(tangent: Float[np.ndarray, "n 2"]) -> float:
    """Mean spacing of directions from the share of a coarse grid that they fill."""
    extent = np.maximum(np.ptp(tangent, axis=0), 1e-9)
    cell = float(np.sqrt(np.prod(extent) / max(len(tangent) / 16, 1)))
    index = np.floor((tangent - tangent.min(axis=0)) / cell).astype(np.int64)
    filled = len(np.unique(index[:, 0] * (index[:, 1].max() + 1) + index[:, 1]))
    return float(np.sqrt(filled * cell**2 / len(tangent)))


def _facing(forward: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Rows right, up, forward of a view along `forward`."""
    forward = forward / np.linalg.norm(forward)
    helper = np.eye(3)[int(np.argmin(np.abs(forward)))]
    right = np.cross(helper, forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _incidence(
    depth_mm: Float[np.ndarray, "r c"], low: Float[np.ndarray, " 2"], pixel: float, blend_mm: float
) -> Float[np.ndarray, "r c"]:
    """|cos| between ray and surface per pixel, from differences that stay on one surface."""
    rows, columns = depth_mm.shape
    tan_x = low[0] + pixel * np.arange(columns)[None, :]
    tan_y = low[1] + pixel * np.arange(rows)[:, None]
    length = np.sqrt(1 + tan_x**2 + tan_y**2)
    finite = np.isfinite(depth_mm)
    z = np.where(finite, depth_mm, 0.0) / length
    place = np.stack([z * tan_x, z * tan_y, z], axis=-1)
    across = np.zeros_like(place)
    along = np.zeros_like(place)
    across[:, 1:-1] = place[:, 2:] - place[:, :-2]
    along[1:-1] = place[2:] - place[:-2]
    normal = np.cross(across, along)
    norm = np.linalg.norm(normal, axis=-1)
    ray = np.stack([tan_x / length, tan_y / length, 1 / length], axis=-1)
    cosine = np.abs((normal * ray).sum(axis=-1)) / np.maximum(norm, 1e-30)
    smooth_here = (np.abs(across[..., 2]) < 2 * blend_mm) & (np.abs(along[..., 2]) < 2 * blend_mm)
    # where the differences cross an edge the depth itself is the better measure
    return np.where(finite & smooth_here & (norm > 0), cosine, 1.0)
