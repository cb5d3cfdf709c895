"""What a sensor's place tells beside its points: where it saw through, nothing can be.

A look is a range image of one view. Space between a sensor and what it saw is free, and so is all
that lies beside its silhouette. Where nobody says where the sensor stood, every place that sees all
points of the view at once may have been it, and only what is free for all of these is free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from amrepair.consensus import looks_kernels as kernels
from amrepair.consensus.cloud import directions, outward, planes, spacing_of
from amrepair.frames import moved, ways_across

PIXEL_SPACINGS = 1.6  # every pixel of a face seen at an angle of up to 60° has a point
CLOSING = 2  # pixels: gaps that chance leaves are closed
# A surface that is seen this nearly edge-on returns nothing, though it stands there (cosine); where
# the sensor's place is a guess, this much more.
EDGE_ON, EDGE_ON_GUESSED = 0.25, 0.35
# Where the sensor may have stood, from the points alone.
PLACES = 400
BEHIND_PIXELS, STEEPEST = 3.5, 0.25
GRAZING, GRAZING_COUNTS = 0.12, 0.5
# Hidden shares up to this, or so much above the least, are noise and chance: of 48 views of eight
# parts the sensor's true direction was within 9° of one that passed, always.
HIDDEN_RATIO, ABOVE_LEAST = 0.02, 0.01
# No view's least share was above this (0.031 at most); whole scans of ten parts had 0.088 and more.
VIEW_RATIO = 0.05
MOST_GUESSES = 10
FEW_GUESSES, RING_RAD = 8, 0.16  # fewer are widened to what lies beside them
DISTANCES = (2.0, 8.0)  # of the view's diagonal: nearer and farther than scanners stand


@dataclass(frozen=True, slots=True)
class Veil:
    """Surface as far as it is known, (n, 3) each, and (4, 4) its frame from the looks'.

    A ray that came back from nowhere has met nothing, or has met a face edge-on: what lies behind
    such a face was not seen through.
    """

    points_mm: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    pose: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, slots=True)
class Look:
    """A range image.

    Attributes
    ----------
    sensor_mm
        (3,) where it stood.
    axes
        (3, 3) rows: across, down, along.
    near_mm
        (u, v) least distance in each pixel, infinite where there is no point.
    outside_px
        (u + 2, v + 2) pixels to the silhouette, 0 in it.
    """

    sensor_mm: Float[np.ndarray, " 3"]
    axes: Float[np.ndarray, "3 3"]
    distance_mm: float
    pixel_mm: float
    first: Int[np.ndarray, " 2"]
    near_mm: Float[np.ndarray, "u v"]
    outside_px: Float[np.ndarray, "u2 v2"]
    edge_on: float
    _blurred: dict[int, np.ndarray]

    @classmethod
    def of(
        cls,
        points_mm: Float[np.ndarray, "n 3"],
        sensor_mm: Float[np.ndarray, " 3"],
        pixel_mm: float,
        edge_on: float = EDGE_ON,
    ) -> Look:
        """The image of what a sensor saw; a pixel is that wide at the points' middle."""
        axes, distance_mm = axes_towards(points_mm.mean(axis=0) - sensor_mm)
        local = (points_mm - sensor_mm) @ axes.T
        pixel = np.floor(local[:, :2] / local[:, 2:] * (distance_mm / pixel_mm)).astype(np.int64)
        first = pixel.min(axis=0) - 3
        pixel -= first
        near_mm = np.full(tuple(pixel.max(axis=0) + 4), np.inf)
        np.minimum.at(near_mm, tuple(pixel.T), np.linalg.norm(local, axis=1))
        seen = np.isfinite(near_mm)
        square = np.ones((3, 3), dtype=bool)
        seen |= ndimage.binary_closing(np.pad(seen, CLOSING), square, iterations=CLOSING)[
            CLOSING:-CLOSING, CLOSING:-CLOSING
        ]
        outside_px = np.asarray(ndimage.distance_transform_edt(~np.pad(seen, 1)))
        return cls(sensor_mm, axes, distance_mm, pixel_mm, first, near_mm, outside_px, edge_on, {})

    def mark(
        self,
        found: Bool[np.ndarray, " k"],
        asked: Int[np.ndarray, " a"],
        points_mm: Float[np.ndarray, "k 3"],
        within_mm: float,
        normals: Float[np.ndarray, "m 3"],
    ) -> None:
        """Say of the places asked about whether the sensor saw through them by a tolerance."""
        kernels.seen_through(
            points_mm, normals, asked, self.sensor_mm, self.axes, self.distance_mm, self.pixel_mm,
            self.first, self._least(within_mm), self.outside_px, within_mm, self.edge_on, found,
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
            kernels.behind_edge_on(
                moved(points_mm[asked], veil.pose), asked, veil.points_mm, veil.normals,
                moved(self.sensor_mm[None], veil.pose)[0], self.axes @ veil.pose[:3, :3].T,
                self.distance_mm / self.pixel_mm, self.first - size,
                self.first + 2 * size, self.edge_on, within_mm, hidden,
            )  # fmt: skip
        return hidden

    def hides(self, points_mm: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, " k"]:
        """(k,) whether something the sensor saw stands before each place."""
        local = (points_mm - self.sensor_mm) @ self.axes.T
        pixel = np.floor(local[:, :2] / local[:, 2:] * (self.distance_mm / self.pixel_mm))
        inside = np.clip(pixel.astype(np.int64) - self.first, 0, np.array(self.near_mm.shape) - 1)
        # chance leaves pixels of a face without a point: their neighbours answer for them
        whole = np.where(np.isfinite(self.near_mm), self.near_mm, self._least(self.pixel_mm))
        least = whole[tuple(inside.T)]
        return np.asarray(np.linalg.norm(local, axis=1) > least + BEHIND_PIXELS * self.pixel_mm)

    def _least(self, within_mm: float) -> Float[np.ndarray, "u v"]:
        """Least distance in a pixel and around it."""
        pixels = max(1, round(within_mm / self.pixel_mm))
        if pixels not in self._blurred:
            self._blurred[pixels] = ndimage.minimum_filter(self.near_mm, size=2 * pixels + 1)
        return self._blurred[pixels]


@dataclass(frozen=True, slots=True)
class Looks:
    """Of one scan.

    Attributes
    ----------
    each
        One for each sensor, or for each place where the one sensor may have stood.
    guessed
        They are such places: free is what is free for all of them.
    """

    each: tuple[Look, ...]
    guessed: bool

    def free(
        self,
        points_mm: Float[np.ndarray, "k 3"],
        within_mm: float,
        normals: Float[np.ndarray, "k 3"] | None = None,
        veil: Veil | None = None,
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
        """
        points = np.ascontiguousarray(points_mm)
        given = np.empty((0, 3)) if normals is None else np.ascontiguousarray(normals)
        found = np.full(len(points), self.guessed)
        for look in self.each:
            asked = np.flatnonzero(found == self.guessed)
            look.mark(found, asked, points, within_mm, given)
            if veil is not None and not self.guessed:
                found[asked] &= ~look.veiled(points, asked[found[asked]], within_mm, veil)[asked]
        if veil is not None and self.guessed:  # of few places, once all looks have judged
            for look in self.each:
                found &= ~look.veiled(points, np.flatnonzero(found), within_mm, veil)
        return found

    @property
    def sensors_mm(self) -> Float[np.ndarray, "k 3"]:
        """(k, 3) where they stood, or may have."""
        return np.array([look.sensor_mm for look in self.each])


def told(
    points_mm: Float[np.ndarray, "n 3"],
    sensors_mm: Float[np.ndarray, "k 3"],
    sensor_index: Int[np.ndarray, " n"],
) -> Looks:
    """Looks of sensors whose places are known."""
    each = []
    for k, sensor_mm in enumerate(sensors_mm):
        own = points_mm[sensor_index == k]
        if len(own) > 100:
            each.append(Look.of(own, sensor_mm, PIXEL_SPACINGS * spacing_of(own)))
    return Looks(tuple(each), False)


@dataclass(frozen=True, slots=True)
class Guess:
    """Directions in which the one sensor of a scan may have stood.

    Attributes
    ----------
    towards
        (k, 3) unit vectors; none where no place sees all points.
    sureness
        By how much more of the surface is open to that side than to the other, 0 to 1.
    width
        Share of all directions that pass, from either side.
    """

    towards: Float[np.ndarray, "k 3"]
    sureness: float
    width: float


def guess_directions(points_mm: Float[np.ndarray, "n 3"]) -> Guess:
    """Where one sensor stood that saw all of these points, from nothing but the points."""
    spacing_mm = spacing_of(points_mm)
    normals = planes(points_mm, spacing_mm).normals
    ways = directions(PLACES)
    hidden = np.array([_hidden(points_mm, normals, way, spacing_mm) for way in ways])
    if hidden.min() > VIEW_RATIO:
        return Guess(np.empty((0, 3)), 0.0, 0.0)
    passed = ways[hidden <= max(HIDDEN_RATIO, hidden.min() + ABOVE_LEAST)]
    # a view of one side passes from the other side as well: the part's shape tells which it is
    best = ways[int(np.argmin(hidden))]
    side = float(np.sign(outward(points_mm, normals, spacing_mm) @ best).mean())
    mean = best if side >= 0.0 else -best
    turned = passed * np.where(passed @ mean < 0.0, -1.0, 1.0)[:, None]
    if len(turned) < FEW_GUESSES:
        turned = ways[(ways @ turned.T).max(axis=1) > np.cos(RING_RAD)]
    return Guess(_spread(turned, MOST_GUESSES), abs(side), len(passed) / PLACES)


def guessed(points_mm: Float[np.ndarray, "n 3"], towards: Float[np.ndarray, "k 3"]) -> Looks:
    """Looks from every place where the sensor may have stood."""
    centre = points_mm.mean(axis=0)
    diagonal_mm = float(np.linalg.norm(np.ptp(points_mm, axis=0)))
    pixel_mm = PIXEL_SPACINGS * spacing_of(points_mm)
    return Looks(
        tuple(
            Look.of(points_mm, centre + ratio * diagonal_mm * way, pixel_mm, EDGE_ON_GUESSED)
            for way in towards
            for ratio in DISTANCES
        ),
        True,
    )


def _hidden(
    points_mm: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    way: Float[np.ndarray, " 3"],
    spacing_mm: float,
) -> float:
    """Share of the points that another hides along a direction, from either end, or edge-on."""
    axes, _ = axes_towards(way)
    pixel_mm = PIXEL_SPACINGS * spacing_mm
    local = (points_mm - points_mm.mean(axis=0)) @ axes.T
    pixel = np.floor(local[:, :2] / pixel_mm).astype(np.int64)
    pixel -= pixel.min(axis=0)
    key = pixel[:, 0] * (pixel[:, 1].max() + 1) + pixel[:, 1]
    least = np.full(key.max() + 1, np.inf)
    np.minimum.at(least, key, local[:, 2])
    steep = np.abs(normals @ way)
    behind = local[:, 2] - least[key] > BEHIND_PIXELS * pixel_mm / np.maximum(steep, STEEPEST)
    return float(behind.mean() + GRAZING_COUNTS * (steep < GRAZING).mean())


def _spread(towards: Float[np.ndarray, "n 3"], most: int) -> Float[np.ndarray, "k 3"]:
    """As many as may be, each as far from the others as can be; the outermost are among them."""
    if len(towards) <= most:
        return towards
    chosen = [int(np.argmin(towards @ towards.mean(axis=0)))]
    while len(chosen) < most:
        chosen.append(int(np.argmin((towards @ towards[chosen].T).max(axis=1))))
    return towards[chosen]


def axes_towards(way: Float[np.ndarray, " 3"]) -> tuple[Float[np.ndarray, "3 3"], float]:
    """Rows: two directions across, and the way itself; and how long it is."""
    length = float(np.linalg.norm(way))
    along = way / length
    return np.stack([*ways_across(along), along]), length
