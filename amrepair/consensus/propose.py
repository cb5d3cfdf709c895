"""Where a scan lies on the scans that are placed already, from nothing known.

KISS-Matcher (H. Lim et al., ICRA 2025) and the principal axes guess; GICP (K. Koide, small_gicp,
2024) refines every guess on few points, and on many those that come close to the best. It does not
say whether the best is good enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from amrepair.align.coarse import poses_between
from amrepair.consensus.cloud import planes, spacing_of
from amrepair.frames import box_corners, moved

# Of the part's diagonal: voxels that leave about 1,500 and 15,000 points; how far pairs may be.
ROUGH_VOXEL, FINE_VOXEL, PAIRS_WITHIN = 0.02, 0.006, 0.02
ROUGH_SCORED, FINE_SCORED = 1_000, 4_000  # points
# Wrong guesses wander as long as they may; those that are nearly right are there after a few.
ROUGH_ITERATIONS = 12
# Guesses that end nearer than this to each other, of the diagonal, are one.
SAME = 0.01
# A rough score less than the best by more is not looked at again: the scores of wrong poses lie
# 1 to 8 below the right one's, those of a plate and of the plate turned under 0.1 apart.
DOUBT = 0.5
# A point farther from the model than it lies overlaps by reach is above it, not beside it, where
# this share of the way is along the normal; it counts this many times.
ABOVE, CONTRADICTION = 0.8, 4.0
# More than this against each point that agrees, and the pose is wrong: a plate on its other half
# has 0.5, that plate in its place 0.16 (its edges), scans of a whole part under 0.05.
MOST_AGAINST = 0.3


def propose(
    source_mm: Float[np.ndarray, "n 3"], model_mm: Float[np.ndarray, "m 3"], diagonal_mm: float
) -> tuple[float, Float[np.ndarray, "4 4"]]:
    """The best pose of a scan on the model, and the share of it that lies there.

    Returns
    -------
    tuple
        The share, 0 where too much of either contradicts the best pose, and the (4, 4) model from
        scan.
    """
    pair = _Pair.of(source_mm, model_mm)
    trial = _Trial.of(source_mm, model_mm, ROUGH_VOXEL * diagonal_mm, PAIRS_WITHIN * diagonal_mm)
    corners = box_corners(np.array([source_mm.min(axis=0), source_mm.max(axis=0)]))
    rough: list[tuple[float, np.ndarray]] = []
    for guess in poses_between(source_mm, model_mm, diagonal_mm):
        pose = trial.refined(guess, ROUGH_ITERATIONS)
        away = [np.abs(moved(corners, pose) - moved(corners, p)).max() for _, p in rough]
        if min(away, default=np.inf) > SAME * diagonal_mm:
            rough.append((pair.score(pose, ROUGH_SCORED)[0], pose))
    bar = max(score for score, _ in rough) - DOUBT
    trial = _Trial.of(source_mm, model_mm, FINE_VOXEL * diagonal_mm, PAIRS_WITHIN * diagonal_mm)
    best_score, best_overlap, best_pose = -np.inf, 0.0, np.eye(4)
    for rough_score, guess in rough:
        if rough_score >= bar:
            pose = trial.refined(guess)
            score, overlap = pair.score(pose, FINE_SCORED)
            if score > best_score:
                best_score, best_overlap, best_pose = score, overlap, pose
    return best_overlap, best_pose


@dataclass(frozen=True, slots=True)
class _Surface:
    """Points with their planes, for looking up from the other cloud's points."""

    points_mm: Float[np.ndarray, "n 3"]
    plane: Float[np.ndarray, "n 3"]
    tree: cKDTree

    @classmethod
    def of(cls, points_mm: Float[np.ndarray, "n 3"]) -> _Surface:
        return cls(points_mm, planes(points_mm, spacing_of(points_mm)).normals, cKDTree(points_mm))

    def some(self, count: int) -> Float[np.ndarray, "k 3"]:
        return self.points_mm[:: len(self.points_mm) // count + 1]

    def agreement(
        self, points_mm: Float[np.ndarray, "k 3"], reach_mm: float
    ) -> tuple[float, float]:
        """Shares of points that lie on the surface, and above or below it and not beside it."""
        distance, index = self.tree.query(points_mm, workers=-1)
        height = np.abs(((points_mm - self.points_mm[index]) * self.plane[index]).sum(axis=1))
        off = (distance > reach_mm) & (height > ABOVE * distance)
        return float((distance < reach_mm).mean()), float(off.mean())


@dataclass(frozen=True, slots=True)
class _Pair:
    """A scan and the model, and how well they agree in a pose.

    Overlap alone would lay one half of a part on the other. A point beside the model's rim says
    nothing; one above or below its surface contradicts the pose.
    """

    source: _Surface
    model: _Surface
    reach_mm: float

    @classmethod
    def of(cls, source_mm: Float[np.ndarray, "n 3"], model_mm: Float[np.ndarray, "m 3"]) -> _Pair:
        source, model = _Surface.of(source_mm), _Surface.of(model_mm)
        usual = float(np.median(model.tree.query(model.some(2_000), k=[2])[0]))
        return cls(source, model, 3.0 * usual)

    def score(self, pose: Float[np.ndarray, "4 4"], count: int) -> tuple[float, float]:
        """How good a pose is, and the share that overlaps: 0 where too much contradicts it."""
        overlap, against = self.model.agreement(moved(self.source.some(count), pose), self.reach_mm)
        back = moved(self.model.some(count), np.linalg.inv(pose))
        against += self.source.agreement(back, self.reach_mm)[1]
        agrees = against <= MOST_AGAINST * overlap
        return overlap - CONTRADICTION * against, overlap if agrees else 0.0


@dataclass(frozen=True, slots=True)
class _Trial:
    """GICP of a scan on the model, both thinned to voxels."""

    source: object
    target: object
    target_tree: object
    reach_mm: float

    @classmethod
    def of(
        cls,
        source_mm: Float[np.ndarray, "n 3"],
        model_mm: Float[np.ndarray, "m 3"],
        voxel_mm: float,
        reach_mm: float,
    ) -> _Trial:
        import small_gicp

        source, _ = small_gicp.preprocess_points(
            np.ascontiguousarray(source_mm), downsampling_resolution=voxel_mm
        )
        target, tree = small_gicp.preprocess_points(
            np.ascontiguousarray(model_mm), downsampling_resolution=voxel_mm
        )
        return cls(source, target, tree, reach_mm)

    def refined(
        self, guess: Float[np.ndarray, "4 4"], iterations: int = 20
    ) -> Float[np.ndarray, "4 4"]:
        import small_gicp

        answer = small_gicp.align(
            self.target,
            self.source,
            self.target_tree,
            init_T_target_source=guess,
            max_correspondence_distance=self.reach_mm,
            max_iterations=iterations,
        )
        return np.array(answer.T_target_source)
