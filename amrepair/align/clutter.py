"""What in a scan may be the part: without scattered points, the plane it stands on, other pieces.

It looks at the scan alone, so that what it leaves out cannot be what does not fit. It says nothing
of poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.special import chdtri

from amrepair.align.options import DEFAULT_ALIGN, ClutterOptions
from amrepair.arrays import Mask, Points, Values
from amrepair.frames import diagonal


@dataclass(frozen=True, slots=True)
class Kept:
    """Points that may be the part.

    Attributes
    ----------
    points_mm
        (n, 3) of a sample of the scan, in its frame.
    left_out_ratio
        Share of the sample that is not among them.
    is_piece
        One of several that do not touch: whoever tries them all takes the one that fits best.
    """

    points_mm: Points
    left_out_ratio: float
    is_piece: bool = False


def without_clutter(
    points_mm: Points, rng: np.random.Generator, options: ClutterOptions = DEFAULT_ALIGN.clutter
) -> list[Kept]:
    """What may be the part, least left out first; empty where there is no clutter to tell.

    Parameters
    ----------
    points_mm
        (n, 3) in any frame.
    """
    cloud = points_mm
    if len(cloud) > options.points:
        cloud = cloud[rng.permutation(len(cloud))[: options.points]]
    if len(cloud) < options.least_left:
        return []
    reach, normals, across, thick = _neighbourhoods(cloud, options.neighbours)
    usual_mm = float(np.quantile(reach, options.usual_quantile))
    surface = (reach <= options.far_factor * usual_mm) & (thick <= options.thick_ratio)
    if surface.mean() < options.least_kept:
        surface = np.ones(len(cloud), dtype=bool)
    masks = [surface]
    sigma_mm = float(np.median(across[surface]))
    bed = _bed(cloud, normals, surface, sigma_mm, options, rng)
    if bed is not None and (surface & ~bed).sum() >= options.least_left:
        # What is left of the bed's rim and noise is scattered by now.
        masks.append(surface & ~bed)
    whole = len(masks)
    masks += _pieces(cloud, masks[-1], options.gap_factor * usual_mm, options)
    found: list[Kept] = []
    last = len(cloud)
    for k, mask in enumerate(masks):
        count = int(mask.sum())
        if count >= options.least_left and abs(last - count) > options.worth * len(cloud):
            found.append(Kept(cloud[mask], 1.0 - count / len(cloud), is_piece=k >= whole))
            last = count
    return found


def noise_across(
    points_mm: Points, rng: np.random.Generator, options: ClutterOptions = DEFAULT_ALIGN.clutter
) -> float:
    """Noise across the surface, mm: what quadrics through nearby points leave.

    The squares that k points leave about six coefficients are σ² χ² with k − 6 degrees of freedom;
    edges only add to them, so a low quantile is compared.
    """
    count = min(options.noise_neighbours, len(points_mm))
    if count <= 6:
        return 0.0
    places = points_mm[rng.permutation(len(points_mm))[: options.noise_places]]
    index = cKDTree(points_mm).query(places, k=[*range(1, count + 1)], workers=2)[1]
    near = points_mm[index] - points_mm[index].mean(axis=1, keepdims=True)
    axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1]
    z, y, x = np.moveaxis(np.einsum("nki,nij->nkj", near, axes), 2, 0)
    basis = np.linalg.qr(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=2))[0]
    left = (z**2).sum(axis=1) - (np.einsum("nkc,nk->nc", basis, z) ** 2).sum(axis=1)
    low = float(np.quantile(np.maximum(left, 0.0), options.noise_quantile))
    return float(np.sqrt(low / chdtri(count - 6, 1.0 - options.noise_quantile)))


def _neighbourhoods(
    cloud: Points, neighbours: int
) -> tuple[
    Values,
    Points,
    Values,
    Values,
]:
    """Reach of the neighbours, their plane's normal, the noise across it, its share of variance."""
    reach, index = cKDTree(cloud).query(cloud, k=[*range(1, neighbours + 1)], workers=2)
    near = cloud[index] - cloud[index].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near) / neighbours)
    values = np.maximum(values, 0.0)
    return (
        reach[:, -1],
        vectors[:, :, 0],
        np.sqrt(values[:, 0]),
        values[:, 0] / np.maximum(values.sum(axis=1), 1e-30),
    )


def _bed(
    cloud: Points,
    normals: Points,
    surface: Mask,
    sigma_mm: float,
    options: ClutterOptions,
    rng: np.random.Generator,
) -> Mask | None:
    """(n,) points of the plane that holds most of the surface, if all the rest is on one side."""
    here = np.flatnonzero(surface)
    kept = cloud[here]
    diagonal_mm = diagonal(kept)
    last_mm = max(options.plane_sigmas * sigma_mm, options.last_tolerance_ratio * diagonal_mm)
    first_mm = options.first_tolerance_ratio * diagonal_mm
    few = kept[rng.permutation(len(kept))[: options.plane_points]]
    best, best_count = None, 0
    for k in rng.permutation(here)[: options.hypotheses]:
        point, normal = cloud[k], normals[k]
        for tolerance_mm in np.geomspace(first_mm, last_mm, options.plane_rounds):
            inside = np.abs((few - point) @ normal) <= tolerance_mm
            if inside.sum() < options.least_in_plane:
                break
            point = few[inside].mean(axis=0)
            normal = np.linalg.eigh(np.cov((few[inside] - point).T))[1][:, 0]
        count = int((np.abs((few - point) @ normal) <= last_mm).sum())
        if count > best_count:
            best, best_count = (point, normal), count
    if best is None or best_count < options.least_plane * len(few):
        return None
    height = (cloud - best[0]) @ best[1]
    plane = np.abs(height) <= last_mm
    rest = height[surface & ~plane]
    above = float((rest > 0).mean()) if len(rest) else 0.5
    return plane if max(above, 1.0 - above) >= options.one_side else None


def _pieces(cloud: Points, mask: Mask, gap_mm: float, options: ClutterOptions) -> list[Mask]:
    """(n,) each, the largest pieces that do not touch, largest first; none if there is but one."""
    here: Int[np.ndarray, " k"] = np.flatnonzero(mask)
    low = cloud[here].min(axis=0)
    size = np.ptp(cloud[here], axis=0)
    edge_mm = max(gap_mm, float(np.cbrt(np.prod(size + gap_mm) / options.most_cells)), 1e-9)
    index = np.floor((cloud[here] - low) / edge_mm).astype(np.int64)
    grid = np.zeros(index.max(axis=0) + 1, dtype=bool)
    grid[tuple(index.T)] = True
    labels = ndimage.label(grid, structure=np.ones((3, 3, 3), dtype=bool))[0]
    piece = labels[tuple(index.T)]
    counts = np.bincount(piece)
    order = np.argsort(-counts, kind="stable")[: options.most_pieces]
    large = [int(k) for k in order if counts[k] >= options.least_piece * len(here)]
    if len(large) == 1 and counts[large[0]] > (1.0 - options.worth) * len(here):
        return []
    found = []
    for k in large:
        one = np.zeros(len(cloud), dtype=bool)
        one[here[piece == k]] = True
        found.append(one)
    return found
