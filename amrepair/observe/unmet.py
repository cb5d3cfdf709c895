"""Rays that met nothing: what a sensor looked at without a point to show for it.

A scan holds no such rays, since they leave no point: not where they left the part through what is
gone of it, if the bed is not in the scan; nor where what they met was too dark or too slanting.
What stands tells the two apart: a ray that would have met it is one that got lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from amrepair.arrays import Mask, Numbers, Points
from amrepair.observe.rays import RangeImage

PixelMask = Bool[np.ndarray, "r c"]


@dataclass(frozen=True, slots=True)
class UnmetRays:
    """Pixels of range images whose rays met nothing; a row and a column more on each side.

    Attributes
    ----------
    images
        The range images.
    left, lost
        Of each image the pixels whose rays left without meeting anything that stands, and those
        that should have met it.
    """

    images: tuple[RangeImage, ...]
    left: tuple[PixelMask, ...]
    lost: tuple[PixelMask, ...]

    @classmethod
    def of(cls, images: tuple[RangeImage, ...], stands_mm: Points, size_mm: float) -> UnmetRays:
        """Of images, and the middles of cubes that stand.

        Of an image in which more rays got lost than met what stands, as of a few touches, no ray is
        known to have left.
        """
        left, lost = [], []
        for image in images:
            met = np.pad(np.isfinite(image.depth_mm), 1)
            stands = _covered(image, stands_mm, size_mm)
            lost.append(~met & stands)
            sees = lost[-1].sum() <= (met & stands).sum()
            left.append(~met & ~stands & sees)
        return cls(images, tuple(left), tuple(lost))

    def left_through(self, points_mm: Points) -> Mask:
        """(n,) points through which more rays left than got lost in line with them."""
        votes = np.zeros(len(points_mm), np.int64)
        for image, left, lost in zip(self.images, self.left, self.lost, strict=True):
            rows, columns, ahead = _pixels(image, points_mm)
            votes += ahead * (left[rows, columns].astype(np.int64) - lost[rows, columns])
        return votes > 0


def _pixels(image: RangeImage, points_mm: Points) -> tuple[Numbers, Numbers, Mask]:
    """(n,) where points lie in an image, with one pixel more on each side, and which it faces."""
    away = (points_mm - image.sensor_mm) @ image.axes.T
    ahead = away[:, 2] > 0.0
    across = away[:, 1::-1] / np.where(ahead, away[:, 2], 1.0)[:, None]
    at = np.rint((across - image.low[::-1]) / image.pixel).astype(np.int64) + 1
    rows, columns = np.clip(at, 0, np.array(image.depth_mm.shape) + 1).T
    return rows, columns, np.asarray(ahead)


def _covered(image: RangeImage, middle_mm: Points, size_mm: float) -> PixelMask:
    """Pixels of an image, with one more on each side, that cubes cover."""
    covered = np.zeros(np.array(image.depth_mm.shape) + 2, bool)
    rows, columns, ahead = _pixels(image, middle_mm)
    covered[rows[ahead], columns[ahead]] = True
    wide = 2 * int(np.ceil(0.5 * size_mm / image.step_mm)) + 1
    return np.asarray(ndimage.binary_dilation(covered, np.ones((wide, wide), bool)))
