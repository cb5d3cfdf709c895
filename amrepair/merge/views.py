"""Views: scans with what they tell of themselves, and how well a pose of two of them agrees.

Noise and spacing are measured first; whatever is compared later is compared in units of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from amrepair.align.thinning import thin_out
from amrepair.arrays import Mask, Matrix, Numbers, Points, Values
from amrepair.errors import InputError
from amrepair.frames import diagonal, motion_about, moved
from amrepair.merge import sight
from amrepair.merge.cloud import outward, planes, spacing_of
from amrepair.merge.options import DEFAULT_MERGE, JudgeOptions, MergeOptions
from amrepair.merge.threads import in_threads
from amrepair.scans import Scan

STEP_DAMPING = 1e-6  # of the mean curvature of turns, and of shifts


@dataclass(frozen=True, slots=True)
class Surface:
    """Points with their normals, (n, 3) each, all to the side from which they were seen."""

    points_mm: Points
    normals: Points
    tree: cKDTree

    @classmethod
    def of(cls, points_mm: Points, normals: Points) -> Surface:
        """With a tree."""
        return cls(points_mm, normals, cKDTree(points_mm))

    def some(self, count: int) -> slice:
        """About so many of the points."""
        return slice(None, None, len(self.points_mm) // count + 1)


@dataclass(frozen=True, slots=True)
class View:
    """A scan as it is merged, in its own frame.

    Attributes
    ----------
    name
        For messages.
    surface
        All its points that lie on one surface: none at an edge of a range image.
    rough_mm
        (n,) how far the points around lie from the plane, beyond the noise.
    tilt_rad
        (n,) standard error of the normals.
    incidence
        (n,) cosine of the angle at which its sensor saw each point; NaN where nobody knows.
    thin
        Some of them, that poses are looked for with.
    spacing_mm, sigma_mm
        Of `surface`: measured.
    looks
        What its sensors saw through.
    clear
        Cosine of a normal to its sensor's ray, or it is not clear which way it faces.
    """

    name: str
    surface: Surface
    rough_mm: Values
    tilt_rad: Values
    incidence: Values
    thin: Surface
    spacing_mm: float
    thin_spacing_mm: float
    sigma_mm: float
    looks: sight.DepthImages
    clear: float

    @classmethod
    def of(
        cls, scan: Scan, rng: np.random.Generator, options: MergeOptions = DEFAULT_MERGE
    ) -> View:
        """Measure a scan.

        Raises
        ------
        InputError
            If too few of its points are different.
        """
        least, most = options.view.least_points, options.view.most_points
        chosen = np.arange(len(scan))
        if scan.edge is not None and int((scan.edge == 0).sum()) >= least:
            chosen = np.flatnonzero(scan.edge == 0)
        if len(chosen) > most:
            chosen = np.sort(rng.permutation(chosen)[:most])
        points, first = np.unique(scan.points_mm[chosen], axis=0, return_index=True)
        if len(points) < least:
            raise InputError(
                f"the scan {scan.source} has only {len(points)} different points among "
                f"{len(chosen)}; a template needs {least:,} of each scan: check the "
                "export"
            )
        sensors, index = scan.sensors_mm, scan.sensor_index
        if index is not None:
            index = index[chosen][first]
        looks = _looks(points, sensors, index, rng, options)
        spacing_mm = spacing_of(points)
        plane = planes(points, spacing_mm)
        normals, incidence = _facing(
            points, plane.normals, spacing_mm, plane.sigma_mm, sensors, index, looks
        )
        surface = Surface.of(points, normals)
        which = surface.tree.query(thin_out(points, options.view.thin_points, rng))[1]
        thin = Surface.of(points[which], normals[which])
        return cls(
            scan.source, surface, plane.rough_mm, plane.tilt_rad, incidence, thin, spacing_mm,
            spacing_of(thin.points_mm), plane.sigma_mm, looks, options.view.clear,
        )  # fmt: skip

    @property
    def size_mm(self) -> float:
        """Its diagonal."""
        return diagonal(self.thin.points_mm)

    @property
    def sure(self) -> Mask:
        """(n,) whether it is clear which way the normals face."""
        return np.asarray(self.incidence > self.clear)

    @property
    def confidence(self) -> Values:
        """(n,) inverse variance of what the angle of incidence adds; 1 head-on, or unknown.

        Below `clear` the cosine is the normal's noise.
        """
        return np.where(np.isnan(self.incidence), 1.0, np.maximum(self.incidence, self.clear) ** 2)


def _looks(
    points_mm: Points,
    sensors_mm: Float[np.ndarray, "k 3"] | None,
    sensor_index: Numbers | None,
    rng: np.random.Generator,
    options: MergeOptions,
) -> sight.DepthImages:
    few = rng.permutation(len(points_mm))[: options.view.image_points]
    image = np.ascontiguousarray(points_mm[few])
    if sensors_mm is not None and sensor_index is not None:
        return sight.told(image, sensors_mm, sensor_index[few], options.sight)
    towards = sight.guess_directions(
        thin_out(points_mm, options.view.guess_points, rng), options.sight
    )
    return sight.guessed(image, towards, options.sight) if len(towards) else sight.NOWHERE


def _facing(
    points_mm: Points,
    normals: Points,
    spacing_mm: float,
    sigma_mm: float,
    sensors_mm: Float[np.ndarray, "k 3"] | None,
    sensor_index: Numbers | None,
    looks: sight.DepthImages,
) -> tuple[Points, Values]:
    """Normals to the sensor that saw each point, else to where more of the distance is in sight.

    And the cosines of the angles of incidence.
    """
    if sensors_mm is not None and sensor_index is not None:
        rays = sensors_mm[sensor_index] - points_mm
    elif len(looks.each):
        rays = looks.sensors_mm.mean(axis=0) - points_mm
    else:
        return outward(points_mm, normals, spacing_mm, sigma_mm), np.full(len(points_mm), np.nan)
    along = (normals * rays).sum(axis=1) / np.linalg.norm(rays, axis=1)
    return normals * np.where(along < 0.0, -1.0, 1.0)[:, None], np.abs(along)


@dataclass(frozen=True, slots=True)
class Fit:
    """A pose of views on others, and what speaks for and against it.

    Attributes
    ----------
    pose
        (4, 4) the others' frame from theirs.
    overlap
        Share of the smaller side that lies on the other.
    against
        The largest share of any view that contradicts the other side: lies off its surface, or
        before what its sensors saw.
    beside
        The same, with what lies beside all that the other's sensors saw: free space, but where a
        scan was cropped.
    guessed
        Where a sensor stood was guessed.
    sighted
        Sensors' places tell of free space; else overlap alone, and what lies above and below it.
    """

    pose: Matrix
    overlap: float
    against: float
    beside: float
    guessed: bool
    sighted: bool = True

    @property
    def score(self) -> float:
        """What speaks for it, less what speaks against it."""
        return self.overlap - 4.0 * self.against - (self.beside - self.against)

    def why_not(self, options: MergeOptions) -> str:
        """Why it is not to be trusted, as a predicate; nothing where it is."""
        least = options.overlap(guessed=self.guessed)
        most = options.against(guessed=self.guessed)
        if self.overlap < least:
            return f"lies on the others with {self.overlap:.0%} of it, {least:.0%} is needed"
        worst = self.against
        if self.beside > options.cropped_share * self.overlap:
            worst = max(worst, self.beside)
        if worst > most:
            return (
                f"contradicts the others wherever it is laid ({worst:.1%} of its or their surface "
                f"at best, {most:.0%} is allowed)"
            )
        return ""

    def rivals(self, other: Fit, options: MergeOptions) -> bool:
        """Whether another pose may be the true one: that more overlaps proves nothing."""
        least = options.overlap(guessed=self.guessed) if self.sighted else self.overlap
        enough = other.overlap >= options.rival_share * least
        extra = options.rival_against * (2.0 if self.guessed else 1.0)
        return (
            enough and other.against <= self.against + extra and other.beside <= self.beside + extra
        )


Placed = dict[int, Matrix]


def joined(views: Sequence[View], poses: Placed, each: int) -> Surface:
    """Thinned points and normals of placed views in one frame, about so many of each."""
    points, normals = [], []
    for k, pose in poses.items():
        some = views[k].thin.some(each)
        points.append(moved(views[k].thin.points_mm[some], pose))
        normals.append(views[k].thin.normals[some] @ pose[:3, :3].T)
    return Surface.of(np.concatenate(points), np.concatenate(normals))


def settled(
    fixed: Surface,
    moving: Surface,
    pose: Matrix,
    within_mm: Float[np.ndarray, " steps"],
    count: int,
    options: JudgeOptions,
) -> Matrix:
    """The pose after some steps point to plane, each with pairs no farther apart than it says."""
    some = moving.some(count)
    found = pose
    for reach_mm in within_mm:
        points = moved(moving.points_mm[some], found)
        distance, index = fixed.tree.query(points, distance_upper_bound=reach_mm)
        near = np.isfinite(distance)
        index = index[near]
        normals = moving.normals[some][near] @ found[:3, :3].T
        facing = (normals * fixed.normals[index]).sum(axis=1) > options.paired
        if facing.sum() < options.least_pairs:
            return found
        here, normal = points[near][facing], fixed.normals[index[facing]]
        height = ((here - fixed.points_mm[index[facing]]) * normal).sum(axis=1)
        found = _step(here, normal, height, max(options.loss_reach * reach_mm, 1e-9)) @ found
    return found


def loss_weight(height_mm: Float[np.ndarray, " q"], scale_mm: float) -> Float[np.ndarray, " q"]:
    """(q,) weight of each residual under the Geman–McClure loss."""
    return np.asarray((scale_mm**2 / (height_mm**2 + scale_mm**2)) ** 2)


def _step(
    points_mm: Float[np.ndarray, "q 3"],
    normals: Float[np.ndarray, "q 3"],
    height_mm: Float[np.ndarray, " q"],
    scale_mm: float,
) -> Matrix:
    """The (4, 4) motion of one Gauss–Newton step that brings points onto planes."""
    weight = loss_weight(height_mm, scale_mm)
    centre = points_mm.mean(axis=0)
    jacobian = np.concatenate([np.cross(points_mm - centre, normals), normals], axis=1)
    weighted = jacobian * weight[:, None]
    matrix = weighted.T @ jacobian
    matrix += STEP_DAMPING * np.diag(np.diag(matrix).reshape(2, 3).mean(axis=1).repeat(3))
    step = -np.linalg.solve(matrix, weighted.T @ height_mm)
    return motion_about(centre, step[:3], step[3:])


def judged(
    views: Sequence[View], fixed: Placed, moving: Placed, pose: Matrix, options: MergeOptions
) -> Fit:
    """How well one group of placed views, in a pose, agrees with what the other saw."""
    there = {k: pose @ own for k, own in moving.items()}
    every = {**fixed, **there}
    everything = joined(views, every, options.judge.points)

    def marks(between: tuple[int, int]) -> Int[np.ndarray, "3 _"]:
        a, b = between
        veil = sight.Veil(everything.points_mm, everything.normals, every[b])
        pose = np.linalg.inv(every[b]) @ every[a]
        return _marks(views[b], views[a], pose, veil, options).astype(np.int64)

    between = [pair for k in there for m in fixed for pair in ((k, m), (m, k))]
    votes: dict[int, Int[np.ndarray, "3 _"]] = {}
    for (a, _), found in zip(between, in_threads(marks, between), strict=True):
        votes[a] = votes[a] + found if a in votes else found
    sides = [float(np.concatenate([votes[k][0] > 0 for k in s]).mean()) for s in (fixed, moving)]
    guessed = any(views[k].looks.guessed for k in votes)
    # what as many views have there as have it elsewhere is no contradiction of this pose
    against, beside = (max(float((v[row] > v[0]).mean()) for v in votes.values()) for row in (1, 2))
    sighted = all(views[k].looks.each for k in votes)
    return Fit(pose, max(sides), against, beside, guessed, sighted)


def _marks(
    view: View, other: View, pose: Matrix, veil: sight.Veil, options: MergeOptions
) -> Bool[np.ndarray, "3 k"]:
    """Which of another view's points lie on a view's surface, contradict it, or do by its rim."""
    spacing_mm = max(view.thin_spacing_mm, other.thin_spacing_mm)
    noise_mm = max(view.sigma_mm, other.sigma_mm)
    off_mm = options.off_spacings * spacing_mm + options.off_noises * noise_mm
    free_mm = options.free_spacings * spacing_mm + options.off_noises * noise_mm
    reach_mm = options.reach_spacings * spacing_mm + options.off_noises * noise_mm
    some = other.thin.some(options.judge.points)
    points = moved(other.thin.points_mm[some], pose)
    normals = other.thin.normals[some] @ pose[:3, :3].T
    sighted = bool(view.looks.each)
    distance, index = view.thin.tree.query(
        points, distance_upper_bound=reach_mm if sighted else np.inf
    )
    near = distance < reach_mm
    index = np.where(np.isfinite(distance), index, 0)
    near &= (normals * view.thin.normals[index]).sum(axis=1) > options.judge.agrees
    height = ((points - view.thin.points_mm[index]) * view.thin.normals[index]).sum(axis=1)
    on = near & (np.abs(height) <= min(off_mm, free_mm))
    # beside an edge, the nearest surface is the step's other level
    over = distance**2 - height**2 <= (options.judge.over_spacings * spacing_mm) ** 2
    off = near & over & (np.abs(height) > off_mm)
    if not sighted:  # a point over the middle of a surface is not beside it, however far
        off |= (distance > reach_mm) & (np.abs(height) > options.judge.above * distance)
    beside = view.looks.free(points, free_mm, normals, veil) & ~on
    asked = np.flatnonzero(beside)
    through = np.zeros(len(points), bool)
    # where a sensor may have stood, all looks have lifted the veil from these places already
    lifted = None if view.looks.guessed else veil
    through[asked] = view.looks.free(
        points[asked], free_mm, normals[asked], lifted, silhouette=False
    )
    return np.stack([on, off | through, off | beside])
