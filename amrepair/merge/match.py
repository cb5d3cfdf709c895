"""Poses of two views that may be: by features, and where they tell nothing by every rotation.

Features (KISS-Matcher, H. Lim et al., ICRA 2025) need surface that both views saw, and curves.
Sight needs neither: each rotation is moved to where the least of either view lies in the other's
free space and surface that faces one way comes together. Both propose; `groups` decides.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from amrepair.align.coarse import by_features, poses_between
from amrepair.align.options import SearchRound
from amrepair.align.search import spread_rotations
from amrepair.align.search_kernels import peaks
from amrepair.arrays import Matrix, Vector
from amrepair.frames import grid_points, moved, nearest_rotation, rigid
from amrepair.merge import search_kernels as kernels
from amrepair.merge.options import MatchOptions, MergeOptions
from amrepair.merge.threads import in_threads
from amrepair.merge.views import Fit, Surface, View, judged, settled

# The grid of free space: nodes along each side, and its side in sizes. A view in a wrong place
# does not leave it.
CELLS, SIDE = 72, 2.4
APART_POINTS = 60  # of a view, that tell two poses apart


MATCH_ROUNDS = (  # points are of each view, scales in sizes of the part
    SearchRound(150, 8, 0.15, 0.05, 400),
    SearchRound(300, 8, 0.05, 0.02, 120),
    SearchRound(800, 6, 0.02, 0.01, 20),
)


@dataclass(frozen=True, slots=True)
class FreeSpace:
    """A grid about a view: cells to free space, negative where none is known to be free; flat."""

    centre_mm: Vector
    cell_mm: float
    field: Float[np.ndarray, " cells"]

    @classmethod
    def of(cls, view: View, size_mm: float) -> FreeSpace:
        """For parts of that size."""
        thin = view.thin.points_mm
        centre, cell_mm = 0.5 * (thin.min(axis=0) + thin.max(axis=0)), SIDE * size_mm / CELLS
        axis = (np.arange(CELLS) - 0.5 * (CELLS - 1)) * cell_mm
        nodes = grid_points(axis, axis, axis)
        free = view.looks.free(nodes + centre, 0.5 * cell_mm).reshape(CELLS, CELLS, CELLS)
        field = ndimage.distance_transform_edt(free) - ndimage.distance_transform_edt(~free)
        at = ((thin - centre) / cell_mm + 0.5 * (CELLS - 1)).T
        field = field - np.median(ndimage.map_coordinates(field, at, order=1))
        return cls(centre, cell_mm, np.ascontiguousarray(field.ravel(), dtype=np.float32))


def featured(
    views: Sequence[View], i: int, j: int, size_mm: float, options: MergeOptions
) -> list[Fit]:
    """Poses of view j in view i's frame that features propose (of whole scans their boxes too)."""
    source, target = views[j].surface.points_mm, views[i].surface.points_mm
    if not views[i].looks.each and not views[j].looks.each:
        guesses = list(poses_between(source, target, size_mm))
        return _fitted(views, i, j, guesses, options.match.features_within, size_mm, options)
    found: list[Fit] = []
    for guess in by_features(source, target, size_mm):
        found += _fitted(views, i, j, [guess], options.match.features_within, size_mm, options)
        if any(f.overlap >= options.match.sure_overlap and not f.why_not(options) for f in found):
            break  # finer features said so: coarser ones say no more
    return distinct(found, views[j].thin, options.same_size * size_mm)


def searched(
    views: Sequence[View],
    spaces: dict[int, FreeSpace],
    i: int,
    j: int,
    size_mm: float,
    options: MergeOptions,
) -> list[Fit]:
    """Poses of view j in view i's frame, of all rotations; none of a scan that is no view."""
    if not (views[i].looks.each and views[j].looks.each):
        return []
    for k in (i, j):
        if k not in spaces:
            spaces[k] = FreeSpace.of(views[k], size_mm)
    guesses = _search(views[i], views[j], spaces[i], spaces[j], size_mm, options.match)
    return _fitted(views, i, j, guesses, options.match.search_within, size_mm, options)


def _fitted(
    views: Sequence[View],
    i: int,
    j: int,
    guesses: Iterable[Matrix],
    first: float,
    size_mm: float,
    options: MergeOptions,
) -> list[Fit]:
    """Guesses settled on few points, and of those that end apart the best on many; judged."""
    fixed, moving = views[i].thin, views[j].thin
    match = options.match
    within = np.geomspace(first, match.last_within, 6) * size_mm

    def roughly(guess: Matrix) -> tuple[float, Matrix]:
        pose = settled(fixed, moving, guess, within, match.rough_points, options.judge)
        some = moving.some(match.rough_points)
        near = fixed.tree.query(moved(moving.points_mm[some], pose))[0]
        return float((near < match.last_within * size_mm).mean()), pose

    rough = in_threads(roughly, guesses)
    last_mm = options.reach_spacings * max(views[i].thin_spacing_mm, views[j].thin_spacing_mm)
    finer = np.geomspace(max(match.last_within * size_mm, last_mm), last_mm, 12)
    poses = apart([p for _, p in sorted(rough, key=lambda r: -r[0])], moving,
                  options.same_size * size_mm)[:match.most_poses]  # fmt: skip
    poses = in_threads(
        lambda p: settled(fixed, moving, p, finer, match.points, options.judge), poses
    )
    fits = [judged(views, {i: np.eye(4)}, {j: np.eye(4)}, pose, options) for pose in poses]
    return distinct(fits, moving, options.same_size * size_mm)


def apart(poses: Sequence[Matrix], surface: Surface, apart_mm: float) -> list[Matrix]:
    """The poses in their order, without those that move the surface to where one before does."""
    places = surface.points_mm[surface.some(APART_POINTS)]
    kept: list[Matrix] = []
    for pose in poses:
        here = moved(places, pose)
        if all(np.abs(moved(places, other) - here).max() > apart_mm for other in kept):
            kept.append(pose)
    return kept


def distinct(fits: Sequence[Fit], surface: Surface, apart_mm: float) -> list[Fit]:
    """The fits by score; of those that move the surface to one place, the best."""
    ranked = sorted(fits, key=lambda fit: -fit.score)
    kept = apart([fit.pose for fit in ranked], surface, apart_mm)
    return [fit for fit in ranked if any(fit.pose is pose for pose in kept)]


def _search(
    first: View,
    second: View,
    space: FreeSpace,
    other: FreeSpace,
    size_mm: float,
    options: MatchOptions,
) -> list[Matrix]:
    """Every rotation, moved out of free space; best first."""
    rng = np.random.default_rng(0)
    cell_mm = space.cell_mm
    rotations = spread_rotations(options.rotations)
    places = np.zeros((len(rotations), 3))
    guessed = first.looks.guessed or second.looks.guessed
    free_counts = options.free_counts_guessed if guessed else options.free_counts
    size = size_mm / cell_mm
    for step in MATCH_ROUNDS:
        own = _sample(first, space, step.points, rng)
        others = _sample(second, other, step.points, rng)
        scores = kernels.reconcile(
            kernels.Pair(*own, *others, space.field, other.field, CELLS), rotations, places,
            step.scales(size), options.cap * size, 0.5 * size,
        )  # fmt: skip
        order = np.argsort(free_counts * scores[:, 0] - scores[:, 1], kind="stable")
        chosen = peaks(order, rotations, places, 0.4 * size, 0.01 * size, step.keep)
        rotations = np.ascontiguousarray(rotations[chosen])
        places = np.ascontiguousarray(places[chosen])
    found = []
    for rotation, place in zip(rotations, places, strict=True):
        turn = nearest_rotation(rotation)
        found.append(rigid(turn, space.centre_mm + cell_mm * place - turn @ other.centre_mm))
    return found


def _sample(
    view: View, space: FreeSpace, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    chosen = rng.permutation(len(view.thin.points_mm))[:count]
    local = (view.thin.points_mm[chosen] - space.centre_mm) / space.cell_mm
    return np.ascontiguousarray(local), np.ascontiguousarray(view.thin.normals[chosen])
