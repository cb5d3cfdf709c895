"""All poses of placed scans at once, point to plane, and how surely each is held.

One system of normal equations over the graph of overlaps: what slips against the rest as a group
(views from below, on each other) does not wait for its members one by one. It refines poses that
`groups` found; it does not find any.

How sure a pose is needs care in two places. A plane's normal is an estimate, and squares of its
noise look like knowledge of directions in which the faces tell nothing; the normals of the two
scans err independently, so their product does not (instrumental variables). And residuals beside
each other err alike: what they push at is summed over patches before it is squared, with a floor
for what all points of a patch may share.

What a sensor sees at a grazing angle it sees wrongly in one sense: the Stanford bunny's scanner
sees it up to 0.15 mm outside of where others see it head-on, which no number of points averages
out. So each side of a pair counts by the square of its cosine of incidence (an error across the
surface of 1/cos; the weights of Turk and Levoy, Zippered polygon meshes, SIGGRAPH 1994).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from amrepair.align.registration import bounded_inverse
from amrepair.arrays import Mask, Matrix, Points, Values, Vector
from amrepair.frames import cells_of, diagonal, motion_about, moved
from amrepair.merge.kept import KeptAnswers
from amrepair.merge.options import DEFAULT_MERGE, JointOptions
from amrepair.merge.threads import in_threads
from amrepair.merge.views import View, loss_weight

JOINT_DAMPING = 1e-7


@dataclass(frozen=True, slots=True)
class Slack:
    """What is open of one scan's pose, against the scan that is held best.

    Attributes
    ----------
    covariance
        (6, 6) of a small motion in the common frame: turn about `centre_mm` in radians times
        `size_mm`, then shift in mm. No motion is larger than what would be seen to contradict.
    sigma_mm
        The standard deviation across its own surface where that is largest.
    axis
        (3,) the unit vector along which the surface there may be off, common frame.
    """

    covariance: Float[np.ndarray, "6 6"]
    centre_mm: Vector
    size_mm: float
    sigma_mm: float
    axis: Vector

    def across(self, points_mm: Points, normals: Points) -> Values:
        """(n,) standard deviation along the normals, mm; common frame."""
        along = _jacobian(points_mm, normals, self.centre_mm, self.size_mm)
        squares = np.einsum("ni,ij,nj->n", along, self.covariance, along)
        return np.asarray(np.sqrt(np.maximum(squares, 0.0)))


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Points and the planes of other scans, common frame.

    Attributes
    ----------
    of, other
        (q,) whose point, whose plane.
    planes, own
        (q, 3) normals: of the other scan's plane, and of the point's own.
    height_mm
        (q,) over the plane.
    rough_mm
        (q,) the rougher of the two sides.
    confidence
        (q,) inverse variance of what the angles of incidence of the two sensors add, 1 head-on.
    """

    of: Int[np.ndarray, " q"]
    other: Int[np.ndarray, " q"]
    points_mm: Float[np.ndarray, "q 3"]
    planes: Float[np.ndarray, "q 3"]
    own: Float[np.ndarray, "q 3"]
    height_mm: Float[np.ndarray, " q"]
    rough_mm: Float[np.ndarray, " q"]
    confidence: Float[np.ndarray, " q"]


Answers = dict[tuple[int, int], KeptAnswers]


def together(
    views: Sequence[View],
    poses: Sequence[Matrix],
    rng: np.random.Generator,
    options: JointOptions = DEFAULT_MERGE.joint,
) -> tuple[list[Matrix], float]:
    """All poses but the first, refined jointly; and the residual's root mean square, mm."""
    found = [np.array(pose) for pose in poses]
    sample = _samples(views, options, rng)
    last_mm, spacing_mm = _scale_mm(views, options), max(view.spacing_mm for view in views)
    answers = _answers(views, sample, options)
    scale_mm = rmse_mm = 0.0
    for _ in range(options.rounds):
        pairs = _pairs(views, found, sample, answers, options)
        if len(pairs.of) < options.least_pairs:
            break
        if scale_mm == 0.0:
            median_mm = float(np.median(np.abs(pairs.height_mm)))
            scale_mm = max(
                last_mm, options.first_medians * median_mm, options.first_spacings * spacing_mm
            )
        weight = pairs.confidence * loss_weight(pairs.height_mm, scale_mm)
        rmse_mm = float(np.sqrt((weight * pairs.height_mm**2).sum() / weight.sum()))
        centre, size_mm = _frame(pairs)
        along = _jacobian(pairs.points_mm, pairs.planes, centre, size_mm)
        information, push = _equations(pairs, along, along, weight, len(found))
        free = information[6:, 6:] + JOINT_DAMPING * np.trace(information) / len(
            information
        ) * np.eye(len(information) - 6)
        step = -np.linalg.solve(free, push[6:]).reshape(-1, 6)
        for k, own in enumerate(step, 1):
            found[k] = motion_about(centre, own[:3] / size_mm, own[3:]) @ found[k]
        if float(np.abs(step).max()) < options.still_spacings * spacing_mm and scale_mm <= last_mm:
            break
        scale_mm = max(last_mm, options.shrink * scale_mm)
    return found, rmse_mm


def slacks(
    views: Sequence[View],
    poses: Sequence[Matrix],
    rng: np.random.Generator,
    options: JointOptions = DEFAULT_MERGE.joint,
) -> list[Slack]:
    """How surely each refined pose is held, against the scan against which most are held best."""
    count = len(views)
    sample = _samples(views, options, rng)
    pairs = _pairs(views, poses, sample, _answers(views, sample, options), options)
    weight = pairs.confidence * loss_weight(pairs.height_mm, _scale_mm(views, options))
    centre, size_mm = _frame(pairs)
    along = _jacobian(pairs.points_mm, pairs.planes, centre, size_mm)
    instrument = _jacobian(pairs.points_mm, pairs.own, centre, size_mm)
    information, _ = _equations(pairs, along, instrument, weight, count)
    scatter = _scatter(views, pairs, instrument, weight, options)
    open_ = [_open(information, scatter, home, options) for home in range(count)]
    best = min(open_, key=lambda blocks: float(np.median([np.trace(b) for b in blocks])))
    return [
        _slack(view, pose, block, centre, size_mm, options)
        for view, pose, block in zip(views, poses, best, strict=True)
    ]


def _reach_mm(view: View, other: View, options: JointOptions) -> float:
    """How far apart a point and the nearest one of its own surface may lie."""
    noise_mm = float(np.hypot(view.sigma_mm, other.sigma_mm))
    return options.within_spacings * other.spacing_mm + options.scale_noises * noise_mm


def _samples(
    views: Sequence[View], options: JointOptions, rng: np.random.Generator
) -> list[Int[np.ndarray, " _"]]:
    each = max(options.least_sampled, options.sampled // len(views))
    return [rng.permutation(len(p.surface.points_mm))[:each] for p in views]


def _scale_mm(views: Sequence[View], options: JointOptions) -> float:
    return max(
        max(options.scale_noises * v.sigma_mm, options.least_spacings * v.spacing_mm) for v in views
    )


def _frame(pairs: _Pairs) -> tuple[Vector, float]:
    """Where turns are about, and how long a radian is."""
    centre = pairs.points_mm.mean(axis=0)
    return centre, float(np.sqrt(((pairs.points_mm - centre) ** 2).sum(axis=1).mean()))


def _jacobian(
    points_mm: Float[np.ndarray, "q 3"],
    normals: Float[np.ndarray, "q 3"],
    centre_mm: Vector,
    size_mm: float,
) -> Float[np.ndarray, "q 6"]:
    return np.concatenate([np.cross(points_mm - centre_mm, normals) / size_mm, normals], axis=1)


def _answers(
    views: Sequence[View], sample: Sequence[Int[np.ndarray, " _"]], options: JointOptions
) -> Answers:
    """None yet, of each scan's sampled points by every other."""
    return {
        (k, r): KeptAnswers.of(other.surface.tree, _reach_mm(view, other, options), len(sample[k]))
        for k, view in enumerate(views)
        for r, other in enumerate(views)
        if r != k
    }


def _pairs(
    views: Sequence[View],
    poses: Sequence[Matrix],
    sample: Sequence[Int[np.ndarray, " _"]],
    answers: Answers,
    options: JointOptions,
) -> _Pairs:
    """Sampled points of each scan with the nearest planes of every other that face their way.

    A plane tells of what lies over it. Beyond the rim of a scan the surface curves away from its
    last planes, and every scan would be pushed outward.
    """
    own = [
        moved(view.surface.points_mm[some], pose)
        for view, some, pose in zip(views, sample, poses, strict=True)
    ]
    facing = [
        view.surface.normals[some] @ pose[:3, :3].T
        for view, some, pose in zip(views, sample, poses, strict=True)
    ]

    def pair(between: tuple[int, int]) -> tuple[np.ndarray, ...]:
        k, r = between
        view, other = views[k], views[r]
        local = moved(own[k], np.linalg.inv(poses[r]))
        near, index = answers[between].nearest(local)
        offset, normal = local[near] - other.surface.points_mm[index], other.surface.normals[index]
        height = (offset * normal).sum(axis=1)
        plane = normal @ poses[r][:3, :3].T
        cosine = (plane * facing[k][near]).sum(axis=1)
        signed = bool(view.looks.each and other.looks.each)
        agrees = (cosine if signed else np.abs(cosine)) > options.agrees
        beside2 = (offset**2).sum(axis=1) - height**2
        agrees &= beside2 <= (options.over_spacings * other.spacing_mm) ** 2
        near, index, plane, height = near[agrees], index[agrees], plane[agrees], height[agrees]
        turned = facing[k][near] * np.sign(cosine[agrees])[:, None]
        rough = np.maximum(view.rough_mm[sample[k]][near], other.rough_mm[index])
        confidence = view.confidence[sample[k]][near] * other.confidence[index]
        of = np.full(len(near), k)
        return of, np.full(len(near), r), own[k][near], plane, turned, height, rough, confidence

    # a thread a pair of scans, not a thread a piece of each query: queries are short
    found = in_threads(pair, answers)
    return _Pairs(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _equations(
    pairs: _Pairs,
    along: Float[np.ndarray, "q 6"],
    instrument: Float[np.ndarray, "q 6"],
    weight: Float[np.ndarray, " q"],
    count: int,
) -> tuple[Float[np.ndarray, "n n"], Values]:
    """Normal equations over all scans' motions, six for each."""
    information, push = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
    for k, r, which in _by_pair(pairs.of, pairs.other, count):
        weighted = instrument[which] * weight[which, None]
        block = weighted.T @ along[which]
        _add(information, k, r, 0.5 * (block + block.T))
        pushed = weighted.T @ pairs.height_mm[which]
        push[6 * k : 6 * k + 6] += pushed
        push[6 * r : 6 * r + 6] -= pushed
    return information, push


def _by_pair(
    first: Int[np.ndarray, " q"], second: Int[np.ndarray, " q"], count: int
) -> list[tuple[int, int, Int[np.ndarray, " _"]]]:
    key = first * count + second
    order = np.argsort(key, kind="stable")
    edges = np.flatnonzero(np.diff(key[order])) + 1
    groups = np.split(order, edges) if len(order) else []
    return [(int(first[g[0]]), int(second[g[0]]), g) for g in groups]


def _add(total: Float[np.ndarray, "n n"], k: int, r: int, block: Float[np.ndarray, "6 6"]) -> None:
    """Add what depends on the difference of two scans' motions; in place."""
    one, two = slice(6 * k, 6 * k + 6), slice(6 * r, 6 * r + 6)
    total[one, one] += block
    total[two, two] += block
    total[one, two] -= block
    total[two, one] -= block


def _scatter(
    views: Sequence[View],
    pairs: _Pairs,
    instrument: Float[np.ndarray, "q 6"],
    weight: Float[np.ndarray, " q"],
    options: JointOptions,
) -> Float[np.ndarray, "n n"]:
    """Covariance of what the residuals push at: by patches, with what a patch may share."""
    count = len(views)
    spacing = np.array([p.spacing_mm for p in views])
    sigma = np.array([p.sigma_mm for p in views])
    first, second = np.minimum(pairs.of, pairs.other), np.maximum(pairs.of, pairs.other)
    low = pairs.points_mm.min(axis=0)
    edge_mm = options.patch_ratio * diagonal(pairs.points_mm)
    axis = np.argmax(np.abs(pairs.planes), axis=1)
    side = np.take_along_axis(pairs.planes, axis[:, None], axis=1)[:, 0] > 0.0
    cell = cells_of(pairs.points_mm, low, edge_mm)
    key = np.column_stack([first, second, cell, 2 * axis + side])
    _, start, patch = np.unique(key, axis=0, return_index=True, return_inverse=True)
    shared_mm = np.hypot(
        pairs.rough_mm,
        options.shared_spacings * np.maximum(spacing[pairs.of], spacing[pairs.other]),
    )
    weighted = instrument * weight[:, None]
    pushed = _sums(
        weighted * (pairs.height_mm * np.where(first == pairs.of, 1, -1))[:, None], patch
    )
    shared = _sums(weighted * shared_mm[:, None], patch)
    noise = np.hypot(sigma[pairs.of], sigma[pairs.other])[:, None] * weighted
    total = np.zeros((6 * count, 6 * count))
    for k, r, which in _by_pair(first[start], second[start], count):
        _add(total, k, r, pushed[which].T @ pushed[which] + shared[which].T @ shared[which])
    for k, r, which in _by_pair(first, second, count):  # few patches cannot tell their own scatter
        _add(total, k, r, noise[which].T @ noise[which])
    return total


def _sums(
    values: Float[np.ndarray, "q 6"], patch: Int[np.ndarray, " q"]
) -> Float[np.ndarray, "p 6"]:
    return np.stack([np.bincount(patch.ravel(), weights=column) for column in values.T], axis=1)


def _open(
    information: Float[np.ndarray, "n n"],
    scatter: Float[np.ndarray, "n n"],
    home: int,
    options: JointOptions,
) -> list[Float[np.ndarray, "6 6"]]:
    """Each scan's covariance, with one of them held still."""
    count = len(information) // 6
    moving: Mask = np.arange(6 * count) // 6 != home
    inverse = bounded_inverse(information[np.ix_(moving, moving)], options.free_ratio)
    whole = np.zeros_like(information)
    whole[np.ix_(moving, moving)] = inverse @ scatter[np.ix_(moving, moving)] @ inverse
    return [whole[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(count)]


def _slack(
    view: View,
    pose: Matrix,
    covariance: Float[np.ndarray, "6 6"],
    centre_mm: Vector,
    size_mm: float,
    options: JointOptions,
) -> Slack:
    some = slice(None, None, len(view.surface.points_mm) // options.worst_held_points + 1)
    points = moved(view.surface.points_mm[some], pose)
    normals = view.surface.normals[some] @ pose[:3, :3].T
    most_mm = options.held_spacings * view.spacing_mm
    covariance = _bounded(covariance, most_mm)
    made = Slack(covariance, centre_mm, size_mm, 0.0, np.array([0.0, 0.0, 1.0]))
    sigma = made.across(points, normals)
    worst = int(np.argmax(sigma))
    # the motion of that place along which it is known least
    place = np.repeat(points[worst][None], 3, axis=0)
    shift = _jacobian(place, np.eye(3), centre_mm, size_mm)
    axis = np.linalg.eigh(shift @ covariance @ shift.T)[1][:, -1]
    axis = axis * np.sign(axis[int(np.argmax(np.abs(axis)))])
    return replace(made, sigma_mm=float(sigma[worst]), axis=axis)


def _bounded(covariance: Float[np.ndarray, "6 6"], most_mm: float) -> Float[np.ndarray, "6 6"]:
    """Each of its independent motions joined with the limit of how far any can go.

    A motion that nothing holds is a little of every motion: unbounded, it would loosen them all.
    """
    squares, ways = np.linalg.eigh(covariance)
    squares = np.maximum(squares, 0.0)
    return np.asarray((ways * (squares * most_mm**2 / (squares + most_mm**2))) @ ways.T)
