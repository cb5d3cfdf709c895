"""The pose of a scan of which nothing is known: search, refine on the field, and what fits as well.

Every rotation is tried on a coarse field (`search`); what is left is refined on the template
itself. Where that leaves points unexplained, clutter is looked for and left out, and features are
asked as well. All poses that fit alike are returned: the caller must not guess.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.align.clutter import noise_across, without_clutter
from amrepair.align.coarse import by_features, cube_rotations
from amrepair.align.families import CLEAR_MM, CLEAR_SIGMAS, best_turns, slides
from amrepair.align.refine import Refined, refine
from amrepair.align.search import QUICK, THOROUGH, CoarseField, Effort, search
from amrepair.align.thinning import in_order, thin_out
from amrepair.frames import rotation_from_vector
from amrepair.template.port import Template
from gcode.progress import Progress, silent

DENSE_POINTS, FEW_POINTS = 15_000, 2_000
FEATURE_POINTS = 30_000  # of the template's surface
# The coarse field rounds edges: a right pose may look worse than a wrong one by this factor.
COARSE_FACTOR, MOST_REFINED, MOST_DOUBTFUL, MOST_TWINS = 1.8, 40, 5, 10
GOOD_CELLS = 0.2  # what the coarse field is off by, at most, on a scan that fits
FEW_FACTOR, FEW_ITERATIONS, DENSE_ITERATIONS, MOST_FINISHED = 1.5, 30, 120, 3
# After so many iterations scores change little: a pose worse than the best by this factor is left
# as it is. On few points nothing is gained by steps below this share of the noise.
FIRST_ITERATIONS, LEFT_FACTOR, ENOUGH_SIGMAS = 10, 1.6, 0.05
# Another pose fits as well if its score is of the best one's size, and no more than a few points
# lie on the part in the best pose and clearly off it in the other. Clearly: beyond the noise, and
# beyond what prints of one part differ by.
SAME_FIT, SAME_FIT_MM = 1.5, 0.005
CONTRADICTED_RATIO, CONTRADICTED_SIGMAS = 0.003, 4.0
APART_RATIO = 0.02  # poses that move the part less than this share of its size are the same
NOISE_FLOOR_MM = 0.02  # process and columns: points agree no better than this
INLIER_MM = 0.3  # a real print lies this near to its template nearly everywhere
INLIER_SIGMAS = 3.0
# Fewer explained, and the noise is measured (taken where it is more than was said, up to what a
# thin wall's two sides could pretend), and the mirror image tried.
DOUBTFUL, NOISIER, MOST_NOISE_MM = 0.93, 1.5, 0.25
# With fewer points on the part the search goes on, is made thorough, and features are asked too.
WELL_EXPLAINED, MOSTLY_EXPLAINED, EXPLAINED = 0.97, 0.95, 0.7
BETWEEN = rotation_from_vector(np.array([0.15, -0.1, 0.08]))  # half the gap between rotations
FEW_TRIED = 3  # poses refined of what is left without clutter, and of the mirror image
CLEARED = 0.85  # with fewer on the part clutter is looked for, until so many are
LEAST_HALF = 100  # points; of fewer a half says nothing
PLAUSIBLE = 0.6  # a mean distance above this share of the cap is no fit that more points would mend


@dataclass(frozen=True, slots=True)
class Found:
    """The best pose, and the others that fit as well.

    Attributes
    ----------
    others
        (4, 4) template from scan, best first.
    explained_ratio
        Share of the points that lie on the part in the best pose, clutter left aside.
    part_mm
        (n, 3) what may be the part: the scan, or a sample of it without clutter.
    left_out_ratio
        Share of the points that was taken for clutter.
    sigma_mm, inlier_mm
        How well points were taken to agree with the template, and how near explained ones lie.
    field
        The template's, that was searched; None where nothing was.
    """

    best: Refined
    others: tuple[Float[np.ndarray, "4 4"], ...]
    explained_ratio: float
    part_mm: Float[np.ndarray, "n 3"]
    left_out_ratio: float
    sigma_mm: float
    inlier_mm: float
    field: CoarseField | None = None


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

    @property
    def scale_mm(self) -> float:
        """The loss's, where a pose is at its end."""
        return max(0.1, 3.0 * self.sigma_mm)

    def score(self, residual_mm: Float[np.ndarray, " k"]) -> float:
        """Mean of |f|, each up to the cap."""
        return float(np.minimum(np.abs(residual_mm), self.cap_mm).mean())

    def apart(self, one: Float[np.ndarray, "4 4"], other: Float[np.ndarray, "4 4"]) -> bool:
        """Whether two poses move the scan's box to different places."""
        away = self.corners_mm @ (one - other)[:3, :3].T + (one - other)[:3, 3]
        return bool(np.linalg.norm(away, axis=1).max() > APART_RATIO * self.diagonal_mm)


def limits_mm(noise_mm: float) -> tuple[float, float]:
    """How well points can agree with the template, and how near explained ones lie."""
    sigma_mm = float(np.hypot(max(noise_mm, 1e-3), NOISE_FLOOR_MM))
    return sigma_mm, max(INLIER_MM, INLIER_SIGMAS * sigma_mm)


def pose_from_anywhere(
    points_mm: Float[np.ndarray, "n 3"],
    template: Template,
    *,
    sigma_mm: float,
    rng: np.random.Generator,
    noise_is_measured: bool = False,
    progress: Progress = silent,
) -> Found:
    """The best pose and those that fit as well; it may still be a bad one.

    Parameters
    ----------
    points_mm
        (n, 3) in the scan's frame.
    sigma_mm
        Noise of the points, as was said; measured where that leaves them unexplained.
    """
    sigma_mm, inlier_mm = limits_mm(sigma_mm)
    scan = _clouds(points_mm, template, sigma_mm, rng)
    clouds, part_mm, left_out_ratio = scan, points_mm, 0.0
    field = CoarseField.of(template)
    progress("align", 0.1, 1.0)
    found = _refined(_worth_refining(clouds, field, QUICK, rng), clouds, template)
    if _explained(found[0][1], inlier_mm) < DOUBTFUL and not noise_is_measured:
        measured_mm = min(noise_across(points_mm, rng), MOST_NOISE_MM)
        if measured_mm > NOISIER * sigma_mm:
            return pose_from_anywhere(
                points_mm,
                template,
                sigma_mm=measured_mm,
                rng=rng,
                noise_is_measured=True,
                progress=progress,
            )
    if _explained(found[0][1], inlier_mm) < CLEARED:
        progress("align", 0.2, 1.0)
        for kept in without_clutter(points_mm, rng):
            fewer = _clouds(kept.points_mm, template, sigma_mm, rng)
            starts = _worth_refining(fewer, field, QUICK, rng)[:FEW_TRIED]
            again = _refined(starts, fewer, template)
            if _explained(again[0][1], inlier_mm) > _explained(found[0][1], inlier_mm):
                clouds, found, left_out_ratio = fewer, again, kept.left_out_ratio
                part_mm = kept.points_mm
            if _explained(found[0][1], inlier_mm) > CLEARED:
                break
    share = _explained(found[0][1], inlier_mm)
    if share < WELL_EXPLAINED:
        progress("align", 0.4, 1.0)
        starts = _twins(found[0][1], clouds, field, rng)
        if share < MOSTLY_EXPLAINED:
            starts += _by_halves(found[0][1], clouds, field, rng)
            starts += _worth_refining(clouds, field, THOROUGH, rng)
        else:
            starts += _worth_refining(clouds, field, QUICK, rng, turn=BETWEEN)
        more = _refined(starts, clouds, template, known=found[0][0])
        found = sorted(found + more, key=_by_score)
    if _explained(found[0][1], inlier_mm) < EXPLAINED:
        progress("align", 0.6, 1.0)
        surface = template.surface_points(np.sqrt(clouds.diagonal_mm**2 / FEATURE_POINTS))[0]
        extra = tuple(by_features(clouds.dense_mm, surface, clouds.diagonal_mm))
        if extra:
            starts = [pose.matrix for pose in search(clouds.dense_mm, field, rng, only=extra)]
            more = _refined(starts, clouds, template, known=found[0][0])
            found = sorted(found + more, key=_by_score)
    if left_out_ratio > 0.0:
        whole = _refined([pose.matrix for _, pose in found[:FEW_TRIED]], scan, template)
        if _explained(whole[0][1], inlier_mm) > CLEARED:
            # what was left out lies on the part as well: it was no clutter
            clouds, found, left_out_ratio, part_mm = scan, whole, 0.0, points_mm
    progress("align", 0.8, 1.0)
    if _explained(found[0][1], inlier_mm) > EXPLAINED:
        found = _with_twins(found, clouds, field, template, rng)
        laid = found[0][1].matrix
        starts = _turns(found, clouds, field, template, rng)
        more = _refined(starts, clouds, template, known=found[0][0])
        found = sorted(found + more, key=_by_score)
        if clouds.apart(found[0][1].matrix, laid):
            found = _with_twins(found, clouds, field, template, rng)
    progress("align", 0.9, 1.0)
    best_score, best = found[0]
    if not best.converged and best_score < PLAUSIBLE * clouds.cap_mm:
        best = _finished(best, clouds, template, DENSE_ITERATIONS)
    beside = slides(best, clouds.dense_mm, 1.5 * APART_RATIO * clouds.diagonal_mm)
    slid = _refined(beside, clouds, template, finish=False)
    slid = [(score, _finished(moved, clouds, template, 0)) for score, moved in slid]
    others: list[Float[np.ndarray, "4 4"]] = []
    for score, other in sorted(found[1:] + slid, key=_by_score):
        if score > SAME_FIT * best_score + SAME_FIT_MM:
            break
        new = all(clouds.apart(other.matrix, known) for known in (best.matrix, *others))
        if new and not _contradicted(other, best, sigma_mm):
            others.append(other.matrix)
    # not of the thinned cloud: few scattered points fill as many voxels as many on the surface
    sample = part_mm[rng.permutation(len(part_mm))[:DENSE_POINTS]]
    residual = template.distance(sample @ best.matrix[:3, :3].T + best.matrix[:3, 3])
    ratio = float((np.abs(residual) <= inlier_mm).mean())
    return Found(best, tuple(others), ratio, part_mm, left_out_ratio, sigma_mm, inlier_mm, field)


def explained_if_mirrored(
    points_mm: Float[np.ndarray, "n 3"], found: Found, template: Template, rng: np.random.Generator
) -> float:
    """Share of the points that lie on the part where they are mirrored first."""
    clouds = _clouds(points_mm * np.array([-1.0, 1.0, 1.0]), template, found.sigma_mm, rng)
    field = found.field if found.field is not None else CoarseField.of(template)
    starts = _worth_refining(clouds, field, QUICK, rng)
    return _explained(_refined(starts[:FEW_TRIED], clouds, template)[0][1], found.inlier_mm)


def _clouds(
    points_mm: Float[np.ndarray, "n 3"],
    template: Template,
    sigma_mm: float,
    rng: np.random.Generator,
) -> _Clouds:
    dense = in_order(thin_out(points_mm, DENSE_POINTS, rng))
    low, high = dense.min(axis=0), dense.max(axis=0)
    pick = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
    return _Clouds(
        dense,
        in_order(thin_out(dense, FEW_POINTS, rng)),
        np.where(pick == 0, low, high),
        float(np.linalg.norm(np.ptp(template.bounds_mm, axis=0))),
        sigma_mm,
    )


def _worth_refining(
    clouds: _Clouds,
    field: CoarseField,
    effort: Effort,
    rng: np.random.Generator,
    *,
    turn: Float[np.ndarray, "3 3"] | None = None,
) -> list[Float[np.ndarray, "4 4"]]:
    poses = search(clouds.dense_mm, field, rng, effort=effort, turn=turn)
    limit_mm = COARSE_FACTOR * poses[0].score_mm + 0.05 * field.cell_mm
    fits = poses[0].score_mm <= 3.0 * clouds.sigma_mm + GOOD_CELLS * field.cell_mm
    most = MOST_REFINED if fits else MOST_DOUBTFUL
    return [pose.matrix for pose in poses[:most] if pose.score_mm <= limit_mm]


def _twins(
    best: Refined, clouds: _Clouds, field: CoarseField, rng: np.random.Generator
) -> list[Float[np.ndarray, "4 4"]]:
    """The pose turned in its template as a box can be, and laid on the box's other sides.

    A nearly symmetric part's other poses; a view of one side fits the other one from within, too.
    """
    middle = field.box_mm.mean(axis=0)
    centre = clouds.dense_mm.mean(axis=0)
    place = best.matrix[:3, :3] @ centre + best.matrix[:3, 3] - middle
    turned = []
    for turn in cube_rotations():
        for sides in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.eye(4)
            matrix[:3, :3] = turn @ best.matrix[:3, :3]
            matrix[:3, 3] = middle + np.array(sides) * (turn @ place) - matrix[:3, :3] @ centre
            turned.append(matrix)
    poses = search(clouds.dense_mm, field, rng, only=tuple(turned))
    limit_mm = COARSE_FACTOR * poses[0].score_mm + 0.05 * field.cell_mm
    return [pose.matrix for pose in poses[:MOST_TWINS] if pose.score_mm <= limit_mm]


def _by_halves(
    best: Refined, clouds: _Clouds, field: CoarseField, rng: np.random.Generator
) -> list[Float[np.ndarray, "4 4"]]:
    """The pose as each half of the scan alone would have it.

    A bent part may be laid between its pieces, where neither lies well; one half is of one piece.
    On the coarse field, since between the two sides of a thin wall the exact one has a trap.
    """
    local = clouds.dense_mm - clouds.dense_mm.mean(axis=0)
    axes = np.linalg.eigh(local.T @ local)[1]
    halves = [clouds.dense_mm[way * (local @ axes[:, k]) > 0] for k in (2, 1) for way in (1, -1)]
    return [
        search(half, field, rng, only=(best.matrix,))[0].matrix
        for half in halves
        if len(half) >= LEAST_HALF
    ]


def _with_twins(
    found: list[tuple[float, Refined]],
    clouds: _Clouds,
    field: CoarseField,
    template: Template,
    rng: np.random.Generator,
) -> list[tuple[float, Refined]]:
    """The poses found, and the best one's twins."""
    best = found[0][1]
    twins = [m for m in _twins(best, clouds, field, rng) if clouds.apart(m, best.matrix)]
    more = _refined(twins, clouds, template, known=found[0][0])
    return sorted(found + more, key=_by_score)


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
    known: float = np.inf,
) -> list[tuple[float, Refined]]:
    """Scores and poses, best first: on few points, the best of them on all.

    `known` is the score of a pose that they are held against.
    """
    first_mm = max(0.005 * clouds.diagonal_mm, 3.0 * clouds.sigma_mm)
    found = _on_few(starts, clouds, template, first_mm, FIRST_ITERATIONS)
    if found:
        limit = LEFT_FACTOR * min(found[0][0], known) + SAME_FIT_MM
        begun = [(s, p) for s, p in found if s <= limit and not p.converged]
        ended = [(s, p) for s, p in found if s > limit or p.converged]
        again = [pose.matrix for _, pose in begun]
        found = ended + _on_few(again, clouds, template, clouds.scale_mm, FEW_ITERATIONS)
    found.sort(key=_by_score)
    if not finish or not found:
        return found
    limit = FEW_FACTOR * min(found[0][0], known) + SAME_FIT_MM
    finished: list[tuple[float, Refined]] = []
    for score, rough in found:
        if score > limit:
            break
        iterations = 0
        if len(finished) < MOST_FINISHED and score < PLAUSIBLE * clouds.cap_mm:
            iterations = DENSE_ITERATIONS if not finished else FEW_ITERATIONS
        moved = _finished(rough, clouds, template, iterations)
        finished.append((clouds.score(moved.residual_mm), moved))
    return sorted(finished, key=_by_score)


def _on_few(
    starts: list[Float[np.ndarray, "4 4"]],
    clouds: _Clouds,
    template: Template,
    start_scale_mm: float,
    max_iterations: int,
) -> list[tuple[float, Refined]]:
    """Scores and poses, best first, moved on few points."""
    found = []
    for matrix in starts:
        moved = refine(
            clouds.few_mm,
            template,
            matrix,
            start_scale_mm=start_scale_mm,
            end_scale_mm=clouds.scale_mm,
            sigma_mm=clouds.sigma_mm,
            max_iterations=max_iterations,
            enough_mm=ENOUGH_SIGMAS * clouds.sigma_mm,
        )
        found.append((clouds.score(moved.residual_mm), moved))
    return sorted(found, key=_by_score)


def _finished(rough: Refined, clouds: _Clouds, template: Template, iterations: int) -> Refined:
    """A pose on all points: moved, or only judged there."""
    if iterations:
        return refine(
            clouds.dense_mm,
            template,
            rough.matrix,
            start_scale_mm=clouds.scale_mm,
            end_scale_mm=clouds.scale_mm,
            sigma_mm=clouds.sigma_mm,
            max_iterations=iterations,
        )
    placed = clouds.dense_mm @ rough.matrix[:3, :3].T + rough.matrix[:3, 3]
    return Refined(
        rough.matrix,
        rough.information * len(clouds.dense_mm) / len(rough.residual_mm),
        template.distance(placed),
        rough.converged,
        rough.iterations,
    )


def _turns(
    found: list[tuple[float, Refined]],
    clouds: _Clouds,
    field: CoarseField,
    template: Template,
    rng: np.random.Generator,
) -> list[Float[np.ndarray, "4 4"]]:
    """Starts where poses like the best can turn freely, or nearly."""
    limit = SAME_FIT * found[0][0] + SAME_FIT_MM
    return best_turns(
        [pose for score, pose in found if score <= limit],
        clouds.dense_mm,
        template,
        field,
        diagonal_mm=clouds.diagonal_mm,
        sigma_mm=clouds.sigma_mm,
        cap_mm=clouds.cap_mm,
        rng=rng,
    )


def _contradicted(other: Refined, best: Refined, sigma_mm: float) -> bool:
    """Whether points that the best pose explains speak against the other, and few the other way."""
    limit_mm = max(CLEAR_MM, CLEAR_SIGMAS * sigma_mm)
    off, off_best = np.abs(other.residual_mm) > limit_mm, np.abs(best.residual_mm) > limit_mm
    against, for_it = int((off & ~off_best).sum()), int((off_best & ~off).sum())
    chance = CONTRADICTED_SIGMAS * float(np.sqrt(against + for_it))
    return against - for_it > max(CONTRADICTED_RATIO * len(off), chance)
