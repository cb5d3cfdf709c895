"""The pose of a scan of which nothing is known: search, refine on the field, and what fits as well.

Every rotation is tried on a coarse field (`search`); what is left is refined on the template
itself. Where that leaves points unexplained, clutter is looked for and left out, and features are
asked as well. All poses that fit alike are returned: the caller must not guess.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.align.clutter import Kept, noise_across, without_clutter
from amrepair.align.coarse import by_features, cube_rotations
from amrepair.align.families import best_turns, slides
from amrepair.align.options import AlignOptions, Effort
from amrepair.align.poses import (
    Clouds,
    Scored,
    by_score,
    explained,
    finished,
    on_all,
    refined,
)
from amrepair.align.refine import Refined
from amrepair.align.search import CoarseField, search
from amrepair.align.thinning import Thinned
from amrepair.arrays import Matrix, Points
from amrepair.frames import moved, rigid, rotation_from_vector
from amrepair.template.port import Template
from gcode.progress import Progress, silent

HALF_GAP = rotation_from_vector(np.array([0.15, -0.1, 0.08]))  # half the gap between rotations


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
    outside_ratio
        Share of the points that stand out of the part, clutter left aside. What is missing does
        not: its floor lies inside.
    is_piece
        Whether the part is taken to be one of several pieces of the scan, that which fits best.
    sigma_mm, inlier_mm
        How well points were taken to agree with the template, and how near explained ones lie.
    field
        The template's, that was searched; None where nothing was.
    """

    best: Refined
    others: tuple[Matrix, ...]
    explained_ratio: float
    part_mm: Points
    left_out_ratio: float
    sigma_mm: float
    inlier_mm: float
    outside_ratio: float = 0.0
    is_piece: bool = False
    field: CoarseField | None = None


@dataclass(slots=True)
class _Hunt:
    """What is known so far of one scan's poses.

    Attributes
    ----------
    kept
        What is taken for the part: all of the scan, or what is left of it without clutter.
    found
        Best first.
    twinned
        Poses whose twins have been asked for.
    """

    options: AlignOptions
    template: Template
    field: CoarseField
    clouds: Clouds
    kept: Kept
    sigma_mm: float
    inlier_mm: float
    found: list[Scored] = dataclasses.field(default_factory=list)
    twinned: list[Matrix] = dataclasses.field(default_factory=list)

    @property
    def best(self) -> Refined:
        """The best pose so far."""
        return self.found[0][1]

    @property
    def share(self) -> float:
        """Of the points, on the part in the best pose."""
        return explained(self.best, self.inlier_mm)

    def take(self, starts: Sequence[Matrix]) -> None:
        """Refine from more starts."""
        more = refined(starts, self.clouds, self.template, known=self.found)
        self.found = sorted(self.found + more, key=by_score)

    def twins(self) -> list[Matrix]:
        """Of the best pose, once."""
        if any(not self.clouds.apart(self.best.matrix, known) for known in self.twinned):
            return []
        self.twinned.append(self.best.matrix)
        return [
            matrix
            for matrix in _twins(self.best, self.clouds, self.field)
            if self.clouds.apart(matrix, self.best.matrix)
        ]


def pose_from_anywhere(
    points_mm: Points,
    template: Template,
    *,
    sigma_mm: float,
    options: AlignOptions,
    rng: np.random.Generator,
    least_ratio: float,
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
    least_ratio
        Of the points that must lie on the part: where fewer do, features are asked as well.
    """
    told, coarse = options.explained, options.coarse
    sigma_mm, inlier_mm = told.limits_mm(sigma_mm, template.bias_mm)
    clouds = Clouds.of(points_mm, template, sigma_mm, options.poses, rng)
    field = CoarseField.of(template, coarse)
    hunt = _Hunt(options, template, field, clouds, Kept(points_mm, 0.0), sigma_mm, inlier_mm)
    progress("align", 0.1, 1.0)
    hunt.take(_worth_refining(clouds, field, coarse.quick))
    if hunt.share < told.doubtful and not noise_is_measured:
        measured_mm = _measured_mm(points_mm, clouds, options, rng)
        if measured_mm > told.noisier * sigma_mm:
            return pose_from_anywhere(
                points_mm,
                template,
                sigma_mm=measured_mm,
                options=options,
                rng=rng,
                least_ratio=least_ratio,
                noise_is_measured=True,
                progress=progress,
            )
    was_thorough = hunt.share < told.cleared
    if was_thorough:
        progress("align", 0.2, 1.0)
        # A part that was laid wrong may look like clutter: more rotations of it are tried first.
        hunt.take(_worth_refining(clouds, field, coarse.thorough))
    of_all = hunt.found
    if hunt.share < told.cleared:
        progress("align", 0.3, 1.0)
        _leave_clutter(hunt, points_mm, rng)
    if hunt.share < told.well:
        progress("align", 0.4, 1.0)
        _search_on(hunt, thorough=not (was_thorough and hunt.clouds is clouds))
    if clouds.size_mm < coarse.piece_ratio * clouds.diagonal_mm:
        progress("align", 0.5, 1.0)
        hunt.take(_worth_refining(hunt.clouds, field, coarse.piece))
        if hunt.share < told.well:
            hunt.take(_worth_refining(hunt.clouds, field, coarse.piece_again, turn=HALF_GAP))
    if hunt.share < least_ratio:
        progress("align", 0.6, 1.0)
        _ask_features(hunt)
    if hunt.kept.left_out_ratio > 0.0:
        _ask_the_whole(hunt, clouds, of_all, points_mm, least_ratio)
    progress("align", 0.8, 1.0)
    if hunt.share > told.explained:
        hunt.take(hunt.twins())
        hunt.take(_turns(hunt, rng))
        hunt.take(hunt.twins())
    progress("align", 0.9, 1.0)
    return _answer(hunt, rng)


def _measured_mm(
    points_mm: Points, clouds: Clouds, options: AlignOptions, rng: np.random.Generator
) -> float:
    """Noise across the surface, up to what can be believed."""
    told = options.explained
    most_mm = max(told.most_noise_mm, told.most_noise_ratio * clouds.diagonal_mm)
    return min(noise_across(points_mm, rng, options.clutter), most_mm)


def _ask_the_whole(
    hunt: _Hunt, clouds: Clouds, of_all: list[Scored], points_mm: Points, least_ratio: float
) -> None:
    """Take all points back in where what was left out fits the part as well: it was no clutter."""
    told = hunt.options.explained
    starts = [pose.matrix for _, pose in hunt.found[: told.few_tried]]
    whole = sorted(refined(starts, clouds, hunt.template) + of_all, key=by_score)
    share = explained(whole[0][1], hunt.inlier_mm)
    without = hunt.best.matrix
    off_mm = hunt.template.distance(moved(clouds.dense_mm, without))
    clearer = float((np.abs(off_mm) <= hunt.inlier_mm).mean()) + told.clearer_by
    if share > told.cleared or share > max(least_ratio, clearer):
        hunt.clouds, hunt.found, hunt.kept = clouds, whole, Kept(points_mm, 0.0)


def _answer(hunt: _Hunt, rng: np.random.Generator) -> Found:
    """What was found, with the share of the points that it explains."""
    (best, others), kept = _best_and_others(hunt), hunt.kept
    # The thinned cloud will not do: few scattered points fill as many voxels as many on a surface.
    some = rng.permutation(len(kept.points_mm))[: hunt.options.poses.dense_points]
    sample = kept.points_mm[some]
    residual = hunt.template.distance(moved(sample, best.matrix))
    ratio = float((np.abs(residual) <= hunt.inlier_mm).mean())
    return Found(
        best, others, ratio, kept.points_mm, kept.left_out_ratio, hunt.sigma_mm, hunt.inlier_mm,
        float((residual > hunt.inlier_mm).mean()), kept.is_piece, hunt.field,
    )  # fmt: skip


def _leave_clutter(hunt: _Hunt, points_mm: Points, rng: np.random.Generator) -> None:
    """Search again without what may be clutter; kept where more of the rest lies on the part."""
    options = hunt.options
    for kept in without_clutter(points_mm, rng, options.clutter):
        fewer = Clouds.of(kept.points_mm, hunt.template, hunt.sigma_mm, options.poses, rng)
        starts = _worth_refining(fewer, hunt.field, options.coarse.quick)
        starts = starts[: options.explained.few_tried]
        again = refined(starts, fewer, hunt.template)
        if explained(again[0][1], hunt.inlier_mm) > hunt.share:
            hunt.clouds, hunt.found, hunt.kept = fewer, again, kept
        if hunt.share > options.explained.cleared:
            break


def _search_on(hunt: _Hunt, *, thorough: bool) -> None:
    """Search between the rotations that were tried, or among more of them unless that was done."""
    starts, coarse = hunt.twins(), hunt.options.coarse
    if hunt.share < hunt.options.explained.mostly:
        starts += _by_halves(hunt)
        if thorough:
            starts += _worth_refining(hunt.clouds, hunt.field, coarse.thorough)
    else:
        starts += _worth_refining(hunt.clouds, hunt.field, coarse.quick, turn=HALF_GAP)
    hunt.take(starts)


def _ask_features(hunt: _Hunt) -> None:
    clouds = hunt.clouds
    count = hunt.options.explained.feature_points
    surface = hunt.template.surface_points(np.sqrt(clouds.diagonal_mm**2 / count))[0]
    extra = tuple(by_features(clouds.dense_mm, surface, clouds.diagonal_mm))
    if extra:
        hunt.take([pose.matrix for pose in search(clouds.thinned, hunt.field, only=extra)])


def _best_and_others(hunt: _Hunt) -> tuple[Refined, tuple[Matrix, ...]]:
    """The best pose at its end, and those apart from it that fit as well."""
    clouds, template, options = hunt.clouds, hunt.template, hunt.options.poses
    best_score, best = hunt.found[0]
    if not best.converged and best_score < options.plausible * clouds.cap_mm:
        best = finished(best, clouds, template, options.dense_iterations)
    beside = slides(best, clouds.dense_mm, 1.5 * options.apart_ratio * clouds.diagonal_mm)
    slid = [pose for _, pose in refined(beside, clouds, template, finish=False)]
    others: list[Matrix] = []
    for score, other in sorted(hunt.found[1:] + on_all(slid, clouds, template), key=by_score):
        if score > hunt.options.explained.as_good * best_score + options.same_fit_mm:
            break
        new = all(clouds.apart(other.matrix, known) for known in (best.matrix, *others))
        if new and not _contradicted(other, best, hunt):
            others.append(other.matrix)
    return best, tuple(others)


def explained_if_mirrored(
    points_mm: Points,
    found: Found,
    template: Template,
    options: AlignOptions,
    rng: np.random.Generator,
) -> float:
    """Share of the points that lie on the part where they are mirrored first."""
    mirrored_mm = points_mm * np.array([-1.0, 1.0, 1.0])
    clouds = Clouds.of(mirrored_mm, template, found.sigma_mm, options.poses, rng)
    field = found.field if found.field is not None else CoarseField.of(template, options.coarse)
    starts = _worth_refining(clouds, field, options.coarse.quick)[: options.explained.few_tried]
    return explained(refined(starts, clouds, template)[0][1], found.inlier_mm)


def _worth_refining(
    clouds: Clouds,
    field: CoarseField,
    effort: Effort,
    *,
    turn: Float[np.ndarray, "3 3"] | None = None,
) -> list[Matrix]:
    poses = search(clouds.thinned, field, effort=effort, turn=turn)
    options = field.options
    limit_mm = options.worse * poses[0].score_mm + options.off_cells * field.cell_mm
    fits = poses[0].score_mm <= 3.0 * clouds.sigma_mm + options.fits_cells * field.cell_mm
    most = options.most_refined if fits else options.most_doubtful
    return [pose.matrix for pose in poses[:most] if pose.score_mm <= limit_mm]


def _twins(best: Refined, clouds: Clouds, field: CoarseField) -> list[Matrix]:
    """The pose turned in its template as a box can be, and laid on the box's other sides.

    A nearly symmetric part's other poses; a view of one side fits the other one from within, too.
    """
    options = field.options
    middle = field.box_mm.mean(axis=0)
    centre = clouds.dense_mm.mean(axis=0)
    place = best.matrix[:3, :3] @ centre + best.matrix[:3, 3] - middle
    turned = []
    for turn in cube_rotations():
        for sides in itertools.product((1.0, -1.0), repeat=3):
            rotation = turn @ best.matrix[:3, :3]
            shift = middle + np.array(sides) * (turn @ place) - rotation @ centre
            turned.append(rigid(rotation, shift))
    poses = search(clouds.thinned, field, effort=options.twins, only=tuple(turned))
    limit_mm = options.worse * poses[0].score_mm + options.off_cells * field.cell_mm
    return [pose.matrix for pose in poses[: options.most_twins] if pose.score_mm <= limit_mm]


def _by_halves(hunt: _Hunt) -> list[Matrix]:
    """The pose as each half of the scan alone would have it.

    A bent part may be laid between its pieces, where neither lies well; one half is of one piece.
    On the coarse field, since between the two sides of a thin wall the exact one has a trap.
    """
    options, thinned = hunt.options.explained, hunt.clouds.thinned
    points = thinned.to(options.half_points)
    local = points - points.mean(axis=0)
    axes = np.linalg.eigh(local.T @ local)[1]
    halves = [points[way * (local @ axes[:, k]) > 0] for k in (2, 1) for way in (1, -1)]
    return [
        search(Thinned(half, thinned.rng), hunt.field, only=(hunt.best.matrix,))[0].matrix
        for half in halves
        if len(half) >= options.least_half
    ]


def _turns(hunt: _Hunt, rng: np.random.Generator) -> list[Matrix]:
    """Starts where poses like the best can turn freely, or nearly."""
    options, clouds = hunt.options, hunt.clouds
    limit = options.explained.as_good * hunt.found[0][0] + options.poses.same_fit_mm
    return best_turns(
        [pose for score, pose in hunt.found if score <= limit],
        clouds.dense_mm,
        hunt.template,
        hunt.field,
        diagonal_mm=clouds.diagonal_mm,
        sigma_mm=clouds.sigma_mm,
        cap_mm=clouds.cap_mm,
        off_mm=options.explained.clearly_off_mm(clouds.sigma_mm),
        options=options.families,
        rng=rng,
    )


def _contradicted(other: Refined, best: Refined, hunt: _Hunt) -> bool:
    """Whether points that the best pose explains speak against the other, and few the other way."""
    options = hunt.options.explained
    limit_mm = options.clearly_off_mm(hunt.sigma_mm)
    off, off_best = np.abs(other.residual_mm) > limit_mm, np.abs(best.residual_mm) > limit_mm
    against, for_it = int((off & ~off_best).sum()), int((off_best & ~off).sum())
    chance = options.against_sigmas * float(np.sqrt(against + for_it))
    return against - for_it > max(options.against_ratio * len(off), chance)
