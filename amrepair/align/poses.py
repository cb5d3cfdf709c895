"""Poses of one scan on its template: refined on few points, the best of them on all, and scored.

It is told where to start, and chooses nothing but what to leave.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.align.refine import Refined, refine_all
from amrepair.align.thinning import Thinned
from amrepair.frames import box_corners
from amrepair.template.port import Template

DENSE_POINTS, FEW_POINTS, FIRST_POINTS = 15_000, 2_000, 700
FEW_FACTOR, FEW_ITERATIONS, DENSE_ITERATIONS, MOST_FINISHED = 1.5, 30, 120, 3
# After so many iterations scores change little: a pose worse than the best by this factor is left
# as it is. On few points nothing is gained by steps below this share of the noise.
FIRST_ITERATIONS, LEFT_FACTOR, ENOUGH_SIGMAS = 10, 1.6, 0.05
FIRST_RATIO = 0.005  # scale of the loss to begin with, of the diagonal
SAME_FIT_MM = 0.005  # scores that differ by less are alike
APART_RATIO = 0.02  # poses that move the part less than this share of its size are the same
PLAUSIBLE = 0.6  # a mean distance above this share of the cap is no fit, with more points either


@dataclass(frozen=True, slots=True)
class Clouds:
    """A scan in several densities, and what its poses are judged by."""

    dense_mm: Float[np.ndarray, "n 3"]
    thinned: Thinned
    corners_mm: Float[np.ndarray, "8 3"]
    diagonal_mm: float
    sigma_mm: float

    @classmethod
    def of(
        cls,
        points_mm: Float[np.ndarray, "n 3"],
        template: Template,
        sigma_mm: float,
        rng: np.random.Generator,
    ) -> Clouds:
        """Of a scan's points; the diagonal is the template's."""
        dense = Thinned(points_mm, rng).to(DENSE_POINTS)
        box = np.stack([dense.min(axis=0), dense.max(axis=0)])
        diagonal_mm = float(np.linalg.norm(np.ptp(template.bounds_mm, axis=0)))
        return cls(dense, Thinned(dense, rng), box_corners(box), diagonal_mm, sigma_mm)

    @property
    def size_mm(self) -> float:
        """Length of the scan, between the farthest corners of its box.

        In the frame of its main axes: a long thin scan that stands askew is no larger.
        """
        local = self.dense_mm - self.dense_mm.mean(axis=0)
        return float(np.linalg.norm(np.ptp(local @ np.linalg.eigh(local.T @ local)[1], axis=0)))

    @property
    def cap_mm(self) -> float:
        """Farther off is as bad: ten times the noise, or a millimetre."""
        return max(1.0, 10.0 * self.sigma_mm)

    @property
    def scale_mm(self) -> float:
        """The loss's, where a pose is at its end."""
        return max(0.1, 3.0 * self.sigma_mm)

    def scored(self, pose: Refined) -> Scored:
        """With the mean of |f|, each up to the cap."""
        return float(np.minimum(np.abs(pose.residual_mm), self.cap_mm).mean()), pose

    def apart(self, one: Float[np.ndarray, "4 4"], other: Float[np.ndarray, "4 4"]) -> bool:
        """Whether two poses move the scan's box to different places."""
        return self._between_mm(one, other) > APART_RATIO * self.diagonal_mm

    def same(self, one: Float[np.ndarray, "4 4"], other: Float[np.ndarray, "4 4"]) -> bool:
        """Whether two poses are one minimum: no point of either is beyond the noise of the other's.

        Closer than `apart`: the two sides of a thin wall are two minima.
        """
        return self._between_mm(one, other) <= self.sigma_mm

    def _between_mm(self, one: Float[np.ndarray, "4 4"], other: Float[np.ndarray, "4 4"]) -> float:
        away = self.corners_mm @ (one - other)[:3, :3].T + (one - other)[:3, 3]
        return float(np.linalg.norm(away, axis=1).max())


Scored = tuple[float, Refined]


def by_score(one: Scored) -> float:
    """To sort by, best first."""
    return one[0]


def explained(pose: Refined, inlier_mm: float) -> float:
    """Share of the points that lie on the part."""
    return float((np.abs(pose.residual_mm) <= inlier_mm).mean())


def refined(
    starts: Sequence[Float[np.ndarray, "4 4"]],
    clouds: Clouds,
    template: Template,
    *,
    finish: bool = True,
    known: Sequence[Scored] = (),
) -> list[Scored]:
    """Scores and poses, best first: on few points, the best of them on all.

    Parameters
    ----------
    finish
        Whether they are judged on all points, and the best moved there.
    known
        Poses that they are held against, and that are not given again; best first.
    """
    first_mm = max(FIRST_RATIO * clouds.diagonal_mm, 3.0 * clouds.sigma_mm)
    found = _moved(starts, clouds, template, FIRST_POINTS, first_mm, FIRST_ITERATIONS)
    if not found:
        return []
    best_score = min(score for score, _ in (*known[:1], *found[:1]))
    limit = LEFT_FACTOR * best_score + SAME_FIT_MM
    begun = [pose.matrix for score, pose in found if score <= limit]
    found = _moved(begun, clouds, template, FEW_POINTS, clouds.scale_mm, FEW_ITERATIONS)
    if not finish or not found:
        return found
    limit = FEW_FACTOR * min(found[0][0], best_score) + SAME_FIT_MM
    kept: list[Scored] = []
    for score, pose in found:
        if score > limit:
            break
        if not any(clouds.same(pose.matrix, other.matrix) for _, other in (*known, *kept)):
            kept.append((score, pose))
    hopeful = [pose for score, pose in kept if score < PLAUSIBLE * clouds.cap_mm][:MOST_FINISHED]
    judged = [pose for _, pose in kept if not any(pose is one for one in hopeful)]
    ended = [
        clouds.scored(finished(pose, clouds, template, FEW_ITERATIONS if k else DENSE_ITERATIONS))
        for k, pose in enumerate(hopeful)
    ]
    return sorted(ended + on_all(judged, clouds, template), key=by_score)


def finished(pose: Refined, clouds: Clouds, template: Template, iterations: int) -> Refined:
    """A pose moved on all points."""
    return refine_all(
        clouds.dense_mm,
        template,
        [pose.matrix],
        start_scale_mm=clouds.scale_mm,
        end_scale_mm=clouds.scale_mm,
        sigma_mm=clouds.sigma_mm,
        max_iterations=iterations,
    )[0]


def on_all(poses: Sequence[Refined], clouds: Clouds, template: Template) -> list[Scored]:
    """Poses judged on all points, where they are."""
    found = []
    for pose in poses:
        placed = clouds.dense_mm @ pose.matrix[:3, :3].T + pose.matrix[:3, 3]
        found.append(
            clouds.scored(
                Refined(
                    pose.matrix,
                    pose.information * len(placed) / len(pose.residual_mm),
                    template.distance(placed),
                    pose.converged,
                    pose.iterations,
                )
            )
        )
    return found


def _moved(
    starts: Sequence[Float[np.ndarray, "4 4"]],
    clouds: Clouds,
    template: Template,
    points: int,
    start_scale_mm: float,
    max_iterations: int,
) -> list[Scored]:
    """Scores and poses, best first, moved on few points."""
    moved = refine_all(
        clouds.thinned.to(points),
        template,
        starts,
        start_scale_mm=start_scale_mm,
        end_scale_mm=clouds.scale_mm,
        sigma_mm=clouds.sigma_mm,
        max_iterations=max_iterations,
        enough_mm=ENOUGH_SIGMAS * clouds.sigma_mm,
    )
    return sorted((clouds.scored(pose) for pose in moved), key=by_score)
