"""Clouds sorted into cells, and their planes: which way is outward, how noisy are they.

It knows one set of points in one frame; it does not know where the scans stand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.stats import chi2

from amrepair.merge import fuse_kernels as kernels

CLOUD_PLANE_POINTS = 25  # that a plane is fitted to, on average
# A plane's radius over the noise, at least: 4 of them tilt it by some 3°. And how often it grows.
PLANE_NOISES, GROWTHS, GROWTH = 8.0, 3, 1.6
OPEN_DIRECTIONS = 256  # a deep hole is open in one direction of a hundred
# Cells that look around themselves; the others are told by their neighbours.
EVERY_CELL = 4
# Rays start this many cells away from a surface, so that it does not hide itself.
SKIP_CELLS = 2.2
NOISE_QUANTILE = 0.1
AGREE_ROUNDS = 60  # cells that a verdict travels


@dataclass(frozen=True, slots=True)
class Cells:
    """Points sorted by cubic cells.

    Attributes
    ----------
    order
        (n,) which input point stands at each place.
    start
        (cells + 1,) first point of each cell, numbered x-major.
    """

    low_mm: Float[np.ndarray, " 3"]
    cell_mm: float
    shape: Int[np.ndarray, " 3"]
    order: Int[np.ndarray, " n"]
    start: Int[np.ndarray, " cells1"]

    @property
    def grid(self) -> kernels.Grid:
        """As the kernels take them."""
        return kernels.Grid(self.low_mm, self.cell_mm, self.shape, self.start)

    @classmethod
    def of(cls, points_mm: Float[np.ndarray, "n 3"], cell_mm: float) -> Cells:
        """Sort points; two empty layers of cells lie around them."""
        low = points_mm.min(axis=0) - 2.0 * cell_mm
        shape = np.floor((points_mm.max(axis=0) - low) / cell_mm).astype(np.int64) + 3
        index = np.floor((points_mm - low) / cell_mm).astype(np.int64)
        key = (index[:, 0] * shape[1] + index[:, 1]) * shape[2] + index[:, 2]
        order = np.argsort(key, kind="stable")
        start = np.zeros(int(np.prod(shape)) + 1, np.int64)
        np.cumsum(np.bincount(key, minlength=int(np.prod(shape))), out=start[1:])
        return cls(low, cell_mm, shape, order, start)


def spacing_of(points_mm: Float[np.ndarray, "n 3"]) -> float:
    """Mean distance of neighbouring points on the surface, from a sample's nearest neighbours.

    Random points of density ρ have their 8th neighbour at sqrt(8 / πρ) on average.
    """
    step = max(1, len(points_mm) // 2_000)
    count = min(9, len(points_mm))
    reach = cKDTree(points_mm).query(points_mm[::step], k=[count])[0][:, 0]
    return float(np.median(reach) * np.sqrt(np.pi / max(count - 1, 1)))


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
    """

    normals: Float[np.ndarray, "n 3"]
    sigma_mm: float
    rough_mm: Float[np.ndarray, " n"]


def planes(points_mm: Float[np.ndarray, "n 3"], spacing_mm: float) -> Planes:
    """Fit a plane at each point, over more of the surface where the noise asks for it.

    On flat ground the least variance of m points is σ²/m χ² with m − 3 degrees of freedom; edges
    and curves only add to it, so a low quantile is compared.
    """
    radius_mm = float(np.sqrt(CLOUD_PLANE_POINTS / np.pi)) * spacing_mm
    for _ in range(GROWTHS):
        found = _planes(points_mm, radius_mm)
        if radius_mm >= PLANE_NOISES * found.sigma_mm:
            break
        radius_mm = min(GROWTH * radius_mm, PLANE_NOISES * found.sigma_mm)
    return found


def _planes(points_mm: Float[np.ndarray, "n 3"], radius_mm: float) -> Planes:
    cells = Cells.of(points_mm, radius_mm)
    ordered = np.ascontiguousarray(points_mm[cells.order])
    found, least, count = kernels.local_planes(ordered, cells.grid, radius_mm)
    normals, variance = np.empty_like(found), np.empty(len(found))
    normals[cells.order], variance[cells.order] = found, least
    enough = count >= 8
    if not enough.any():
        return Planes(normals, 0.0, np.sqrt(np.maximum(variance, 0.0)))
    m = count[enough].astype(np.float64)
    ratio = np.maximum(least[enough], 0.0) * m / chi2.ppf(NOISE_QUANTILE, m - 3)
    sigma_mm = float(np.sqrt(np.quantile(ratio, NOISE_QUANTILE)))
    return Planes(normals, sigma_mm, np.sqrt(np.maximum(variance - sigma_mm**2, 0.0)))


def directions(count: int = OPEN_DIRECTIONS) -> Float[np.ndarray, "k 3"]:
    """Directions spread evenly over the sphere (Fibonacci)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def outward(
    points_mm: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], spacing_mm: float
) -> Float[np.ndarray, "n 3"]:
    """(n, 3) the normals, turned to the side from which more of the distance is in sight.

    A closed surface lets no ray out from within; one with gaps fewer than from without.
    """
    extent_mm = float(np.ptp(points_mm, axis=0).max())
    cell_mm = max(2.0 * spacing_mm, extent_mm / 250.0)
    low = points_mm.min(axis=0) - 2.0 * cell_mm
    index = np.floor((points_mm - low) / cell_mm).astype(np.int64)
    shape = index.max(axis=0) + 3
    key = (index[:, 0] * shape[1] + index[:, 1]) * shape[2] + index[:, 2]
    places, first, cell_of = np.unique(key, return_index=True, return_inverse=True)
    occupied = np.zeros(tuple(shape), dtype=bool)
    occupied.reshape(-1)[places] = True
    # no ray slips through a cell that happens to hold no point
    occupied |= ndimage.binary_closing(occupied, np.ones((3, 3, 3), dtype=bool))
    count = np.bincount(cell_of)

    def total(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "s 3"]:
        return np.stack([np.bincount(cell_of, weights=values[:, a]) for a in range(3)], axis=1)

    centre = total(points_mm) / count[:, None]
    same = np.sign((normals * normals[first][cell_of]).sum(axis=1))
    plane = total(normals * same[:, None])
    plane /= np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1e-12)
    votes = np.zeros_like(centre)
    votes[::EVERY_CELL] = kernels.open_side(
        centre[::EVERY_CELL], directions(), occupied, low, cell_mm, SKIP_CELLS
    )
    side = _agreed(centre, plane, (plane * votes).sum(axis=1), cell_mm)
    along = (normals * plane[cell_of]).sum(axis=1)
    # where a cell holds two planes, the nearest that looked around decides for the other
    looked = votes[::EVERY_CELL][cKDTree(centre[::EVERY_CELL]).query(centre)[1]]
    own = (normals * looked[cell_of]).sum(axis=1)
    sign = np.where(np.abs(along) > 0.5, along * np.sign(side)[cell_of], own)
    return normals * np.where(sign < 0, -1.0, 1.0)[:, None]


def _agreed(
    centre_mm: Float[np.ndarray, "s 3"],
    plane: Float[np.ndarray, "s 3"],
    side: Float[np.ndarray, " s"],
    cell_mm: float,
) -> Float[np.ndarray, " s"]:
    """(s,) the sides, after cells in one plane have told each other: a face turns as a whole."""
    from scipy.sparse import coo_matrix

    pairs = cKDTree(centre_mm).query_pairs(1.9 * cell_mm, output_type="ndarray")
    i, j = pairs[:, 0], pairs[:, 1]
    cosine = (plane[i] * plane[j]).sum(axis=1)
    offset = centre_mm[j] - centre_mm[i]
    reach = np.linalg.norm(offset, axis=1)
    height = np.abs((offset * (plane[i] + np.sign(cosine)[:, None] * plane[j])).sum(axis=1)) / 2
    together = (np.abs(cosine) > 0.8) & (height < 0.35 * reach)
    weight = np.where(together, cosine, 0.0)
    count = len(centre_mm)
    graph = coo_matrix((weight, (i, j)), shape=(count, count)).tocsr()
    graph = graph + graph.T
    degree = np.maximum(np.asarray(np.abs(graph).sum(axis=1)).ravel(), 1.0)
    found = side
    for _ in range(AGREE_ROUNDS):
        found = 0.05 * side + 0.95 * (graph @ found) / degree
    return np.where(found == 0, side, found)
