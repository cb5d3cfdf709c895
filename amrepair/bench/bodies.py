"""A bent part is two rigid pieces: which of them stayed where it was.

An alignment of the whole lays the piece that was seen most on the template, or neither piece, or
the scan somewhere else, where more of it lies nearly right. What tells is how much lies on the
template *within the noise*: of a bent part hardly more than one piece in any pose, all of it in
two poses that agree along a hinge. Of the two pieces the one that makes up more of the *template*
is taken to be in place. A part that is bent by less than an alignment tells is found by what the
motions of both sides of a cut explain (`bends`). It judges poses; it makes no scores.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from scipy.stats import chi2

from amrepair.align.refine import Prior, refine_all
from amrepair.align.search import CoarseField, search
from amrepair.align.thinning import Thinned
from amrepair.arrays import Mask, Points, Values, Vector
from amrepair.bench.bends import Pieces, Pose, best_cuts, with_zone
from amrepair.bench.options import DEFAULT_BODIES, BodyOptions
from amrepair.frames import diagonal, moved, rigid, rotation_from_vector, unit_vectors, ways_across
from amrepair.template.port import Template


def surface_of(
    template: Template, options: BodyOptions = DEFAULT_BODIES
) -> Float[np.ndarray, "m 3"]:
    """(m, 3) places of a template's surface, as dense as bends are judged."""
    return template.surface_points(options.surface_ratio * diagonal(template.bounds_mm))[0]


def pieces_of(
    points_mm: Points,
    template: Template,
    known: Sequence[Pose],
    sigma_mm: float,
    rng: np.random.Generator,
    surface_mm: Float[np.ndarray, "m 3"] | None = None,
    options: BodyOptions = DEFAULT_BODIES,
) -> Pieces:
    """The larger piece's pose, and the other's, where the scan shows a part bent in two.

    Else the pose in which most of it is held; the first given where that explains nearly all.

    Parameters
    ----------
    points_mm
        (n, 3) in the scan's frame.
    known
        (4, 4) each, template from scan, best first, as aligned.
    sigma_mm
        Noise of the points.
    surface_mm
        What `surface_of` says of the template; None asks it.
    """
    thinned = Thinned(points_mm, rng)
    limit_mm = max(
        options.clear_sigmas * sigma_mm, options.clear_ratio * diagonal(template.bounds_mm)
    )
    surface = surface_of(template, options) if surface_mm is None else surface_mm
    scene = _Scene.of(thinned, template, sigma_mm, limit_mm, surface, options)
    if (~scene.on(known[0])).mean() < options.least_bent_share:
        return _little_bent(known[0], scene)
    tried = scene.distinct(scene.refined(scene.thinned.to(options.start_points), known))
    best = _best_pair(tried, scene)
    if best is None or not scene.enough(best):
        coarse = CoarseField.of(template)
        poses = search(scene.thinned, coarse, effort=coarse.options.thorough)
        found = [pose.matrix for pose in poses]
        more = scene.distinct(
            [*tried, *scene.refined(scene.thinned.to(options.start_points), found)]
        )
        untried = [pose for pose in more if not any(pose is one for one in tried)]
        best = _best_pair(untried[: options.most_tried], scene, best)
        tried = more
    alone = scene.held(scene.on(tried[0]))
    gained = 0.0 if best is None else best.explained - alone
    if best is not None and best.beyond >= options.least_of_pair and gained >= options.least_gained:
        return scene.in_two(
            scene.finished(best.standing, best.normal, best.through_mm),
            scene.finished(best.other, -best.normal, best.through_mm),
            best.normal,
            best.through_mm,
        )
    if alone < options.most_of_broken:
        broken = _nothing_outside(tried, scene)
        if broken is not None:
            return Pieces(broken)
    return _little_bent(scene.finished(tried[0]), scene)


def _little_bent(pose: Pose, scene: _Scene) -> Pieces:
    """The pose, or those of two pieces where these explain more than noise does."""
    options = scene.options
    cuts = best_cuts(
        moved(scene.cloud, pose),
        scene.template,
        scene.surface_mm,
        scale_mm=options.scale_ratio * scene.diagonal_mm,
        sigma_mm=max(
            scene.sigma_mm, options.clear_ratio / options.clear_sigmas * scene.diagonal_mm
        ),
        options=options.bends,
    )
    if cuts[0].gain < chi2.isf(options.gain_probability, 6):
        return Pieces(pose)
    whole = scene.refined(scene.cloud, [pose], options.scale_ratio)[0]
    alone = float(scene.off(whole).mean())
    best: tuple[float, Pieces] | None = None
    for cut in cuts[:2]:
        explained, pieces = _parted(whole, cut.normal, cut.height_mm, scene)
        if pieces.other is None or _hinge(pieces.other @ np.linalg.inv(pieces.pose), scene) is None:
            continue  # what slid along a flat or round face is no bend
        if best is None or explained < best[0]:
            best = explained, pieces
    if best is None or best[0] > (1.0 - options.least_explained) * alone:
        return Pieces(pose)
    return best[1]


def _parted(whole: Pose, axis: Vector, height_mm: float, scene: _Scene) -> tuple[float, Pieces]:
    """What is off, and the pieces on either side of a cut: each moved by itself, then the cut."""
    options = scene.options
    cloud = scene.cloud
    height = scene.feet(whole) @ axis
    order = np.argsort(height)
    first, last = (int(share * len(order)) for share in options.cut_range)
    poses, off, at = [whole, whole], [np.zeros(len(cloud))] * 2, height_mm
    for round_ in range(options.rounds // 2):
        for k, own in enumerate((height < at, height >= at)):
            scale = options.scale_ratio if round_ == 0 else 0.0
            some = np.ascontiguousarray(cloud[own])
            poses[k] = scene.refined(some, [poses[k]], scale, held=True)[0]
            off[k] = scene.off(poses[k])
        below = np.cumsum(off[0][order])
        beyond = np.cumsum(off[1][order][::-1])[::-1]
        cut = first + int(np.argmin(below[first : last - 1] + beyond[first + 1 : last]))
        at = float(height[order[cut + 1]])
    off_mean = float(np.where(height < at, off[0], off[1]).mean())
    surface = scene.surface_mm @ axis
    stands = 0 if (surface < at).mean() > 0.5 else 1
    normal = axis if stands == 0 else -axis
    return off_mean, scene.in_two(poses[stands], poses[1 - stands], normal, at * axis)


def _nothing_outside(poses: Sequence[Pose], scene: _Scene) -> Pose | None:
    """The pose that holds most of those that leave nothing outside the template, if there is one.

    A view into a broken face: on the template lies what is left beside it, below all the rest. Laid
    on a flat side near by, half of the face sticks out, and nothing that breaks makes that.
    """
    options = scene.options
    few, best, most = scene.thinned.to(options.start_points), None, options.least_piece_share
    for ratio in options.sunk_ratios:
        for pose in scene.refined(few, poses, ratio, outside=False):
            distance = scene.template.distance(moved(scene.cloud, pose))
            held = scene.held(np.abs(distance) <= scene.limit_mm)
            if held > most and (distance > scene.limit_mm).mean() <= options.most_outside:
                best, most = pose, held
    if best is None:
        return None
    return scene.refined(scene.thinned.to(options.last_points), [best], 0.0, outside=False)[0]


def _best_pair(poses: Sequence[Pose], scene: _Scene, best: _Pair | None = None) -> _Pair | None:
    """The pair that explains most, of those that begin at the poses; the first one's own first."""
    for few in (poses[:1], poses[1:]):
        for seeds in _seeds(few, scene):
            begun = [(scene.held(scene.on(a) | scene.on(b)), a, b) for a, b in seeds]
            for _, first, second in sorted(begun, key=lambda one: -one[0])[
                : scene.options.most_polished
            ]:
                pair = _polished(first, second, scene)
                if pair is not None and (best is None or pair.explained > best.explained):
                    best = pair
            if best is not None and scene.enough(best):
                return best
    return best


@dataclass(frozen=True, slots=True)
class _Pair:
    """Two poses of which one is of the larger piece.

    Attributes
    ----------
    explained, beyond
        Share of the places that are held by the pose of their piece: of all, and of those that the
        bend itself leaves alone (of all where those are few).
    normal, through_mm
        Of the plane between the pieces, template's frame, away from the standing one.
    """

    explained: float
    beyond: float
    standing: Pose
    other: Pose
    normal: Vector
    through_mm: Vector


@dataclass(frozen=True)
class _Scene:
    """A scan and its template, and how near is on."""

    thinned: Thinned
    cloud: Points
    template: Template
    sigma_mm: float
    diagonal_mm: float
    limit_mm: float
    surface_mm: Float[np.ndarray, "m 3"]
    options: BodyOptions

    @classmethod
    def of(
        cls,
        thinned: Thinned,
        template: Template,
        sigma_mm: float,
        limit_mm: float,
        surface_mm: Float[np.ndarray, "m 3"],
        options: BodyOptions,
    ) -> _Scene:
        cloud, diagonal_mm = thinned.to(options.points), diagonal(template.bounds_mm)
        sigma_mm = max(sigma_mm, 1e-3)
        return cls(thinned, cloud, template, sigma_mm, diagonal_mm, limit_mm, surface_mm, options)

    @cached_property
    def neighbours(self) -> Int[np.ndarray, "n k"]:
        """(n, k) points of the cloud around each; most scans are whole, and never ask."""
        near = [*range(1, min(self.options.neighbours, len(self.cloud)) + 1)]
        return np.asarray(cKDTree(self.cloud).query(self.cloud, k=near)[1])

    def enough(self, pair: _Pair) -> bool:
        """Whether nothing better need be looked for."""
        share, beyond = self.options.explained_share, self.options.enough_beyond
        return pair.explained > share or pair.beyond > beyond

    def held(self, on: Mask) -> float:
        """Share of the places that are held."""
        return float(self.is_held(on).mean())

    def is_held(self, on: Mask) -> Mask:
        """(n,) places that lie on the template with what is around them.

        What crosses the template somewhere, a broken face laid on a flat one, is on it in strips.
        """
        return np.asarray(on & (on[self.neighbours].mean(axis=1) >= self.options.mostly))

    def on(
        self, pose: Pose, points: Float[np.ndarray, "k 3"] | None = None
    ) -> Bool[np.ndarray, " k"]:
        """(k,) points that lie on the template."""
        placed = moved(self.cloud if points is None else points, pose)
        return np.abs(self.template.distance(placed)) <= self.limit_mm

    @property
    def prior(self) -> Prior:
        """A piece lies near where the whole does: a flat one must not slide."""
        options = self.options
        shift_mm = options.second_ratio * self.diagonal_mm
        return Prior(np.full(3, options.piece_turn_rad), np.full(3, shift_mm))

    def off(self, pose: Pose) -> Values:
        """(n,) how far off the template the points lie, in limits; 1 beyond it."""
        distance = np.abs(self.template.distance(moved(self.cloud, pose)))
        return np.asarray(np.minimum(distance / self.limit_mm, 1.0))

    def feet(self, pose: Pose) -> Points:
        """(n, 3) places of the template's surface that the points lie over."""
        placed = moved(self.cloud, pose)
        f_mm, gradient = self.template.distance_and_gradient(placed)
        return np.asarray(placed - f_mm[:, None] * unit_vectors(gradient))

    def in_two(self, standing: Pose, other: Pose, normal: Vector, through_mm: Vector) -> Pieces:
        """Both pieces, and the zone between them as the points tell it."""
        pieces = Pieces(standing, other, normal, through_mm)
        return with_zone(
            pieces, self.cloud, self.template, limit_mm=self.limit_mm, sigma_mm=self.sigma_mm,
            options=self.options.bends,
        )  # fmt: skip

    def refined(
        self,
        points: Float[np.ndarray, "k 3"],
        starts: Sequence[Pose],
        first_ratio: float | None = None,
        *,
        outside: bool = True,
        held: bool = False,
    ) -> list[Pose]:
        """Poses moved so that as many of the points as may be lie on the template.

        Unless `outside`, those beyond it are drawn in from anywhere. If `held`, what the points do
        not tell of a pose stays.
        """
        options = self.options
        end_mm = options.sharp * self.limit_mm
        first_ratio = options.first_ratio if first_ratio is None else first_ratio
        found = refine_all(
            points,
            self.template,
            starts,
            start_scale_mm=max(first_ratio * self.diagonal_mm, end_mm),
            end_scale_mm=end_mm,
            sigma_mm=self.sigma_mm,
            max_iterations=options.iterations,
            enough_mm=options.enough_sigmas * self.sigma_mm,
            outside_mm=0.0 if outside else end_mm,
            prior=self.prior if held else None,
        )
        return [one.matrix for one in found]

    def finished(
        self, pose: Pose, away: Vector | None = None, through_mm: Vector | None = None
    ) -> Pose:
        """The pose moved on all points that lie on the template, on its side of the plane."""
        options = self.options
        points = self.thinned.to(options.last_points)
        for _ in range(2):
            placed = moved(points, pose)
            own = np.abs(self.template.distance(placed)) <= self.limit_mm
            if away is not None and through_mm is not None:
                own &= (placed - through_mm) @ away < -options.hinge_ratio * self.diagonal_mm
            if own.sum() < options.least_piece_share * len(points):
                break
            pose = refine_all(
                np.ascontiguousarray(points[own]),
                self.template,
                [pose],
                start_scale_mm=self.limit_mm,
                end_scale_mm=self.limit_mm,
                sigma_mm=self.sigma_mm,
                max_iterations=options.iterations,
            )[0].matrix
        return pose

    def distinct(self, poses: Sequence[Pose]) -> list[Pose]:
        """Those apart from each other, the one with most points on the template first."""
        shares = [self.held(self.on(pose)) for pose in poses]
        few = self.cloud[:: len(self.cloud) // 50 + 1]
        kept: list[Pose] = []
        for k in np.argsort(shares, kind="stable")[::-1]:
            here = moved(few, poses[k])
            if all(
                np.linalg.norm(here - moved(few, one), axis=1).max()
                > self.options.same_ratio * self.diagonal_mm
                for one in kept
            ):
                kept.append(poses[k])
        return kept


def _seeds(poses: Sequence[Pose], scene: _Scene) -> Iterator[list[tuple[Pose, Pose]]]:
    """Of each pose, two poses to start from: of what it leaves, and of both sides of some planes.

    A side is moved from all the poses at once: they are many where a part fits in many ways.
    """
    options = scene.options
    cloud = scene.thinned.to(2 * options.piece_points)
    local = cloud - cloud.mean(axis=0)
    sides = []
    for axis in np.linalg.eigh(local.T @ local)[1].T[::-1]:
        height = local @ axis
        for cut in np.quantile(height, options.cuts):
            for side in (height <= cut, height > cut):
                sides.append(
                    scene.refined(
                        _some(cloud[side], options.piece_points), poses, options.second_ratio
                    )
                )
    for pose, *moved_sides in zip(poses, *sides, strict=True):
        found = list(zip(moved_sides[::2], moved_sides[1::2], strict=True))
        yield [*_of_the_rest(pose, scene), *found]


def _of_the_rest(first: Pose, scene: _Scene) -> Iterator[tuple[Pose, Pose]]:
    """The pose, and that of what it leaves, where this is a piece."""
    options = scene.options
    on = scene.on(first)
    rest = scene.cloud[~on]
    if len(rest) <= options.least_piece_share * len(on):
        return
    few = _some(rest, options.piece_points)
    middle = moved(few, first).mean(axis=0)
    starts = [first]
    for vector in (*np.eye(3), *-np.eye(3)):
        turn = rotation_from_vector(options.piece_turn_rad * vector)
        starts.append(rigid(turn @ first[:3, :3], turn @ (first[:3, 3] - middle) + middle))
    found = scene.refined(few, starts, options.second_ratio)
    yield first, found[int(np.argmax([scene.on(pose, few).mean() for pose in found]))]


def _some(points: Points, count: int) -> Float[np.ndarray, "m 3"]:
    return np.ascontiguousarray(points[:: len(points) // count + 1])


def _polished(first: Pose, second: Pose, scene: _Scene) -> _Pair | None:
    """Both poses, each moved on the points that it explains better; None if that is no bend."""
    options = scene.options
    poses = [first, second]
    for _ in range(options.rounds):
        off = np.stack([np.abs(scene.template.distance(moved(scene.cloud, one))) for one in poses])
        nearer = off[1] < off[0]
        if min(nearer.mean(), 1.0 - nearer.mean()) < options.least_piece_share:
            return None
        near = off.min(axis=0) <= options.nearby_limits * scene.limit_mm
        own = (near & ~nearer, near & nearer)
        if min(which.sum() for which in own) < options.least_piece_share * len(nearer):
            return None
        poses = [
            scene.refined(_some(scene.cloud[which], options.start_points), [one], 0.0)[0]
            for which, one in zip(own, poses, strict=True)
        ]
    return _judged(poses[0], poses[1], scene)


def _judged(first: Pose, second: Pose, scene: _Scene) -> _Pair | None:
    """The pair, if the second is the first turned about a line that parts what they explain."""
    options = scene.options
    hinge = _hinge(second @ np.linalg.inv(first), scene)
    if hinge is None:
        return None
    axis, through = hinge
    placed = [moved(scene.cloud, pose) - through for pose in (first, second)]
    off = np.stack([np.abs(scene.template.distance(one + through)) for one in placed])
    on = off <= scene.limit_mm
    only = (on[0] & ~on[1], on[1] & ~on[0])
    if min(which.sum() for which in only) < options.least_piece_share * on.shape[1]:
        return None
    # Of the planes through the axis, the one with the fewest points on the wrong side is taken.
    u, v = ways_across(axis)
    angles = 2.0 * np.pi * np.arange(options.angles) / options.angles
    normals = np.outer(np.cos(angles), u) + np.outer(np.sin(angles), v)
    wrong = (placed[0][only[0]] @ normals.T > 0.0).mean(axis=0)
    wrong += (placed[1][only[1]] @ normals.T < 0.0).mean(axis=0)
    least = wrong <= wrong.min() + options.as_good_ratio
    normal = normals[least].sum(axis=0)
    normal /= max(float(np.linalg.norm(normal)), 1e-9)
    if 0.5 * wrong.min() > options.most_wrong:
        return None
    zone_mm = options.hinge_ratio * scene.diagonal_mm
    right = (on[0] & (placed[0] @ normal < zone_mm)) | (on[1] & (placed[1] @ normal > -zone_mm))
    held = scene.is_held(right)
    # a point of the second piece lies as far from the plane in its own pose as in the first
    height = np.where(on[0], placed[0] @ normal, placed[1] @ normal)
    beyond = np.abs(height) > options.bent_ratio * scene.diagonal_mm
    share = float(held.mean())
    share_beyond = float(held[beyond].mean()) if beyond.mean() > options.least_beyond else share
    in_front = float(((scene.surface_mm - through) @ normal > 0.0).mean())
    (standing, other), away = (
        ((second, first), -normal) if in_front > 0.5 else ((first, second), normal)
    )
    return _Pair(share, share_beyond, standing, other, away, through)


def _hinge(second_from_first: Pose, scene: _Scene) -> tuple[Vector, Vector] | None:
    """Direction of the line about which the second piece was turned, and a point on it.

    None where it was turned too little or too much, slid along the line, or the line is far away.
    """
    options = scene.options
    rotation, shift = second_from_first[:3, :3], second_from_first[:3, 3]
    twist = 0.5 * np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine = float(np.linalg.norm(twist))
    angle = float(np.arctan2(sine, 0.5 * (np.trace(rotation) - 1.0)))
    if not options.least_turned_rad < angle < options.most_turned_rad:
        return None
    axis = twist / sine
    middle = scene.template.bounds_mm.mean(axis=0)
    gap = rotation @ middle + shift - middle
    along = float(gap @ axis)
    across = gap - along * axis
    # This is the fixed point of a plane rotation, relative to the middle.
    through = middle + 0.5 * (across + np.cross(axis, across) / np.tan(0.5 * angle))
    if abs(along) > options.hinge_ratio * scene.diagonal_mm:
        return None
    if np.linalg.norm(through - middle) > scene.diagonal_mm:
        return None
    return axis, through
