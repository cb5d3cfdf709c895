"""Poses of one scan on its template: refined on few points, the best of them on all, and scored.

It is told where to start, and chooses nothing but what to leave.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.align.options import PoseOptions
from amrepair.align.refine import Refined, refine_all
from amrepair.align.thinning import Thinned
from amrepair.arrays import Matrix, Points, Values
from amrepair.frames import box_corners, diagonal, moved
from amrepair.template.port import Template


@dataclass(frozen=True, slots=True)
class Clouds:
    """A scan in several densities, and what its poses are judged by."""

    dense_mm: Points
    thinned: Thinned
    corners_mm: Float[np.ndarray, "8 3"]
    diagonal_mm: float
    sigma_mm: float
    options: PoseOptions

    @classmethod
    def of(
        cls,
        points_mm: Points,
        template: Template,
        sigma_mm: float,
        options: PoseOptions,
        rng: np.random.Generator,
    ) -> Clouds:
        """Of a scan's points; the diagonal is the template's."""
        dense = Thinned(points_mm, rng).to(options.dense_points)
        box = np.stack([dense.min(axis=0), dense.max(axis=0)])
        diagonal_mm = diagonal(template.bounds_mm)
        return cls(dense, Thinned(dense, rng), box_corners(box), diagonal_mm, sigma_mm, options)

    @property
    def size_mm(self) -> float:
        """Length of the scan, between the farthest corners of its box.

        In the frame of its main axes: a long thin scan that stands askew is no larger.
        """
        local = self.dense_mm - self.dense_mm.mean(axis=0)
        return float(np.linalg.norm(np.ptp(local @ np.linalg.eigh(local.T @ local)[1], axis=0)))

    @property
    def cap_mm(self) -> float:
        """Farther off is as bad."""
        return max(self.options.least_cap_mm, self.options.cap_sigmas * self.sigma_mm)

    @property
    def scale_mm(self) -> float:
        """The loss's, where a pose is at its end."""
        return self.options.scale_mm(self.sigma_mm)

    def scored(self, pose: Refined) -> Scored:
        """With the mean of |f|, each up to the cap."""
        return off_mm(pose.residual_mm, self.cap_mm), pose

    def apart(self, one: Matrix, other: Matrix) -> bool:
        """Whether two poses move the scan's box to different places."""
        return self._between_mm(one, other) > self.options.apart_ratio * self.diagonal_mm

    def same(self, one: Matrix, other: Matrix) -> bool:
        """Whether two poses are one minimum: no point of either is beyond the noise of the other's.

        Closer than `apart`: the two sides of a thin wall are two minima.
        """
        return self._between_mm(one, other) <= self.sigma_mm

    def _between_mm(self, one: Matrix, other: Matrix) -> float:
        away = self.corners_mm @ (one - other)[:3, :3].T + (one - other)[:3, 3]
        return float(np.linalg.norm(away, axis=1).max())


Scored = tuple[float, Refined]


def off_mm(residual_mm: Values, cap_mm: float) -> float:
    """The mean of |f|, each up to the cap: farther off is as bad."""
    return float(np.minimum(np.abs(residual_mm), cap_mm).mean())


def by_score(one: Scored) -> float:
    """To sort by, best first."""
    return one[0]


def explained(pose: Refined, inlier_mm: float) -> float:
    """Share of the points that lie on the part."""
    return float((np.abs(pose.residual_mm) <= inlier_mm).mean())


def refined(
    starts: Sequence[Matrix],
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
    options = clouds.options
    first_mm = max(options.first_ratio * clouds.diagonal_mm, options.scale_sigmas * clouds.sigma_mm)
    found = _moved(
        starts, clouds, template, options.first_points, first_mm, options.first_iterations
    )
    if not found:
        return []
    best_score = min(score for score, _ in (*known[:1], *found[:1]))
    limit = options.left_factor * best_score + options.same_fit_mm
    begun = [pose.matrix for score, pose in found if score <= limit]
    found = _moved(
        begun, clouds, template, options.few_points, clouds.scale_mm, options.few_iterations
    )
    if not finish or not found:
        return found
    limit = options.few_factor * min(found[0][0], best_score) + options.same_fit_mm
    kept: list[Scored] = []
    for score, pose in found:
        if score > limit:
            break
        if not any(clouds.same(pose.matrix, other.matrix) for _, other in (*known, *kept)):
            kept.append((score, pose))
    limit = options.plausible * clouds.cap_mm
    hopeful = [pose for score, pose in kept if score < limit][: options.most_finished]
    judged = [pose for _, pose in kept if not any(pose is one for one in hopeful)]
    most = options.few_iterations
    ended = [
        clouds.scored(finished(pose, clouds, template, most if k else options.dense_iterations))
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
        placed = moved(clouds.dense_mm, pose.matrix)
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
    starts: Sequence[Matrix],
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
        enough_mm=clouds.options.enough_sigmas * clouds.sigma_mm,
    )
    return sorted((clouds.scored(pose) for pose in moved), key=by_score)
