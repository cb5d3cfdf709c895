"""Where the sensor of a range image stood, from the grid itself.

A pixel fixes its ray. So where columns and rows run evenly over x and y the rays are parallel to
z, and where they run evenly over x/z and y/z the rays meet in the origin: coordinates that are the
sensor's own, z along its view. Else each pixel coordinate is a ratio of two linear functions of the
place, in whatever frame: the points of a column lie in a plane, those of a row in another, and the
planes of each kind meet in a line, or are parallel (crossed slits). A sheet of light that moved
along (a linear pushbroom: Cyberware's range images) is such a view, and so is a camera's that
somebody turned.

References
----------
R. Gupta, R. I. Hartley: Linear Pushbroom Cameras. IEEE PAMI 19(9), 1997, equation 5.
A. Zomet, D. Feldman, S. Peleg, D. Weinshall: Mosaicing New Views: The Crossed-Slits Projection.
IEEE PAMI 25(6), 2003.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Points, Vector
from amrepair.frames import diagonal
from amrepair.scans import range_grid_kernels as kernels
from amrepair.scans.range_grid import STEEPEST, Kind, RangeGrid, depths_of

# A sensor at infinity stands this far away: its rays over a bed are parallel to a micrometre.
INFINITY_MM = 10_000.0


@dataclass(frozen=True, slots=True)
class ViewpointOptions:
    """When a model of the rays is believed.

    Attributes
    ----------
    within_pixels, share
        That share of the points must lie so near to the pixel that the model gives them. (Forty
        range images of three objects of Stanford's: 95 % within 0.19 to 0.99 pixels by slits, but
        for two, 1.2 and 1.4; within 1.4 to 30 as an orthographic view.)
    times_better
        Where two models fit, the better is taken if its root mean square is so many times less;
        else a flat scene fits both, and neither is believed.
    rim_slope
        Rims tell the near side of an orthographic view where the surface comes to them at least
        this steep, as depth over lateral distance: 45°.
    rim_share, rim_probability
        So many of them must fall the same way, and that by chance at most as often. Rims beside
        each other are not independent, hence the small probability.
    most_points
        So many are fitted, evenly drawn.
    independent
        What points lie off their pixels hangs together over the image: so many of them tell how
        sure a fit is.
    """

    within_pixels: float = 1.0
    share: float = 0.95
    times_better: float = 2.0
    rim_slope: float = 1.0
    rim_share: float = 2 / 3
    rim_probability: float = 1e-6
    most_points: int = 100_000
    independent: int = 100


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """Where one grid's points were seen from.

    Attributes
    ----------
    kind
        How its rays run.
    sensors_mm
        (k, 3) in the points' frame and unit.
    sensor_index
        (m,) which of them saw each of `grid.points`.
    """

    kind: Kind
    sensors_mm: Float[np.ndarray, "k 3"]
    sensor_index: Int[np.ndarray, " m"]


@dataclass(frozen=True, slots=True)
class _Pixels:
    """Points of a grid with their pixels: (m,) columns and rows, (m, 3) places."""

    image: Float[np.ndarray, "2 m"]
    xyz: Float[np.ndarray, "m 3"]


@dataclass(frozen=True, slots=True)
class _Pencil:
    """Planes of one pixel coordinate: `over` · (place, 1) over `below` · (place, 1).

    Attributes
    ----------
    over, below
        (4,) each, of places from `_Frame`.
    off
        (m,) pixels that the fitted points lie beside theirs.
    """

    over: Float[np.ndarray, " 4"]
    below: Float[np.ndarray, " 4"]
    off: Float[np.ndarray, " m"]

    @property
    def is_parallel(self) -> bool:
        """Whether its planes meet nowhere."""
        return not self.below[:3].any()


@dataclass(frozen=True, slots=True)
class _Slits:
    """A view whose planes of `image_along` are the sheets, those of the other meet in the sensor.

    `middle` and `scale` make places of points.
    """

    image_along: int
    sheets: _Pencil
    across: _Pencil
    middle: Vector
    scale: float

    def sensors(self, pixel: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k 3"]:
        """Where the rays of each sheet meet."""
        planes = np.empty((len(pixel), 3, 4))
        planes[:, 0] = self.sheets.over - pixel[:, None] * self.sheets.below
        planes[:, 1], planes[:, 2] = self.across.over, self.across.below
        meet = np.linalg.svd(planes)[2][:, -1]
        return np.asarray(self.middle + self.scale * meet[:, :3] / meet[:, 3:])


@dataclass(frozen=True, slots=True)
class _Fit:
    """How well a model fits: pixels, root mean square and at the share; slits where it has them."""

    kind: Kind
    rms: float
    at_share: float
    slits: _Slits | None = None


def viewpoint_of(points_mm: Points, grid: RangeGrid) -> Viewpoint | None:
    """The sensor of a grid, by the model of its rays that fits.

    Perspective: the origin. Orthographic: far along z, on the side from which the seen surface
    falls away towards its rims (a body bends away where it ends); where rims do not tell, as on
    a flat box, nothing is believed. Pushbroom: a row of places along the way, each for the
    points near it, so many that a ray is off by at most a pixel over the seen depth.

    Returns
    -------
    None where no model fits, two fit alike, or the side is not told: as a file that says nothing.
    """
    options = ViewpointOptions()
    seen = _pixels(points_mm, grid, options.most_points)
    if seen is None:
        return None
    fits = [_orthographic(seen, options), _perspective(seen, options), *_pushbrooms(seen, options)]
    good = [fit for fit in fits if fit is not None and fit.at_share <= options.within_pixels]
    if not good:
        return None
    best = min(good, key=lambda fit: fit.rms)
    straight = [fit for fit in good if fit.kind != "pushbroom"]
    if straight and best.kind == "pushbroom":
        # A sheet of rays has more parameters, so it must fit clearly better.
        simpler = min(straight, key=lambda fit: fit.rms)
        if best.rms * options.times_better > simpler.rms:
            best = simpler
    if any(f.kind != best.kind and f.rms < options.times_better * best.rms for f in straight):
        return None
    points = points_mm[grid.points]
    if best.kind == "perspective":
        return Viewpoint(best.kind, np.zeros((1, 3)), np.zeros(len(points), np.int64))
    if best.kind == "orthographic":
        return _far_away(points_mm, grid, options)
    assert best.slits is not None
    return _along_the_way(points, grid, points_mm, best.slits)


def _pixels(points: Points, grid: RangeGrid, most: int) -> _Pixels | None:
    """Pixels with places, evenly drawn; None where they do not span rows, columns and space."""
    rows, columns = np.nonzero(grid.index >= 0)
    every = max(1, len(rows) // most)
    rows, columns = rows[::every], columns[::every]
    # Fewer than a dozen points fit any model.
    if len(rows) < 12 or np.ptp(rows) == 0 or np.ptp(columns) == 0:
        return None
    xyz = points[grid.index[rows, columns]]
    if not (np.ptp(xyz, axis=0)[:2] > 0).all() or not np.isfinite(np.square(xyz).sum()):
        return None
    return _Pixels(np.stack([columns, rows]).astype(np.float64), xyz)


def _judged(kind: Kind, off: Float[np.ndarray, "2 m"], options: ViewpointOptions) -> _Fit:
    """From how far points lie off their pixels, in pixels."""
    length = np.hypot(off[0], off[1])
    return _Fit(kind, float(np.sqrt(np.mean(length**2))), float(np.quantile(length, options.share)))


def _even(image: Float[np.ndarray, "2 m"], place: Float[np.ndarray, "2 m"]) -> np.ndarray | None:
    """How far places that run evenly over the image lie off their pixels; None where they do not.

    `place` is fitted as a linear function of the pixel, and what is left is told in pixels.
    """
    at = np.stack([np.ones(image.shape[1]), *image], axis=1)
    fit = np.linalg.lstsq(at, place.T, rcond=None)[0]
    step = fit[1:].T
    # Where columns and rows run the same way to within a degree, the grid is no image.
    if not abs(np.linalg.det(step)) > 0.02 * np.prod(np.linalg.norm(step, axis=0)):
        return None
    return np.asarray(np.linalg.solve(step, place - (at @ fit).T))


def _orthographic(seen: _Pixels, options: ViewpointOptions) -> _Fit | None:
    off = _even(seen.image, seen.xyz[:, :2].T)
    return None if off is None else _judged("orthographic", off, options)


def _perspective(seen: _Pixels, options: ViewpointOptions) -> _Fit | None:
    z = seen.xyz[:, 2]
    if not (z > 0).all() and not (z < 0).all():
        return None
    off = _even(seen.image, (seen.xyz[:, :2] / z[:, None]).T)
    return None if off is None else _judged("perspective", off, options)


def _pushbrooms(seen: _Pixels, options: ViewpointOptions) -> list[_Fit]:
    """Views by crossed slits: the planes of rows or of columns meet in a line before the scene."""
    middle = seen.xyz.mean(axis=0)
    scale = float(np.ptp(seen.xyz, axis=0).max())
    places = (seen.xyz - middle) / scale
    pencils = [_pencil(pixel, places, options) for pixel in seen.image]
    found = []
    for image_along in (0, 1):
        sheets, across = pencils[image_along], pencils[1 - image_along]
        if across.is_parallel:
            continue
        slits = _Slits(image_along, sheets, across, middle, scale)
        fit = _judged("pushbroom", np.stack([sheets.off, across.off]), options)
        found.append(replace(fit, slits=slits))
    return found


def _pencil(
    pixel: Float[np.ndarray, " m"], places: Float[np.ndarray, "m 3"], options: ViewpointOptions
) -> _Pencil:
    """Parallel planes, or ones that meet where those fit clearly better and are sure.

    pixel = (a · x + b) / (1 + c · x) is linear after multiplication with the denominator; each
    equation is divided by the denominator found before. Sure: all around the points (there the
    rays run), a pixel is known to within one, and no plane of the denominator's runs there.
    """
    whole = np.column_stack([places, np.ones(len(places))])
    straight = np.linalg.lstsq(whole, pixel, rcond=None)[0]
    parallel = _Pencil(straight, np.array([0.0, 0.0, 0.0, 1.0]), whole @ straight - pixel)
    rows, weight = np.column_stack([whole, -pixel[:, None] * places]), np.ones(len(pixel))
    p: np.ndarray = np.zeros(7)
    for _ in range(4):
        p = np.linalg.lstsq(rows * weight[:, None], pixel * weight, rcond=None)[0]
        below = 1.0 + places @ p[4:]
        if not (below > 0).all():
            return parallel
        weight = 1.0 / below
    off = (whole @ p[:4]) * weight - pixel
    square = float(np.mean(off**2))
    if not options.times_better**2 * square < float(np.mean(parallel.off**2)):
        return parallel
    ends = np.stack([places.min(axis=0), places.max(axis=0)])
    corners = np.array(list(product(*ends.T)))
    beyond = 1.0 + corners @ p[4:]
    if not (beyond > 0).all():
        return parallel
    whole = np.column_stack([corners, np.ones(len(corners))])
    told = (whole @ p[:4]) / beyond
    asked = np.column_stack([whole, -told[:, None] * corners]) / beyond[:, None]
    # each of the independent points tells as much as all of them in the mean
    _, size, ways = np.linalg.svd(rows * weight[:, None] / np.sqrt(len(pixel)), full_matrices=False)
    if size[-1] <= size[0] * len(pixel) * np.finfo(float).eps:
        return parallel
    spread = np.linalg.norm(asked @ ways.T / size, axis=1) * np.sqrt(square / options.independent)
    if spread.max() > options.within_pixels:
        return parallel
    return _Pencil(p[:4], np.append(p[4:], 1.0), off)


def _far_away(points_mm: Points, grid: RangeGrid, options: ViewpointOptions) -> Viewpoint | None:
    """Far along z, on the side that the rims tell; None where they do not."""
    seen = depths_of(points_mm, grid)
    if seen is None:
        return None
    falls, rises = kernels.rims(
        grid.index,
        -points_mm[:, 2].copy(),  # depth for a sensor above: falling z is growing depth
        seen.spacing,
        seen.row_ratio,
        STEEPEST,
        options.rim_slope,
    )
    told = falls + rises
    most = max(falls, rises)
    if not told or most < options.rim_share * told:
        return None
    from scipy.stats import binomtest  # half a second: asked for by scans without sensors alone

    if binomtest(most, told).pvalue > options.rim_probability:
        return None
    side = 1.0 if falls > rises else -1.0
    return straight_from(points_mm[grid.points], side * np.array([0.0, 0.0, 1.0]), seen.spacing[0])


def straight_from(
    points_mm: Float[np.ndarray, "m 3"], towards: Vector, pixel_mm: float
) -> Viewpoint:
    """A sensor so far away that its rays are parallel to `towards`, to a pixel over the depth."""
    middle = points_mm.mean(axis=0)
    depth_mm = float(np.ptp(points_mm @ towards))
    wide_mm = diagonal(points_mm)
    far_mm = max(INFINITY_MM, wide_mm * depth_mm / pixel_mm)
    sensor = middle + towards * far_mm
    return Viewpoint("orthographic", sensor[None], np.zeros(len(points_mm), np.int64))


def _along_the_way(
    points: Float[np.ndarray, "m 3"], grid: RangeGrid, points_mm: Points, slits: _Slits
) -> Viewpoint:
    """Places along the way of a sheet; each stands for the stretch that it is the middle of."""
    pixel = np.nonzero(grid.index >= 0)[1 - slits.image_along].astype(np.float64)
    low, wide = float(pixel.min()), float(np.ptp(pixel))
    ends = slits.sensors(np.array([low, low + 0.5 * wide, low + wide]))
    length, towards = float(np.linalg.norm(ends[2] - ends[0])), ends[1] - np.median(points, axis=0)
    distance = float(np.linalg.norm(towards))
    seen = depths_of(points_mm, grid)
    step = float(seen.spacing[0]) if seen is not None else length / max(grid.index.shape)
    # half a stretch over the distance is a ray's error in angle: over the depth at most a pixel
    stretch = 2 * step * distance / max(float(np.ptp(points @ (towards / distance))), step)
    # finer than the sheets there is nothing to tell apart
    count = max(1, min(int(np.ceil(length / stretch)), int(wide) + 1))
    index = np.minimum(((pixel - low) / max(wide, 1.0) * count).astype(np.int64), count - 1)
    used, index = np.unique(index, return_inverse=True)
    sensors = slits.sensors(low + (used + 0.5) * wide / count)
    return Viewpoint("pushbroom", sensors, index.reshape(-1).astype(np.int64))
