"""What a sensor's place tells beside its points: where it saw through, nothing can be.

A look is one view's range image. Space between a sensor and what it saw is free, and so is all that
lies beside its silhouette. Where nobody says where the sensor stood, every place that sees all
points of the view at once may have been it, and only what is free for all of these is free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from amrepair.arrays import Matrix, Numbers, Points, Vector
from amrepair.frames import diagonal, moved, spread_directions, ways_across
from amrepair.merge import sight_kernels as kernels
from amrepair.merge.cloud import outward, planes, spacing_of
from amrepair.merge.options import DEFAULT_MERGE, SightOptions
from gcode.compiled import read_only


@dataclass(frozen=True, slots=True)
class Veil:
    """Surface as far as it is known, (n, 3) each, and (4, 4) its frame from the looks'.

    A ray that came back from nowhere has met nothing, or has met a face edge-on: what lies behind
    such a face was not seen through.
    """

    points_mm: Points
    normals: Points
    pose: Matrix


@dataclass(frozen=True, slots=True)
class DepthImage:
    """A range image.

    Attributes
    ----------
    camera
        Its sensor; of a sheet of light that moved along, the middle of its way.
    near_mm
        (u, v) least distance in each pixel, infinite where there is no point.
    outside_px
        (u + 2, v + 2) pixels to the silhouette, 0 in it.
    """

    camera: kernels.Camera
    pixel_mm: float
    first: Int[np.ndarray, " 2"]
    near_mm: Float[np.ndarray, "u v"]
    outside_px: Float[np.ndarray, "u2 v2"]
    edge_on: float
    _blurred: dict[int, np.ndarray]

    @classmethod
    def of(
        cls,
        points_mm: Points,
        sensor_mm: Vector,
        *,
        way: Vector | None = None,
        guessed: bool = False,
        options: SightOptions = DEFAULT_MERGE.sight,
    ) -> DepthImage:
        """The image of what a sensor saw, that stood still or moved along a way (unit vector)."""
        closing, edge_on = options.closing_px, options.edge_on
        if guessed:
            edge_on = options.edge_on_guessed
        pixel_mm = options.pixel_spacings * spacing_of(points_mm)
        ahead = points_mm.mean(axis=0) - sensor_mm
        if way is not None:
            ahead = ahead - (ahead @ way) * way
        axes, distance_mm = axes_towards(ahead)
        if way is not None:
            axes = np.stack([np.cross(way, axes[2]), way, axes[2]])
        sheet = int(way is not None)
        eye_mm = np.array(sensor_mm)
        camera = kernels.Camera(eye_mm, axes, distance_mm / pixel_mm, distance_mm, sheet)
        u, v, reach = kernels.pixels(read_only(points_mm), camera)
        pixel = np.stack([u, v], axis=1)
        first = pixel.min(axis=0) - 3
        pixel -= first
        near_mm = np.full(tuple(pixel.max(axis=0) + 4), np.inf)
        np.minimum.at(near_mm, tuple(pixel.T), reach)
        seen = np.isfinite(near_mm)
        square = np.ones((3, 3), dtype=bool)
        seen |= ndimage.binary_closing(np.pad(seen, closing), square, iterations=closing)[
            closing:-closing, closing:-closing
        ]
        outside_px = np.asarray(ndimage.distance_transform_edt(~np.pad(seen, 1)))
        return cls(camera, pixel_mm, first, near_mm, outside_px, edge_on, {})

    def mark(
        self,
        found: Bool[np.ndarray, " k"],
        asked: Int[np.ndarray, " a"],
        points_mm: Float[np.ndarray, "k 3"],
        within_mm: float,
        normals: Float[np.ndarray, "m 3"],
        silhouette: bool,
    ) -> None:
        """Say of the places asked about whether the sensor saw through them by a tolerance."""
        kernels.seen_through(
            points_mm, normals, asked, self.camera, self.first, self._least(within_mm),
            self.outside_px, within_mm, self.edge_on, silhouette, found,
        )  # fmt: skip

    def veiled(
        self,
        points_mm: Float[np.ndarray, "k 3"],
        asked: Int[np.ndarray, " a"],
        within_mm: float,
        veil: Veil,
    ) -> Bool[np.ndarray, " k"]:
        """(k,) whether surface that is edge-on to this sensor stands before a place asked about."""
        hidden = np.zeros(len(points_mm), dtype=bool)
        size = np.array(self.near_mm.shape)
        if len(asked):
            there = self.camera._replace(
                sensor=moved(self.camera.sensor[None], veil.pose)[0],
                axes=self.camera.axes @ veil.pose[:3, :3].T,
            )
            kernels.behind_edge_on(
                moved(points_mm[asked], veil.pose), asked, veil.points_mm, veil.normals, there,
                self.first - size, self.first + 2 * size, self.edge_on, within_mm, hidden,
            )  # fmt: skip
        return hidden

    def _least(self, within_mm: float) -> Float[np.ndarray, "u v"]:
        """Least distance in a pixel and around it."""
        pixels = max(1, round(within_mm / self.pixel_mm))
        if pixels not in self._blurred:
            self._blurred[pixels] = ndimage.minimum_filter(self.near_mm, size=2 * pixels + 1)
        return self._blurred[pixels]


@dataclass(frozen=True, slots=True)
class DepthImages:
    """Of one scan.

    Attributes
    ----------
    each
        One for each sensor, or for each place where the one sensor may have stood; none of a scan
        that no one sensor made.
    guessed
        They are such places: free is what is free for all of them.
    """

    each: tuple[DepthImage, ...]
    guessed: bool

    def free(
        self,
        points_mm: Float[np.ndarray, "k 3"],
        within_mm: float,
        normals: Float[np.ndarray, "k 3"] | None = None,
        veil: Veil | None = None,
        *,
        silhouette: bool = True,
    ) -> Bool[np.ndarray, " k"]:
        """(k,) whether nothing can be there.

        Parameters
        ----------
        within_mm
            By how much the sensors saw through it, at least.
        normals
            Of surface there: what stands edge-on to the rays may be there unseen.
        veil
            Surface that may stand before it.
        silhouette
            Whether what lies beside all that was seen is free: not where a scan was cropped.
        """
        points = np.ascontiguousarray(points_mm)
        given = np.empty((0, 3)) if normals is None else np.ascontiguousarray(normals)
        found = np.full(len(points), self.guessed and len(self.each) > 0)
        for look in self.each:
            asked = np.flatnonzero(found == self.guessed)
            look.mark(found, asked, points, within_mm, given, silhouette)
            if veil is not None and not self.guessed:
                found[asked] &= ~look.veiled(points, asked[found[asked]], within_mm, veil)[asked]
        if veil is not None and self.guessed:  # of few places, once all looks have judged
            for look in self.each:
                found &= ~look.veiled(points, np.flatnonzero(found), within_mm, veil)
        return found

    @property
    def sensors_mm(self) -> Float[np.ndarray, "k 3"]:
        """(k, 3) where they stood, or may have."""
        return np.array([look.camera.sensor for look in self.each]).reshape(-1, 3)


NOWHERE = DepthImages((), False)


def told(
    points_mm: Points,
    sensors_mm: Float[np.ndarray, "k 3"],
    sensor_index: Numbers,
    options: SightOptions = DEFAULT_MERGE.sight,
) -> DepthImages:
    """Looks of sensors whose places are known; many places on a line are one that moved along."""
    if len(sensors_mm) > 3:
        middle = sensors_mm.mean(axis=0)
        _, size, ways = np.linalg.svd(sensors_mm - middle, full_matrices=False)
        if size[1] <= options.way_ratio * size[0]:
            return DepthImages(
                (DepthImage.of(points_mm, middle, way=ways[0], options=options),), False
            )
    own = [points_mm[sensor_index == k] for k in range(len(sensors_mm))]
    each = [
        DepthImage.of(seen, place, options=options)
        for seen, place in zip(own, sensors_mm, strict=True)
        if len(seen) > options.least_seen
    ]
    return DepthImages(tuple(each), False)


def guess_directions(
    points_mm: Points, options: SightOptions = DEFAULT_MERGE.sight
) -> Float[np.ndarray, "k 3"]:
    """Ways to where one sensor may have stood that saw all of these points; none of a whole scan.

    A view passes from behind as well: the side to which more of its surface is open is taken (of
    48 views of eight parts it was the right one in all).
    """
    spacing_mm = spacing_of(points_mm)
    plane = planes(points_mm, spacing_mm)
    normals = plane.normals
    ways = spread_directions(options.places)
    hidden = np.array([_hidden(points_mm, normals, way, spacing_mm, options) for way in ways])
    if hidden.min() > options.view_ratio:
        return np.empty((0, 3))
    passed = ways[hidden <= max(options.hidden_ratio, hidden.min() + options.above_least)]
    best = ways[int(np.argmin(hidden))]
    side = float(np.sign(outward(points_mm, normals, spacing_mm, plane.sigma_mm) @ best).mean())
    mean = best if side >= 0.0 else -best
    turned = passed * np.where(passed @ mean < 0.0, -1.0, 1.0)[:, None]
    if len(turned) < options.few_guesses:
        turned = ways[(ways @ turned.T).max(axis=1) > np.cos(options.ring_rad)]
    return _spread(turned, options.most_guesses)


def guessed(
    points_mm: Points,
    towards: Float[np.ndarray, "k 3"],
    options: SightOptions = DEFAULT_MERGE.sight,
) -> DepthImages:
    """Looks from every place where the sensor may have stood."""
    centre = points_mm.mean(axis=0)
    diagonal_mm = diagonal(points_mm)
    return DepthImages(
        tuple(
            DepthImage.of(
                points_mm, centre + ratio * diagonal_mm * way, guessed=True, options=options
            )
            for way in towards
            for ratio in options.sensor_distances
        ),
        len(towards) > 0,
    )


def _hidden(
    points_mm: Points, normals: Points, way: Vector, spacing_mm: float, options: SightOptions
) -> float:
    """Share of the points that another hides along a direction, from either end, or edge-on."""
    axes, _ = axes_towards(way)
    pixel_mm = options.pixel_spacings * spacing_mm
    local = (points_mm - points_mm.mean(axis=0)) @ axes.T
    pixel = np.floor(local[:, :2] / pixel_mm).astype(np.int64)
    pixel -= pixel.min(axis=0)
    key = pixel[:, 0] * (pixel[:, 1].max() + 1) + pixel[:, 1]
    least = np.full(key.max() + 1, np.inf)
    np.minimum.at(least, key, local[:, 2])
    steep = np.abs(normals @ way)
    behind_mm = options.behind_pixels * pixel_mm / np.maximum(steep, options.steepest)
    behind = local[:, 2] - least[key] > behind_mm
    return float(behind.mean() + options.grazing_counts * (steep < options.grazing).mean())


def _spread(towards: Points, most: int) -> Float[np.ndarray, "k 3"]:
    """As many as may be, each as far from the others as can be; the outermost are among them."""
    if len(towards) <= most:
        return towards
    chosen = [int(np.argmin(towards @ towards.mean(axis=0)))]
    while len(chosen) < most:
        chosen.append(int(np.argmin((towards @ towards[chosen].T).max(axis=1))))
    return towards[chosen]


def axes_towards(way: Vector) -> tuple[Float[np.ndarray, "3 3"], float]:
    """Rows: two directions across, and the way itself; and how long it is."""
    length = float(np.linalg.norm(way))
    along = way / length
    return np.stack([*ways_across(along), along]), length
