"""Clouds sorted into cells, and their planes: which way is outward, how noisy are they.

It knows one set of points in one frame; it does not know where the scans stand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from scipy.special import chdtri

from amrepair.arrays import Mask, Numbers, Points, Values, Vector
from amrepair.field.near import spacing_in
from amrepair.frames import cells_of, spread_directions
from amrepair.merge import fuse_kernels as kernels
from amrepair.merge.options import DEFAULT_CLOUD
from gcode.compiled import read_only


@dataclass(frozen=True, slots=True)
class SortedPoints:
    """Points sorted by cubic cells.

    Attributes
    ----------
    order
        (n,) which input point stands at each place.
    start
        (cells + 1,) first point of each cell, numbered x-major.
    """

    low_mm: Vector
    cell_mm: float
    shape: Int[np.ndarray, " 3"]
    order: Numbers
    start: Int[np.ndarray, " cells1"]

    @property
    def grid(self) -> kernels.PointGrid:
        """As the kernels take them."""
        return kernels.PointGrid(self.low_mm, self.cell_mm, self.shape, self.start)

    @classmethod
    def of(cls, points_mm: Points, cell_mm: float) -> SortedPoints:
        """Sort points; two empty layers of cells lie around them."""
        low = points_mm.min(axis=0) - 2.0 * cell_mm
        shape = np.floor((points_mm.max(axis=0) - low) / cell_mm).astype(np.int64) + 3
        key = np.ravel_multi_index(tuple(cells_of(points_mm, low, cell_mm).T), tuple(shape))
        order = np.argsort(key, kind="stable")
        start = np.zeros(int(np.prod(shape)) + 1, np.int64)
        np.cumsum(np.bincount(key, minlength=int(np.prod(shape))), out=start[1:])
        return cls(low, cell_mm, shape, order, start)


def spacing_of(points_mm: Points) -> float:
    """Mean distance of neighbouring points on the surface (`near.spacing_in`)."""
    return spacing_in(cKDTree(points_mm))


@dataclass(frozen=True, slots=True)
class Planes:
    """Through each point's neighbours.

    Attributes
    ----------
    normals
        (n, 3) unit normals of either sign.
    sigma_mm
        Noise across the surface.
    rough_mm
        (n,) how far the neighbours lie from the plane beyond that noise: edges and curves.
    tilt_rad
        (n,) standard error of the normal, by what the neighbours lie off the plane.
    """

    normals: Points
    sigma_mm: float
    rough_mm: Values
    tilt_rad: Values

    def or_better(self, other: Planes) -> Planes:
        """At each point the plane of the two that is tilted less; the noise is this one's."""
        better = other.tilt_rad < self.tilt_rad
        return Planes(
            np.where(better[:, None], other.normals, self.normals),
            self.sigma_mm,
            np.where(better, other.rough_mm, self.rough_mm),
            np.where(better, other.tilt_rad, self.tilt_rad),
        )


def planes(points_mm: Points, spacing_mm: float) -> Planes:
    """Fit a plane at each point, over as much of the surface as tilts it least.

    More points average more noise, and reach over edges and through thin walls. On flat ground the
    least variance of m points is σ²/m χ² with m − 3 degrees of freedom; edges, curves and walls'
    other sides only add to it, so the noise is a low quantile, by the narrowest planes.
    """
    narrow_mm, wide_mm = (
        np.sqrt(np.array([DEFAULT_CLOUD.narrow_points, DEFAULT_CLOUD.wide_points]) / np.pi)
        * spacing_mm
    )
    found = _planes(points_mm, narrow_mm, None)
    reached_mm, radius_mm = narrow_mm, wide_mm
    for _ in range(DEFAULT_CLOUD.growths):
        # a ball not much wider than the noise cuts it off at its ends
        told = found.sigma_mm if reached_mm >= DEFAULT_CLOUD.noise_noises * found.sigma_mm else None
        found = _planes(points_mm, radius_mm, told).or_better(found)
        if radius_mm >= DEFAULT_CLOUD.plane_noises * found.sigma_mm:
            break
        reached_mm = radius_mm
        radius_mm = min(
            DEFAULT_CLOUD.growth * radius_mm, DEFAULT_CLOUD.plane_noises * found.sigma_mm
        )
    return found


def _planes(points_mm: Points, radius_mm: float, sigma_mm: float | None) -> Planes:
    cells = SortedPoints.of(points_mm, radius_mm)
    ordered = np.ascontiguousarray(points_mm[cells.order])
    found, least, count = kernels.local_planes(ordered, cells.grid, radius_mm)
    normals, variance, m = np.empty_like(found), np.empty(len(found)), np.empty(len(found))
    normals[cells.order], variance[cells.order], m[cells.order] = found, least, count
    variance = np.maximum(variance, 0.0)
    if sigma_mm is None:
        enough = m >= DEFAULT_CLOUD.least_plane_points
        freedom = m[enough] - 3
        ratio = variance[enough] * m[enough] / chdtri(freedom, 1.0 - DEFAULT_CLOUD.noise_quantile)
        sigma_mm = (
            float(np.sqrt(np.quantile(ratio, DEFAULT_CLOUD.noise_quantile)))
            if enough.any()
            else 0.0
        )
    # residuals over the points' lever: over a disc, each coordinate has a quarter of r² as variance
    freedom = np.maximum(m - 3, 0.5)
    off = np.maximum(variance * m / freedom, sigma_mm**2)
    tilt = np.sqrt(4.0 * off / m) / radius_mm
    return Planes(normals, sigma_mm, np.sqrt(np.maximum(variance - sigma_mm**2, 0.0)), tilt)


def outward(
    points_mm: Points,
    normals: Points,
    spacing_mm: float,
    sigma_mm: float,
    asked: Int[np.ndarray, " a"] | None = None,
) -> Points:
    """(n, 3) the normals, turned to the side from which more of the distance is in sight.

    A closed surface lets no ray out from within; one with gaps fewer than from without. What hides
    is a disc about each point, not a cell: a wall thinner than a cell has two sides.

    Parameters
    ----------
    asked
        Which of them may turn; all where none are given.
    """
    whose = np.arange(len(points_mm)) if asked is None else asked
    step = len(whose) // DEFAULT_CLOUD.looking_points + 1
    look, facing = (np.ascontiguousarray(each[whose[::step]]) for each in (points_mm, normals))
    votes = _seen_from(look, facing, points_mm, normals, spacing_mm, sigma_mm)
    side = _agreed(look, facing, (facing * votes).sum(axis=1), spacing_mm * np.sqrt(step), sigma_mm)
    told, _ = _told_by(
        points_mm[whose], normals[whose], look, facing * np.sign(side)[:, None],
        spacing_mm, sigma_mm,
    )  # fmt: skip
    found = normals.copy()
    found[whose] *= np.where(told < 0, -1.0, 1.0)[:, None]
    return found


def outward_by(
    points_mm: Points, normals: Points, known: Mask, spacing_mm: float, sigma_mm: float
) -> Points:
    """(n, 3) the normals, those that are not known turned as the known ones beside them are.

    Only where no known one lies beside them on their sheet do places look around themselves.
    """
    asked = np.flatnonzero(~known)
    told, by = _told_by(
        points_mm[asked], normals[asked], points_mm[known], normals[known], spacing_mm, sigma_mm,
        within_mm=DEFAULT_CLOUD.tells_spacings * spacing_mm,
    )  # fmt: skip
    found = normals.copy()
    found[asked] *= np.where(told < 0, -1.0, 1.0)[:, None]
    rest = asked[by < DEFAULT_CLOUD.told_enough]
    return outward(points_mm, found, spacing_mm, sigma_mm, rest) if len(rest) else found


def _told_by(
    points_mm: Points,
    normals: Points,
    look_mm: Float[np.ndarray, "s 3"],
    facing: Float[np.ndarray, "s 3"],
    spacing_mm: float,
    sigma_mm: float,
    within_mm: float = np.inf,
) -> tuple[Values, Values]:
    """(n,) what the places beside each say for its normal, or against it; (n,) how many say it.

    Those on its own sheet: at its height, by the mean of both planes.
    """
    near = min(DEFAULT_CLOUD.told_by, len(look_mm))
    if near == 0:
        return np.zeros(len(points_mm)), np.zeros(len(points_mm))
    away, index = cKDTree(look_mm).query(
        points_mm, k=[*range(1, near + 1)], distance_upper_bound=within_mm, workers=-1
    )
    there = np.isfinite(away)
    away, index = np.where(there, away, 0.0), np.where(there, index, 0)
    cosine = np.einsum("na,nka->nk", normals, facing[index])
    offset = look_mm[index] - points_mm[:, None]
    mean = normals[:, None] + np.sign(cosine)[..., None] * facing[index]
    height = np.einsum("nka,nka->nk", offset, mean) / 2
    slack = (
        np.maximum(DEFAULT_CLOUD.sheet_slope * away, DEFAULT_CLOUD.sheet_noises * sigma_mm) + 1e-9
    )
    beside = np.where(there, np.exp(-((height / slack) ** 2)) * np.abs(cosine), 0.0)
    said = beside * np.sign(cosine) / (away + 0.1 * spacing_mm) ** 2
    return said.sum(axis=1), beside.sum(axis=1)


def _seen_from(
    look_mm: Float[np.ndarray, "s 3"],
    facing: Float[np.ndarray, "s 3"],
    points_mm: Points,
    normals: Points,
    spacing_mm: float,
    sigma_mm: float,
) -> Float[np.ndarray, "s 3"]:
    """(s, 3) sums of the directions in which places see far past the points' discs."""
    step = len(points_mm) // DEFAULT_CLOUD.hiding_points + 1
    place, plane = (read_only(each[::step]) for each in (points_mm, normals))
    disc_mm = DEFAULT_CLOUD.disc_spacings * spacing_mm * float(np.sqrt(step))
    extent_mm = float(np.ptp(place, axis=0).max())
    cell_mm = max(disc_mm, extent_mm / DEFAULT_CLOUD.most_cells)
    low = place.min(axis=0) - 2.0 * cell_mm - disc_mm
    shape = np.floor((place.max(axis=0) + disc_mm - low) / cell_mm).astype(np.int64) + 3
    start, discs = kernels.discs_of_cells(place, plane, disc_mm, low, cell_mm, shape)
    noise_mm = DEFAULT_CLOUD.sheet_noises * sigma_mm
    own_mm = max(DEFAULT_CLOUD.own_discs * disc_mm, 2.0 * noise_mm)
    ways, grid = (
        spread_directions(DEFAULT_CLOUD.directions),
        kernels.PointGrid(low, cell_mm, shape, start),
    )
    sheet = kernels.Sheet(disc_mm, own_mm, DEFAULT_CLOUD.sheet_slope, noise_mm)
    return np.asarray(kernels.open_side(look_mm, facing, ways, place, plane, grid, discs, sheet))


def _agreed(
    look_mm: Float[np.ndarray, "s 3"],
    plane: Float[np.ndarray, "s 3"],
    side: Float[np.ndarray, " s"],
    spacing_mm: float,
    sigma_mm: float,
) -> Float[np.ndarray, " s"]:
    """(s,) the sides, after places on one sheet have told each other: a face turns as a whole."""
    from scipy.sparse import coo_matrix

    pairs = cKDTree(look_mm).query_pairs(
        DEFAULT_CLOUD.tells_spacings * spacing_mm, output_type="ndarray"
    )
    i, j = pairs[:, 0], pairs[:, 1]
    cosine = (plane[i] * plane[j]).sum(axis=1)
    offset = look_mm[j] - look_mm[i]
    reach = np.linalg.norm(offset, axis=1)
    height = np.abs((offset * (plane[i] + np.sign(cosine)[:, None] * plane[j])).sum(axis=1)) / 2
    together = np.abs(cosine) > 0.8
    together &= height < np.maximum(
        DEFAULT_CLOUD.sheet_slope * reach, DEFAULT_CLOUD.sheet_noises * sigma_mm
    )
    weight = np.where(together, cosine, 0.0)
    count = len(look_mm)
    graph = coo_matrix((weight, (i, j)), shape=(count, count)).tocsr()
    graph = graph + graph.T
    degree = np.maximum(np.asarray(np.abs(graph).sum(axis=1)).ravel(), 1.0)
    found = side
    for _ in range(DEFAULT_CLOUD.agree_rounds):
        found = 0.05 * side + 0.95 * (graph @ found) / degree
    return np.where(found == 0, side, found)
