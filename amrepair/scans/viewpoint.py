"""Where the sensor of a range image stood, from the grid itself.

A pixel fixes its ray. So where columns and rows run evenly over x and y the rays are parallel to
z; where they run evenly over x/z and y/z the rays meet in the origin; and where one runs evenly
and the other meets in a point of its own, a sheet of light moved along (a linear pushbroom:
Cyberware's range images). Coordinates must be the sensor's own, z along its view: a cloud that
somebody turned fits none of them, and its sensor stays unknown.

References
----------
R. Gupta, R. I. Hartley: Linear Pushbroom Cameras. IEEE PAMI 19(9), 1997, equation 5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from amrepair.frames import diagonal
from amrepair.scans import range_grid_kernels as kernels
from amrepair.scans.range_grid import EdgeOptions, Kind, RangeGrid, depths_of

# A sensor at infinity stands this far away: its rays over a bed are parallel to a micrometre.
INFINITY_MM = 10_000.0


@dataclass(frozen=True, slots=True)
class ViewpointOptions:
    """When a model of the rays is believed.

    Attributes
    ----------
    within_pixels, share
        That share of the points must lie in the pixel that the model gives them. (The ten range
        images of the Stanford bunny: 95 % within 0.26 to 0.48 pixels as a pushbroom, within 1.4
        to 2.6 as an orthographic view.)
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
    """

    within_pixels: float = 0.5
    share: float = 0.95
    times_better: float = 2.0
    rim_slope: float = 1.0
    rim_share: float = 2 / 3
    rim_probability: float = 1e-6
    most_points: int = 100_000


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
class _Fit:
    """How well a model fits: pixels, root mean square and at the share; a sheet's own figures."""

    kind: Kind
    rms: float
    at_share: float
    along: int = 0  # the axis that a pushbroom moved along
    centre: tuple[float, float] = (0.0, 0.0)  # of its rays, on the other axis and on z


def viewpoint_of(
    points_mm: Float[np.ndarray, "n 3"],
    grid: RangeGrid,
    options: ViewpointOptions | None = None,
) -> Viewpoint | None:
    """The sensor of a grid, by the model of its rays that fits.

    Perspective: the origin. Orthographic: far along z, on the side from which the seen surface
    falls away towards its rims (a body bends away where it ends); where rims do not tell, as on
    a flat box, nothing is believed. Pushbroom: a row of places along the way, each for the
    points near it, so many that a ray is off by at most a pixel over the seen depth.

    Returns
    -------
    None where no model fits, two fit alike, or the side is not told: as a file that says nothing.
    """
    options = options or ViewpointOptions()
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
    return _along_the_way(points, grid, points_mm, best)


def _pixels(points: Float[np.ndarray, "n 3"], grid: RangeGrid, most: int) -> _Pixels | None:
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
    """The sheets that moved along x or y, whose way is the columns or the rows."""
    found = []
    for along in (0, 1):
        for image_along in (0, 1):
            moved, across = seen.image[image_along], seen.image[1 - image_along]
            even = _line(moved, seen.xyz[:, along])
            if even is None or np.quantile(np.abs(even), options.share) > options.within_pixels:
                continue
            central = _central(across, seen.xyz[:, 1 - along], seen.xyz[:, 2])
            if central is None:
                continue
            off, centre = central
            fit = _judged("pushbroom", np.stack([even, off]), options)
            found.append(_Fit("pushbroom", fit.rms, fit.at_share, along, centre))
    return found


def _line(
    pixel: Float[np.ndarray, " m"], place: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " m"] | None:
    """How far places on a line lie off their pixels, in pixels."""
    slope, offset = np.polyfit(pixel, place, 1)
    return None if slope == 0 else (place - offset) / slope - pixel


def _central(
    pixel: Float[np.ndarray, " m"], w: Float[np.ndarray, " m"], z: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " m"], tuple[float, float]] | None:
    """Rays of a sheet that meet in a point outside of the depths seen.

    Fits pixel = (p0 + p1 w + p2 z) / (1 + p3 w + p4 z), linear after multiplication with the
    denominator, and again with each equation divided by the denominator found before. In the
    rays' common point numerator and denominator are both nought.
    """
    middle = np.array([w.mean(), z.mean()])
    scale = float(max(np.ptp(w), np.ptp(z)))
    if not np.ptp(z) > 1e-9 * scale:
        return None
    a, b = (w - middle[0]) / scale, (z - middle[1]) / scale
    rows = np.stack([np.ones_like(a), a, b, -pixel * a, -pixel * b], axis=1)
    weight = np.ones_like(a)
    p = np.zeros(5)
    for _ in range(3):
        p = np.linalg.lstsq(rows * weight[:, None], pixel * weight, rcond=None)[0]
        below = 1 + p[3] * a + p[4] * b
        if not (below > 0).all():
            return None
        weight = 1 / below
    across = np.array([[p[1], p[2]], [p[3], p[4]]])
    if not abs(np.linalg.det(across)) > 0:
        return None
    centre = middle + scale * np.linalg.solve(across, [-p[0], -1.0])
    if not np.isfinite(centre).all() or z.min() <= centre[1] <= z.max():
        return None
    off = (p[0] + p[1] * a + p[2] * b) / below - pixel
    return off, (float(centre[0]), float(centre[1]))


def _far_away(
    points_mm: Float[np.ndarray, "n 3"], grid: RangeGrid, options: ViewpointOptions
) -> Viewpoint | None:
    """Far along z, on the side that the rims tell; None where they do not."""
    seen = depths_of(points_mm, grid)
    if seen is None:
        return None
    falls, rises = kernels.rims(
        grid.index,
        -points_mm[:, 2].copy(),  # depth for a sensor above: falling z is growing depth
        seen.spacing,
        seen.row_ratio,
        EdgeOptions().steepest,
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
    points_mm: Float[np.ndarray, "m 3"], towards: Float[np.ndarray, " 3"], pixel_mm: float
) -> Viewpoint:
    """A sensor so far away that its rays are parallel to `towards`, to a pixel over the depth."""
    middle = points_mm.mean(axis=0)
    depth_mm = float(np.ptp(points_mm @ towards))
    wide_mm = diagonal(points_mm)
    far_mm = max(INFINITY_MM, wide_mm * depth_mm / pixel_mm)
    sensor = middle + towards * far_mm
    return Viewpoint("orthographic", sensor[None], np.zeros(len(points_mm), np.int64))


def _along_the_way(
    points: Float[np.ndarray, "m 3"],
    grid: RangeGrid,
    points_mm: Float[np.ndarray, "n 3"],
    fit: _Fit,
) -> Viewpoint:
    """Places along the way of a sheet; each stands for the stretch that it is the middle of."""
    way = points[:, fit.along]
    low, length = float(way.min()), float(np.ptp(way))
    distance = abs(fit.centre[1] - float(np.median(points[:, 2])))
    seen = depths_of(points_mm, grid)
    pixel = float(seen.spacing[0]) if seen is not None else length / max(grid.index.shape)
    # half a stretch over the distance is a ray's error in angle: over the depth at most a pixel
    stretch = 2 * pixel * distance / max(float(np.ptp(points[:, 2])), pixel)
    # finer than a number tells, there is nothing to tell apart
    count = max(1, int(np.ceil(length / max(stretch, length * np.finfo(float).eps))))
    index = np.minimum(((way - low) / length * count).astype(np.int64), count - 1)
    used, index = np.unique(index, return_inverse=True)
    sensors = np.empty((len(used), 3))
    sensors[:, fit.along] = low + (used + 0.5) * length / count
    sensors[:, 1 - fit.along] = fit.centre[0]
    sensors[:, 2] = fit.centre[1]
    return Viewpoint("pushbroom", sensors, index.reshape(-1).astype(np.int64))
