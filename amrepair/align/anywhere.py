"""The pose of a scan of which nothing is known: search, refine on the field, and what fits as well.

Every rotation is tried on a coarse field (`search`); what is left is refined on the template
itself. Where that leaves points unexplained, features are asked as well (clutter moves the box
that the search starts from). All poses that fit alike are returned: the caller must not guess.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.align.coarse import by_features
from amrepair.align.refine import Refined, refine
from amrepair.align.search import QUICK, THOROUGH, CoarseField, Effort, search
from amrepair.align.thinning import thin_out
from amrepair.frames import rotation_from_vector
from amrepair.template.port import Template
from gcode.progress import Progress, silent

DENSE_POINTS, FEW_POINTS = 15_000, 2_000
FEATURE_POINTS = 30_000  # of the template's surface
# The coarse field rounds edges: a right pose may look worse than a wrong one by this factor.
COARSE_FACTOR, MOST_REFINED, MOST_DOUBTFUL = 1.8, 40, 5
GOOD_CELLS = 0.2  # what the coarse field is off by, at most, on a scan that fits
FEW_FACTOR, FEW_ITERATIONS, DENSE_ITERATIONS, MOST_FINISHED = 1.5, 30, 120, 3
# Another pose fits as well if its score is of the best one's size, and no more than a few points
# lie on the part in the best pose and clearly off it in the other. Clearly: beyond the noise, and
# beyond what prints of one part differ by.
SAME_FIT, SAME_FIT_MM = 1.5, 0.005
CLEAR_SIGMAS, CLEAR_MM = 4.0, 0.1
CONTRADICTED_RATIO, CONTRADICTED_SIGMAS = 0.003, 4.0
APART_RATIO = 0.02  # poses that move the part less than this share of its size are the same
# With fewer points on the part the search is made thorough; then features are asked too.
WELL_EXPLAINED, EXPLAINED = 0.97, 0.7
PLAUSIBLE = 0.6  # a mean distance above this share of the cap is no fit that more points would mend


@dataclass(frozen=True, slots=True)
class Found:
    """The best pose, and the others that fit as well.

    Attributes
    ----------
    others
        (4, 4) template from scan, best first.
    """

    best: Refined
    others: tuple[Float[np.ndarray, "4 4"], ...]


@dataclass(frozen=True, slots=True)
class _Clouds:
    """A scan in two densities, and what its poses are judged by."""

    dense_mm: Float[np.ndarray, "n 3"]
    few_mm: Float[np.ndarray, "m 3"]
    corners_mm: Float[np.ndarray, "8 3"]
    diagonal_mm: float
    sigma_mm: float

    @property
    def cap_mm(self) -> float:
        """Farther off is as bad: ten times the noise, or a millimetre."""
        return max(1.0, 10.0 * self.sigma_mm)

    def score(self, residual_mm: Float[np.ndarray, " k"]) -> float:
        """Mean of |f|, each up to the cap."""
        return float(np.minimum(np.abs(residual_mm), self.cap_mm).mean())

    def apart(self, one: Float[np.ndarray, "4 4"], other: Float[np.ndarray, "4 4"]) -> bool:
        """Whether two poses move the scan's box to different places."""
        away = self.corners_mm @ (one - other)[:3, :3].T + (one - other)[:3, 3]
        return bool(np.linalg.norm(away, axis=1).max() > APART_RATIO * self.diagonal_mm)


def pose_from_anywhere(
    points_mm: Float[np.ndarray, "n 3"],
    template: Template,
    *,
    sigma_mm: float,
    inlier_mm: float,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Found:
    """The best pose and those that fit as well; it may still be a bad one.

    Parameters
    ----------
    points_mm
        (n, 3) in the scan's frame.
    sigma_mm
        How well points can agree with the template at best.
    inlier_mm
        Points nearer than this to the surface are explained.
    """
    clouds = _clouds(points_mm, template, sigma_mm, rng)
    field = CoarseField.of(template)
    progress("align", 0.1, 1.0)
    found = _refined(_worth_refining(clouds, field, QUICK, rng), clouds, template)
    if _explained(found[0][1], inlier_mm) < WELL_EXPLAINED:
        progress("align", 0.3, 1.0)
        starts = _worth_refining(clouds, field, THOROUGH, rng)
        found = sorted(found + _refined(starts, clouds, template), key=_by_score)
    if _explained(found[0][1], inlier_mm) < EXPLAINED:
        progress("align", 0.6, 1.0)
        surface = template.surface_points(np.sqrt(clouds.diagonal_mm**2 / FEATURE_POINTS))[0]
        extra = tuple(by_features(clouds.dense_mm, surface, clouds.diagonal_mm))
        if extra:
            starts = [pose.matrix for pose in search(clouds.dense_mm, field, rng, only=extra)]
            found = sorted(found + _refined(starts, clouds, template), key=_by_score)
    progress("align", 0.9, 1.0)
    best_score, best = found[0]
    if not best.converged and best_score < PLAUSIBLE * clouds.cap_mm:
        best = _finished(best, clouds, template, True)
    slid = _refined(_slides(best, clouds), clouds, template, finish=False)
    slid = [(score, _finished(moved, clouds, template, False)) for score, moved in slid]
    others: list[Float[np.ndarray, "4 4"]] = []
    for score, other in sorted(found[1:] + slid, key=_by_score):
        if score > SAME_FIT * best_score + SAME_FIT_MM:
            break
        new = all(clouds.apart(other.matrix, known) for known in (best.matrix, *others))
        if new and not _contradicted(other, best, sigma_mm):
            others.append(other.matrix)
    return Found(best, tuple(others))


def _clouds(
    points_mm: Float[np.ndarray, "n 3"],
    template: Template,
    sigma_mm: float,
    rng: np.random.Generator,
) -> _Clouds:
    dense = thin_out(points_mm, DENSE_POINTS, rng)
    low, high = dense.min(axis=0), dense.max(axis=0)
    pick = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
    return _Clouds(
        dense,
        thin_out(dense, FEW_POINTS, rng),
        np.where(pick == 0, low, high),
        float(np.linalg.norm(np.ptp(template.bounds_mm, axis=0))),
        sigma_mm,
    )


def _worth_refining(
    clouds: _Clouds,
    field: CoarseField,
    effort: Effort,
    rng: np.random.Generator,
) -> list[Float[np.ndarray, "4 4"]]:
    poses = search(clouds.dense_mm, field, rng, effort=effort)
    limit_mm = COARSE_FACTOR * poses[0].score_mm + 0.05 * field.cell_mm
    fits = poses[0].score_mm <= 3.0 * clouds.sigma_mm + GOOD_CELLS * field.cell_mm
    most = MOST_REFINED if fits else MOST_DOUBTFUL
    return [pose.matrix for pose in poses[:most] if pose.score_mm <= limit_mm]


def _by_score(one: tuple[float, Refined]) -> float:
    return one[0]


def _explained(refined: Refined, inlier_mm: float) -> float:
    return float((np.abs(refined.residual_mm) <= inlier_mm).mean())


def _refined(
    starts: list[Float[np.ndarray, "4 4"]],
    clouds: _Clouds,
    template: Template,
    *,
    finish: bool = True,
) -> list[tuple[float, Refined]]:
    """Scores and poses, best first: on few points, the best of them on all."""
    found = []
    for matrix in starts:
        moved = refine(
            clouds.few_mm,
            template,
            matrix,
            start_scale_mm=max(0.005 * clouds.diagonal_mm, 3.0 * clouds.sigma_mm),
            end_scale_mm=max(0.1, 3.0 * clouds.sigma_mm),
            sigma_mm=clouds.sigma_mm,
            max_iterations=FEW_ITERATIONS,
        )
        found.append((clouds.score(moved.residual_mm), moved))
    found.sort(key=_by_score)
    if not finish or not found:
        return found
    limit = FEW_FACTOR * found[0][0] + SAME_FIT_MM
    finished: list[tuple[float, Refined]] = []
    for score, rough in found:
        if score > limit:
            break
        worth = len(finished) < MOST_FINISHED and score < PLAUSIBLE * clouds.cap_mm
        moved = _finished(rough, clouds, template, worth)
        finished.append((clouds.score(moved.residual_mm), moved))
    return sorted(finished, key=_by_score)


def _finished(rough: Refined, clouds: _Clouds, template: Template, move: bool) -> Refined:
    """A pose on all points: moved, or only judged there."""
    scale_mm = max(0.1, 3.0 * clouds.sigma_mm)
    if move:
        return refine(
            clouds.dense_mm,
            template,
            rough.matrix,
            start_scale_mm=scale_mm,
            end_scale_mm=scale_mm,
            sigma_mm=clouds.sigma_mm,
            max_iterations=DENSE_ITERATIONS,
        )
    placed = clouds.dense_mm @ rough.matrix[:3, :3].T + rough.matrix[:3, 3]
    return Refined(
        rough.matrix,
        rough.information,
        template.distance(placed),
        rough.converged,
        rough.iterations,
    )


def _contradicted(other: Refined, best: Refined, sigma_mm: float) -> bool:
    """Whether points that the best pose explains speak against the other, and few the other way."""
    limit_mm = max(CLEAR_MM, CLEAR_SIGMAS * sigma_mm)
    off, off_best = np.abs(other.residual_mm) > limit_mm, np.abs(best.residual_mm) > limit_mm
    against, for_it = int((off & ~off_best).sum()), int((off_best & ~off).sum())
    chance = CONTRADICTED_SIGMAS * float(np.sqrt(against + for_it))
    return against - for_it > max(CONTRADICTED_RATIO * len(off), chance)


def _slides(best: Refined, clouds: _Clouds) -> list[Float[np.ndarray, "4 4"]]:
    """Poses beside the best, along whatever motion the scan hardly hinders (a turned cylinder)."""
    centre = clouds.dense_mm.mean(axis=0)
    local = (clouds.dense_mm - centre) @ best.matrix[:3, :3].T
    reach_mm = float(np.linalg.norm(local, axis=1).max())
    place = best.matrix[:3, :3] @ centre + best.matrix[:3, 3]
    # rotations in units of the motion of the farthest point
    unit = np.array([1.0 / reach_mm] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(best.information * np.outer(unit, unit))
    step_mm = 1.5 * APART_RATIO * clouds.diagonal_mm
    found = []
    for value, vector in zip(values, vectors.T, strict=True):
        # Σ f² / σ² after a step, by the quadratic model
        if value * step_mm**2 > len(clouds.dense_mm):
            break
        for way in (1.0, -1.0):
            motion = way * step_mm * unit * vector
            moved = np.eye(4)
            moved[:3, :3] = rotation_from_vector(motion[:3]) @ best.matrix[:3, :3]
            moved[:3, 3] = place + motion[3:] - moved[:3, :3] @ centre
            found.append(moved)
    return found
