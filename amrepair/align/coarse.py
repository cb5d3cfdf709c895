"""Poses of two clouds on each other, from their features or their boxes.

KISS-Matcher (H. Lim et al., ICRA 2025) on two voxel sizes, and the 24 ways to lay the principal
axes on each other. It proposes; who asks must refine and score.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from amrepair.arrays import Matrix, Points, Vector
from amrepair.frames import cells_of, nearest_rotation, rigid

VOXEL_RATIOS = (0.012, 0.02)  # of the part's diagonal
# The matcher takes normals from points within three voxels, and crashes where no point has any.
# One voxel less: the point of a voxel lies anywhere in it.
NORMAL_VOXELS = 2.0
POINTS_AT_ONCE = 1000


def poses_between(
    source_mm: Points, target_mm: Float[np.ndarray, "m 3"], diagonal_mm: float
) -> Iterator[Matrix]:
    """Candidate poses (target from source) of two clouds: features' first, then the axes'."""
    yield from by_features(source_mm, target_mm, diagonal_mm)
    yield from _by_axes(source_mm, target_mm)


def by_features(
    source_mm: Points, target_mm: Float[np.ndarray, "m 3"], diagonal_mm: float
) -> Iterator[Matrix]:
    """Candidate poses by KISS-Matcher alone; none where it finds no match."""
    for ratio in VOXEL_RATIOS:
        found = _kiss(source_mm, target_mm, ratio * diagonal_mm)
        if found is not None:
            yield found


def _kiss(
    points_mm: Points, surface_mm: Float[np.ndarray, "m 3"], voxel_mm: float
) -> Matrix | None:
    import kiss_matcher

    if not (_has_normals(points_mm, voxel_mm) and _has_normals(surface_mm, voxel_mm)):
        return None
    # Points are taken about their own centres, since the matcher computes in single precision.
    source, target = points_mm.mean(axis=0), surface_mm.mean(axis=0)
    matcher = kiss_matcher.KISSMatcher(
        kiss_matcher.KISSMatcherConfig(voxel_size=voxel_mm, enable_noise_bound_clamping=False)
    )
    answer = matcher.estimate(
        (points_mm - source).astype(np.float32), (surface_mm - target).astype(np.float32)
    )
    rotation = np.asarray(answer.rotation, dtype=np.float64)
    if not answer.valid or not np.isfinite(rotation).all():
        return None
    rotation = nearest_rotation(rotation)
    shift = np.asarray(answer.translation, dtype=np.float64).reshape(3)
    return rigid(rotation, target + shift - rotation @ source)


def _has_normals(points_mm: Points, voxel_mm: float) -> bool:
    """Whether a point of each voxel has others near enough for a normal, for some of them."""
    cell = cells_of(points_mm, points_mm.min(axis=0) // voxel_mm * voxel_mm, voxel_mm)
    number = np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1))
    kept = points_mm[np.unique(number, return_index=True)[1]]
    tree, reach_mm = cKDTree(kept), NORMAL_VOXELS * voxel_mm
    return any(  # of all but the sparsest clouds the first few say so
        np.isfinite(tree.query(some, k=4, distance_upper_bound=reach_mm)[0][:, 3]).any()
        for some in np.split(kept, range(POINTS_AT_ONCE, len(kept), POINTS_AT_ONCE))
    )


def _by_axes(points_mm: Points, surface_mm: Float[np.ndarray, "m 3"]) -> Iterator[Matrix]:
    """The 24 rotations that lay box on box."""
    source, target = _axes(points_mm), _axes(surface_mm)
    for turn in cube_rotations():
        rotation = target[0] @ turn @ source[0].T
        yield rigid(rotation, target[1] - rotation @ source[1])


def _axes(points_mm: Points) -> tuple[Float[np.ndarray, "3 3"], Vector]:
    centre = points_mm.mean(axis=0)
    axes = np.linalg.eigh(np.cov((points_mm - centre).T))[1]
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1.0
    local = (points_mm - centre) @ axes
    middle = 0.5 * (local.min(axis=0) + local.max(axis=0))
    return axes, centre + axes @ middle


def cube_rotations() -> list[Float[np.ndarray, "3 3"]]:
    """The 24 proper rotations of a cube."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return found
