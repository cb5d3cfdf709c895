"""Partial views onto each other: neither may stand where the other's sensor saw through.

Features need surface that both views saw; sight needs none. Every rotation is tried, a few steps
bring each to where the least of either view lies in the other's free space and surface that faces
one way comes together. It proposes poses of two views and scores them; `assemble` decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from amrepair.align.search import spread_rotations
from amrepair.align.search_kernels import peaks
from amrepair.align.thinning import thin_out
from amrepair.consensus import looks as sight
from amrepair.consensus import views_kernels as kernels
from amrepair.consensus.cloud import planes, spacing_of
from amrepair.frames import motion_about, moved

POINTS, IMAGE_POINTS, GUESS_POINTS = 15_000, 40_000, 8_000
# The grid of free space: nodes along each side, and its side in diagonals of the largest view. A
# view in a wrong place does not leave it.
CELLS, SIDE = 72, 2.4
# Of 48 single views of eight parts the side that more of the surface is open to was right in all;
# in two by less than 0.1.
SURE_SIDE = 0.3
# Of all directions: a flat underside is seen alike from nearly everywhere (0.17 to 0.34), and was
# laid on the flange above it, which has the same outline, with nothing against it; other views
# had 0.002 to 0.15.
WIDEST_GUESS = 0.16
CLEAR = 0.2  # cosine of a normal to a sensor's ray
ROTATIONS = 3_600  # about 16° apart


class VagueError(Exception):
    """A view that tells too little of where its sensor stood; why, as a predicate."""


@dataclass(frozen=True, slots=True)
class Round:
    """Of the search: points of each view, steps, scales in diagonals, poses kept."""

    points: int
    steps: int
    first: float
    last: float
    keep: int


ROUNDS = (
    Round(150, 8, 0.15, 0.05, 400),
    Round(300, 8, 0.05, 0.02, 120),
    Round(800, 6, 0.02, 0.01, 20),
)
CAP = 0.1  # diagonals: as bad as farther in free space
# Times what agrees. More, and views that hide behind each other and share nothing come first.
FREE_COUNTS, FREE_COUNTS_GUESSED = 1.5, 0.75
SAME_POSE = 0.02  # diagonals: poses that end nearer than this are one
# Point to plane after the search: pairs within so many diagonals, at first and at last.
FIRST_WITHIN, LAST_WITHIN = 0.03, 0.012
ROUGH_POINTS, FINE_POINTS, FINE_POSES = 800, 3_000, 6
PAIRED, AGREES = 0.5, 0.8  # cosine between normals
LEAST_PAIRS = 30
REACH_SPACINGS, FREE_SPACINGS = 3.0, 1.5
# Surface that lies beside the other's, both facing one way, is off it where it is farther than so
# many spacings (chance and curves) or sigmas.
OFF_SPACINGS, OFF_SIGMAS = 0.25, 6.0
# Over or under a surface is where it has a point within so many spacings; chance leaves such a
# place without one in exp(-pi) = 4 %.
OVER_SPACINGS = 1.0
AGAINST_COUNTS = 4.0


@dataclass(frozen=True, slots=True)
class Surface:
    """Points with their normals, (n, 3) each, all to the side from which they were seen."""

    points_mm: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    tree: cKDTree

    @classmethod
    def of(cls, points_mm: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Surface:
        """With a tree."""
        return cls(points_mm, normals, cKDTree(points_mm))

    def some(self, count: int) -> slice:
        """About so many of the points."""
        return slice(None, None, len(self.points_mm) // count + 1)


@dataclass(frozen=True, slots=True)
class View:
    """A scan as it is held against others, in its own frame.

    Attributes
    ----------
    number
        Of the scan. A scan of which it is not known from which side it was seen has two views.
    surface
        Thinned.
    doubt
        0 where the side is known, up to 1 where the part's shape speaks for the other.
    looks
        What its sensors saw through.
    centre_mm, cell_mm, field
        A grid about the points: cells to free space, negative where none of it is known to be
        free; flat, in cells.
    """

    number: int
    surface: Surface
    spacing_mm: float
    sigma_mm: float
    looks: sight.Looks
    centre_mm: Float[np.ndarray, " 3"]
    cell_mm: float
    field: Float[np.ndarray, " cells"]
    doubt: float

    @classmethod
    def of(
        cls,
        number: int,
        points_mm: Float[np.ndarray, "n 3"],
        looks: sight.Looks,
        diagonal_mm: float,
        sigma_mm: float,
        rng: np.random.Generator,
        doubt: float = 0.0,
    ) -> View:
        """A view of a part of that diagonal."""
        thin = thin_out(points_mm, POINTS, rng)
        spacing_mm = spacing_of(thin)
        normals = planes(thin, spacing_mm).normals
        normals = towards_sensors(thin, normals, looks).normals
        centre, cell_mm = 0.5 * (thin.min(axis=0) + thin.max(axis=0)), SIDE * diagonal_mm / CELLS
        axis = (np.arange(CELLS) - 0.5 * (CELLS - 1)) * cell_mm
        nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        free = looks.free(nodes + centre, 0.5 * cell_mm).reshape(CELLS, CELLS, CELLS)
        field = ndimage.distance_transform_edt(free) - ndimage.distance_transform_edt(~free)
        at = ((thin - centre) / cell_mm + 0.5 * (CELLS - 1)).T
        field = field - np.median(ndimage.map_coordinates(field, at, order=1))
        return cls(number, Surface.of(thin, normals), spacing_mm, sigma_mm, looks, centre, cell_mm,
                   np.ascontiguousarray(field.ravel(), dtype=np.float32), doubt)  # fmt: skip


def views_of(
    number: int,
    points_mm: Float[np.ndarray, "n 3"],
    sensors_mm: Float[np.ndarray, "k 3"] | None,
    sensor_index: Int[np.ndarray, " n"] | None,
    diagonal_mm: float,
    sigma_mm: float,
    rng: np.random.Generator,
) -> list[View]:
    """The views of a scan: one, or one from each side; none where no one sensor saw all of it.

    Raises
    ------
    VagueError
        If the sensor may have stood nearly anywhere.
    """
    few = rng.permutation(len(points_mm))[:IMAGE_POINTS]
    image = np.ascontiguousarray(points_mm[few])
    if sensors_mm is not None and sensor_index is not None:
        looks = sight.told(image, sensors_mm, sensor_index[few])
        return [View.of(number, points_mm, looks, diagonal_mm, sigma_mm, rng)]
    guess = sight.guess_directions(thin_out(points_mm, GUESS_POINTS, rng))
    if guess.width > WIDEST_GUESS:
        raise VagueError("is nearly flat as seen, so that it fits in more than one place")
    sides = [(guess.towards, 0.5 - 0.5 * guess.sureness)]
    if guess.sureness < SURE_SIDE:
        sides.append((-guess.towards, 0.5 + 0.5 * guess.sureness))
    return [
        View.of(number, points_mm, sight.guessed(image, way), diagonal_mm, sigma_mm, rng, doubt)
        for way, doubt in sides
        if len(way)
    ]


@dataclass(frozen=True, slots=True)
class Facing:
    """(n, 3) normals, turned to the sensors; (n,) whether it is clear which way that is."""

    normals: Float[np.ndarray, "n 3"]
    sure: Bool[np.ndarray, " n"]


def towards_sensors(
    points_mm: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], looks: sight.Looks
) -> Facing:
    """The normals, turned to the sensor that sees each point's face most squarely."""
    best = np.zeros(len(points_mm))
    for look in looks.each:
        ray = look.sensor_mm - points_mm
        along = (normals * ray).sum(axis=1) / np.linalg.norm(ray, axis=1)
        if looks.guessed:
            best += along / len(looks.each)
        else:
            # what hides a point's face from a sensor lies before it
            hidden = look.hides(points_mm) if len(looks.each) > 1 else np.zeros(len(best), bool)
            along = np.where(hidden, 0.0, along)
            best = np.where(np.abs(along) > np.abs(best), along, best)
    return Facing(normals * np.where(best < 0.0, -1.0, 1.0)[:, None], np.abs(best) > CLEAR)


@dataclass(frozen=True, slots=True)
class Fit:
    """A pose of two views, and what speaks for and against it.

    Attributes
    ----------
    pose
        (4, 4) first from second.
    overlap
        Of each view, the share that lies on the other.
    against
        Of each view, the share in the other's free space, or off its surface.
    guessed
        Where a sensor stood was guessed.
    """

    pose: Float[np.ndarray, "4 4"]
    overlap: tuple[float, float]
    against: tuple[float, float]
    guessed: bool

    @property
    def score(self) -> float:
        """What speaks for it, less what speaks against it."""
        return 0.5 * sum(self.overlap) - 0.5 * AGAINST_COUNTS * sum(self.against)


def match(first: View, second: View, diagonal_mm: float) -> list[Fit]:
    """Poses of the second view in the first's frame, best first; different from each other."""
    rough = []
    for pose in _search(first, second, diagonal_mm):
        within = np.geomspace(FIRST_WITHIN, LAST_WITHIN, 6) * diagonal_mm
        nearer = settled(first.surface, second.surface, pose, within, ROUGH_POINTS)
        rough.append(_rough(first, second, nearer, diagonal_mm))
    kept = distinct(rough, second.surface, SAME_POSE * diagonal_mm)[:FINE_POSES]
    last_mm = REACH_SPACINGS * max(first.spacing_mm, second.spacing_mm)
    within = np.geomspace(max(LAST_WITHIN * diagonal_mm, last_mm), last_mm, 12)
    fine = [
        judged(
            first,
            second,
            settled(first.surface, second.surface, fit.pose, within, FINE_POINTS),
        )
        for fit in kept
    ]
    return distinct(fine, second.surface, SAME_POSE * diagonal_mm)


def distinct(fits: list[Fit], surface: Surface, apart_mm: float) -> list[Fit]:
    """The fits by score; of those that move the view to one place, the best."""
    places = surface.points_mm[surface.some(60)]
    kept: list[Fit] = []
    for fit in sorted(fits, key=lambda fit: -fit.score):
        here = moved(places, fit.pose)
        if all(np.abs(moved(places, k.pose) - here).max() > apart_mm for k in kept):
            kept.append(fit)
    return kept


def _search(first: View, second: View, diagonal_mm: float) -> list[Float[np.ndarray, "4 4"]]:
    """Every rotation, moved out of free space; best first."""
    rng = np.random.default_rng(0)
    cell_mm = first.cell_mm
    rotations, places = spread_rotations(ROTATIONS), np.zeros((ROTATIONS, 3))
    guessed = first.looks.guessed or second.looks.guessed
    free_counts = FREE_COUNTS_GUESSED if guessed else FREE_COUNTS
    for step in ROUNDS:
        own, others = _sample(first, step.points, rng), _sample(second, step.points, rng)
        scales = np.geomspace(step.first, step.last, step.steps) * diagonal_mm / cell_mm
        scores = kernels.reconcile(
            *own, *others, first.field, second.field, CELLS, rotations, places, scales,
            CAP * diagonal_mm / cell_mm, 0.5 * diagonal_mm / cell_mm,
        )  # fmt: skip
        order = np.argsort(free_counts * scores[:, 0] - scores[:, 1], kind="stable")
        chosen = peaks(
            order, rotations, places, 0.4 * diagonal_mm / cell_mm, 0.01 * diagonal_mm / cell_mm,
            step.keep,
        )  # fmt: skip
        rotations = np.ascontiguousarray(rotations[chosen])
        places = np.ascontiguousarray(places[chosen])
    found = []
    for rotation, place in zip(rotations, places, strict=True):
        u, _, vt = np.linalg.svd(rotation)
        pose = np.eye(4)
        pose[:3, :3] = u @ vt
        pose[:3, 3] = first.centre_mm + cell_mm * place - pose[:3, :3] @ second.centre_mm
        found.append(pose)
    return found


def _sample(view: View, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    chosen = rng.permutation(len(view.surface.points_mm))[:count]
    local = (view.surface.points_mm[chosen] - view.centre_mm) / view.cell_mm
    return np.ascontiguousarray(local), np.ascontiguousarray(view.surface.normals[chosen])


def settled(
    first: Surface,
    second: Surface,
    pose: Float[np.ndarray, "4 4"],
    within_mm: Float[np.ndarray, " steps"],
    count: int,
) -> Float[np.ndarray, "4 4"]:
    """The pose after some steps point to plane, each with pairs no farther apart than it says."""
    some = second.some(count)
    found = pose
    for reach_mm in within_mm:
        points = moved(second.points_mm[some], found)
        distance, index = first.tree.query(points, distance_upper_bound=reach_mm, workers=-1)
        near = np.isfinite(distance)
        index = index[near]
        normals = second.normals[some][near] @ found[:3, :3].T
        facing = (normals * first.normals[index]).sum(axis=1) > PAIRED
        if facing.sum() < LEAST_PAIRS:
            return found
        here, normal = points[near][facing], first.normals[index[facing]]
        height = ((here - first.points_mm[index[facing]]) * normal).sum(axis=1)
        found = moved_to_planes(here, normal, height, max(0.3 * reach_mm, 1e-3)) @ found
    return found


def loss_weight(height_mm: Float[np.ndarray, " q"], scale_mm: float) -> Float[np.ndarray, " q"]:
    """(q,) weight of each residual under the Geman–McClure loss."""
    return np.asarray((scale_mm**2 / (height_mm**2 + scale_mm**2)) ** 2)


def moved_to_planes(
    points_mm: Float[np.ndarray, "q 3"],
    normals: Float[np.ndarray, "q 3"],
    height_mm: Float[np.ndarray, " q"],
    scale_mm: float,
    damping: float = 1e-6,
) -> Float[np.ndarray, "4 4"]:
    """The (4, 4) motion of one Gauss–Newton step that brings points onto planes.

    Parameters
    ----------
    height_mm
        Of the points over the planes.
    scale_mm
        Of the Geman–McClure loss.
    """
    weight = loss_weight(height_mm, scale_mm)
    centre = points_mm.mean(axis=0)
    jacobian = np.concatenate([np.cross(points_mm - centre, normals), normals], axis=1)
    weighted = jacobian * weight[:, None]
    normal_matrix = weighted.T @ jacobian
    normal_matrix += damping * np.diag(np.diag(normal_matrix).reshape(2, 3).mean(axis=1).repeat(3))
    step = -np.linalg.solve(normal_matrix, weighted.T @ height_mm)
    return motion_about(centre, step[:3], step[3:])


def _rough(first: View, second: View, pose: Float[np.ndarray, "4 4"], diagonal_mm: float) -> Fit:
    return _told(first, second, pose, ROUGH_POINTS, 0.02 * diagonal_mm, LAST_WITHIN * diagonal_mm,
                 np.inf)  # fmt: skip


def judged(first: View, second: View, pose: Float[np.ndarray, "4 4"]) -> Fit:
    """How well a settled pose of two views agrees with what both saw."""
    spacing_mm = max(first.spacing_mm, second.spacing_mm)
    off_mm = OFF_SPACINGS * spacing_mm + OFF_SIGMAS * max(first.sigma_mm, second.sigma_mm)
    return _told(first, second, pose, FINE_POINTS, REACH_SPACINGS * spacing_mm,
                 FREE_SPACINGS * spacing_mm, off_mm)  # fmt: skip


def _told(
    first: View,
    second: View,
    pose: Float[np.ndarray, "4 4"],
    count: int,
    reach_mm: float,
    free_mm: float,
    off_mm: float,
) -> Fit:
    shares = [
        shares_on(one, other, there, count, reach_mm, free_mm, off_mm)
        for one, other, there in ((first, second, pose), (second, first, np.linalg.inv(pose)))
    ]
    (second_on, second_off), (first_on, first_off) = shares
    guessed = first.looks.guessed or second.looks.guessed
    return Fit(pose, (first_on, second_on), (first_off, second_off), guessed)


def shares_on(
    view: View,
    other: View,
    pose: Float[np.ndarray, "4 4"],
    count: int,
    reach_mm: float,
    free_mm: float,
    off_mm: float,
) -> tuple[float, float]:
    """Shares of another view's points that lie on a view's surface, and that contradict it."""
    some = other.surface.some(count)
    veil = sight.Veil(other.surface.points_mm, other.surface.normals, np.linalg.inv(pose))
    on, against = marks_on(view, other, pose, some, reach_mm, free_mm, off_mm, veil)
    return float(on.mean()), float(against.mean())


def marks_on(
    view: View,
    other: View,
    pose: Float[np.ndarray, "4 4"],
    some: slice,
    reach_mm: float,
    free_mm: float,
    off_mm: float,
    veil: sight.Veil,
) -> tuple[Bool[np.ndarray, " k"], Bool[np.ndarray, " k"]]:
    """Which of another view's points lie on a view's surface, and which contradict it."""
    surface = view.surface
    points = moved(other.surface.points_mm[some], pose)
    normals = other.surface.normals[some] @ pose[:3, :3].T
    distance, index = surface.tree.query(points, distance_upper_bound=reach_mm, workers=-1)
    near = np.isfinite(distance)
    index = np.where(near, index, 0)
    near &= (normals * surface.normals[index]).sum(axis=1) > AGREES
    height = np.abs(((points - surface.points_mm[index]) * surface.normals[index]).sum(axis=1))
    on = near & (height <= min(off_mm, free_mm))
    # beside an edge, the nearest surface is the step's other level
    over = distance**2 - height**2 <= (OVER_SPACINGS * max(view.spacing_mm, other.spacing_mm)) ** 2
    off = near & over & (height > off_mm)
    return on, off | (view.looks.free(points, free_mm, normals, veil) & ~on)
