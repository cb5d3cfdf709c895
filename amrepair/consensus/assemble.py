"""Views to one part: which poses of pairs hold together, and which scans are left out.

It starts from the pair that is surest and adds the scan whose pose, among all that its pairs with
the placed ones propose, is surest in turn: most of it on what they saw, next to nothing of either
in the other's free space, and no other pose nearly as good. Where that ends another pair may start
a larger group. What never becomes sure is left out and said.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from amrepair.consensus.looks import Veil
from amrepair.consensus.views import (
    FINE_POINTS,
    FREE_SPACINGS,
    OFF_SIGMAS,
    OFF_SPACINGS,
    POINTS,
    REACH_SPACINGS,
    SAME_POSE,
    Fit,
    Surface,
    View,
    distinct,
    marks_on,
    match,
    settled,
)
from amrepair.frames import moved
from gcode.progress import Progress, silent


@dataclass(frozen=True, slots=True)
class Demands:
    """What a pose must have to be taken.

    So much of the scan lies on the others, no more of any contradicts, and there is no rival: no
    other pose that has nearly that overlap, and hardly more against it. Of nine parts, 69 views at
    their true poses had at most 0.013 against them, sensors told or not.
    """

    overlap: float
    against: float
    rival: float


TOLD, GUESSED = Demands(0.1, 0.05, 0.015), Demands(0.2, 0.03, 0.03)
RIVAL_RATIO = 0.75  # of the overlap that is demanded
MOSTLY = 0.5  # of a scan: so much of it lies on two places only of a part that is nearly symmetric
PROPOSED = 3  # poses of each pair that are looked at again with all views
# More scans than this: neighbours in the list (turntables' are) are asked first.
ALL_PAIRS, NEIGHBOURS = 9, 3
# Views seen from sides within this of each other may be one view twice (cosine).
ONE_SIDE = 0.9
VEIL_POINTS = 2_500  # of each view, for what hides what

Poses = dict[int, Float[np.ndarray, "4 4"]]


@dataclass(frozen=True, slots=True)
class Assembly:
    """Placed scans.

    Attributes
    ----------
    views
        By the scan's number: its view, of those that were placed.
    poses
        By the scan's number: (4, 4) common frame from the scan.
    reasons
        By the scan's number: why it was left out.
    """

    views: dict[int, View]
    poses: Poses
    reasons: dict[int, str]


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Fits of pairs of views, each found once."""

    views: Sequence[View]
    diagonal_mm: float
    found: dict[tuple[int, int], list[Fit]]

    def ask(self, wanted: set[tuple[int, int]], progress: Progress) -> None:
        """Find the fits of some pairs more."""
        for n, (i, j) in enumerate(sorted(wanted - set(self.found))):
            progress("align views", float(n), float(len(wanted)))
            self.found[i, j] = ranked(match(self.views[i], self.views[j], self.diagonal_mm))

    def of(self, first: int, second: int) -> list[Fit]:
        """Poses of the second view in the first's frame; none where nobody asked."""
        if first < second:
            return self.found.get((first, second), [])
        return [
            Fit(np.linalg.inv(f.pose), f.overlap[::-1], f.against[::-1], f.guessed)
            for f in self.found.get((second, first), [])
        ]


def assemble(views: Sequence[View], diagonal_mm: float, progress: Progress = silent) -> Assembly:
    """Bring views of one part into one frame; those that are not sure stay out."""
    numbers = sorted({view.number for view in views})
    as_given = _as_given(views)
    if as_given is not None:
        return Assembly(as_given, {k: np.eye(4) for k in numbers}, {})
    pairs = _Pairs(views, diagonal_mm, {})
    every = {
        (i, j)
        for i, j in itertools.combinations(range(len(views)), 2)
        if views[i].number != views[j].number
    }
    near = {pair for pair in every if _neighbours(views, pair, len(numbers))}
    pairs.ask(near, progress)
    found = _grown(pairs, numbers)
    if len(found.poses) < len(numbers) and near != every:
        pairs.ask(every, progress)
        found = _grown(pairs, numbers)
    return found


def _neighbours(views: Sequence[View], pair: tuple[int, int], count: int) -> bool:
    apart = abs(views[pair[0]].number - views[pair[1]].number)
    return count <= ALL_PAIRS or min(apart, count - apart) <= NEIGHBOURS


def _as_given(views: Sequence[View]) -> dict[int, View] | None:
    """The views, where the scans came in one frame already.

    Chance does not bring scans together without contradiction. But what turns before a fixed sensor
    looks alike from all sides if it is round: so the sensors must have stood in different places.
    """
    chosen: dict[int, View] = {}
    for view in sorted(views, key=lambda view: -view.doubt):
        chosen[view.number] = view
    sides = []
    for view in chosen.values():
        centre = view.surface.points_mm.mean(axis=0)
        way = (view.looks.sensors_mm - centre).mean(axis=0)
        sides.append(way / max(float(np.linalg.norm(way)), 1e-12))
    if len(sides) < 2 or (np.array(sides) @ np.array(sides).T).min() > ONE_SIDE:
        return None
    poses: Poses = {k: np.eye(4) for k in chosen}
    for view in chosen.values():
        if why_not([judged_by_all(view, np.eye(4), chosen, poses)]):
            return None
    return chosen


def _grown(pairs: _Pairs, numbers: Sequence[int]) -> Assembly:
    """The largest group of scans that hold together.

    Views from above and from below may share too little to be sure of, and the surest pair be of
    the smaller group.
    """
    best = Assembly({}, {}, {k: _alone(k, pairs) for k in numbers})
    left = list(numbers)
    while len(left) > len(best.poses):
        seed, poses = _seed(pairs, left)
        if not poses:
            break
        found = _group(pairs, seed, poses, numbers)
        # a pair that a group ends without starts no other
        left = [k for k in left if k not in seed and k not in found.poses]
        if len(found.poses) > len(best.poses):
            best = found
    return best


def _group(
    pairs: _Pairs, seed: Mapping[int, View], begun: Poses, numbers: Sequence[int]
) -> Assembly:
    """Scan after scan onto a pair, the surest first."""
    chosen, poses = dict(seed), dict(begun)
    reasons: dict[int, str] = {}
    while len(poses) < len(numbers):
        whole = Surface.of(*_joined(chosen, poses))
        found = [(*_placed(k, pairs, chosen, poses, whole), k) for k in numbers if k not in poses]
        reasons = {k: reason for _, _, _, reason, k in found}
        sure = [one for one in found if not one[3]]
        if not sure:
            break
        _, view, fit, _, k = max(sure, key=lambda one: one[0])
        chosen[k], poses[k] = view, fit.pose
        _even(chosen, poses)
    for k in _doubtful(pairs, chosen, poses):
        del chosen[k], poses[k]
        reasons[k] = "fits the others in more than one way"
    return Assembly(chosen, poses, {k: r for k, r in reasons.items() if k not in poses})


def why_not(fits: Sequence[Fit]) -> str:
    """Why the best of the fits is not to be trusted; nothing where it is."""
    if not fits:
        return "fits none of the others"
    demands = GUESSED if fits[0].guessed else TOLD
    overlap, against = min(fits[0].overlap), max(fits[0].against)
    if overlap < demands.overlap:
        return f"lies on the others with {overlap:.0%} of it, {demands.overlap:.0%} is needed"
    if against > demands.against:
        return (
            f"contradicts the others wherever it is laid ({against:.1%} of its or their surface at "
            f"best, {demands.against:.0%} is allowed)"
        )
    if any(_rivals(fits[0], fit, demands) for fit in fits[1:]):
        return "fits the others in more than one way"
    return ""


def _rivals(best: Fit, other: Fit, demands: Demands) -> bool:
    """Whether another pose may be the true one: that more of the scan overlaps proves nothing."""
    enough = min(other.overlap) >= RIVAL_RATIO * demands.overlap
    return enough and max(other.against) <= max(best.against) + demands.rival


def ranked(fits: Sequence[Fit]) -> list[Fit]:
    """Those that may be taken before those that may not, then by score."""

    def order(fit: Fit) -> tuple[bool, float]:
        demands = GUESSED if fit.guessed else TOLD
        taken = min(fit.overlap) >= demands.overlap and max(fit.against) <= demands.against
        return not taken, -fit.score

    return sorted(fits, key=order)


def _alone(k: int, pairs: _Pairs) -> str:
    """Why no pair of a scan is sure: of the pair that fits best."""
    own = [
        fits
        for (i, j), fits in pairs.found.items()
        if fits and k in (pairs.views[i].number, pairs.views[j].number)
    ]
    return why_not(max(own, key=lambda fits: fits[0].score, default=[])) or "fits none for sure"


def _margin(fits: Sequence[Fit]) -> float:
    return fits[0].score - (fits[1].score if len(fits) > 1 else 0.0)


def _seed(pairs: _Pairs, left: Sequence[int]) -> tuple[dict[int, View], Poses]:
    """The surest pair of some scans."""
    views = pairs.views
    sure = [
        pair
        for pair in pairs.found
        if all(views[k].number in left for k in pair) and not why_not(pairs.of(*pair))
    ]
    if not sure:
        return {}, {}
    i, j = max(sure, key=lambda p: _margin(pairs.of(*p)) - views[p[0]].doubt - views[p[1]].doubt)
    first, second = views[i], views[j]
    return (
        {first.number: first, second.number: second},
        {first.number: np.eye(4), second.number: pairs.of(i, j)[0].pose},
    )


def _joined(
    chosen: Mapping[int, View], poses: Poses, each: int = POINTS
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points and normals of placed views in one frame, about so many of each."""
    points, normals = [], []
    for k, pose in poses.items():
        some = chosen[k].surface.some(each)
        points.append(moved(chosen[k].surface.points_mm[some], pose))
        normals.append(chosen[k].surface.normals[some] @ pose[:3, :3].T)
    return np.concatenate(points), np.concatenate(normals)


def _placed(
    k: int, pairs: _Pairs, chosen: Mapping[int, View], poses: Poses, whole: Surface
) -> tuple[float, View, Fit, str]:
    """The best pose of a scan on those that are placed: by how much, and why it is not sure."""
    best: tuple[float, View, Fit, str] | None = None
    for number, view in enumerate(pairs.views):
        if view.number != k:
            continue
        found = _ways(number, pairs, chosen, poses, whole)
        margin, reason = _margin(found) if found else 0.0, why_not(found)
        fit = found[0] if found else Fit(np.eye(4), (0.0, 0.0), (1.0, 1.0), view.looks.guessed)
        # of both sides from which a scan may have been seen, the one that fits better
        if best is None or (not reason, fit.score) > (not best[3], best[2].score):
            best = margin, view, fit, reason
    assert best is not None
    return best


def _ways(
    number: int, pairs: _Pairs, chosen: Mapping[int, View], poses: Poses, whole: Surface
) -> list[Fit]:
    """How a view may lie on those that are placed, as its pairs with them propose; ranked."""
    view = pairs.views[number]
    spacing_mm = max(view.spacing_mm for view in pairs.views)
    within = np.geomspace(2.0 * REACH_SPACINGS, REACH_SPACINGS, 8) * spacing_mm
    proposed = [
        replace(fit, pose=poses[other.number] @ fit.pose)
        for m, other in enumerate(pairs.views)
        if chosen.get(other.number) is other
        for fit in pairs.of(m, number)[:PROPOSED]
    ]
    found = []
    for fit in distinct(proposed, view.surface, 0.5 * SAME_POSE * pairs.diagonal_mm):
        pose = settled(whole, view.surface, fit.pose, within, FINE_POINTS)
        found.append(judged_by_all(view, pose, chosen, poses))
    return ranked(distinct(found, view.surface, SAME_POSE * pairs.diagonal_mm))


def _doubtful(pairs: _Pairs, chosen: Mapping[int, View], poses: Poses) -> set[int]:
    """Placed scans that may lie otherwise if one that was left out lies as it may as well.

    A part that nearly lies on itself: of its undersides the first seemed sure, and in whichever way
    that lies the second fits in two.
    """
    doubtful: set[int] = set()
    whole = Surface.of(*_joined(chosen, poses))
    for number, view in enumerate(pairs.views):
        if view.number in poses:
            continue
        ways = _ways(number, pairs, chosen, poses, whole)
        for fit in ways[1:]:
            if not _alike(ways[0], fit):
                continue
            seen, world = {**chosen, view.number: view}, {**poses, view.number: fit.pose}
            doubtful |= {
                k
                for m, one in enumerate(pairs.views)
                for k in poses
                if chosen[k] is one and _turns_with(m, number, pairs, seen, world)
            }
    return doubtful


def _alike(best: Fit, other: Fit) -> bool:
    """Whether most of a scan lies on the others in either pose."""
    demands = GUESSED if best.guessed else TOLD
    return min(*best.overlap, *other.overlap) >= MOSTLY and _rivals(best, other, demands)


def _turns_with(
    number: int, other: int, pairs: _Pairs, chosen: Mapping[int, View], poses: Poses
) -> bool:
    """Whether a placed view has a rival pose, by its pair with another."""
    view, home = pairs.views[number], pairs.views[other].number
    rest = {k: pose for k, pose in poses.items() if k != view.number}
    proposed = [replace(f, pose=poses[home] @ f.pose) for f in pairs.of(other, number)[:PROPOSED]]
    now = judged_by_all(view, poses[view.number], chosen, rest)
    apart_mm = SAME_POSE * pairs.diagonal_mm
    asked = [f for f in proposed if len(distinct([now, f], view.surface, apart_mm)) > 1]
    if not asked:
        return False
    demands = GUESSED if now.guessed else TOLD
    within = np.geomspace(2.0 * REACH_SPACINGS, REACH_SPACINGS, 8) * view.spacing_mm
    whole = Surface.of(*_joined(chosen, rest))
    found = [
        judged_by_all(view, settled(whole, view.surface, f.pose, within, FINE_POINTS), chosen, rest)
        for f in asked
    ]
    return any(
        _rivals(now, f, demands) and len(distinct([now, f], view.surface, apart_mm)) > 1
        for f in found
    )


def judged_by_all(
    view: View, pose: Float[np.ndarray, "4 4"], chosen: Mapping[int, View], poses: Poses
) -> Fit:
    """How a scan's pose agrees with all that are placed.

    Its overlap is with any of them. Against it is what of it contradicts any, and the largest share
    of another that it contradicts.
    """
    some = view.surface.some(FINE_POINTS)
    guessed = view.looks.guessed
    on = np.zeros(len(view.surface.points_mm[some]), dtype=bool)
    against = on.copy()
    worst = 0.0
    known = _joined({**chosen, view.number: view}, {**poses, view.number: pose}, VEIL_POINTS)
    for m, home in poses.items():
        if m == view.number:
            continue
        other = chosen[m]
        guessed |= other.looks.guessed
        spacing_mm = max(view.spacing_mm, other.spacing_mm)
        off_mm = OFF_SPACINGS * spacing_mm + OFF_SIGMAS * max(view.sigma_mm, other.sigma_mm)
        limits = (REACH_SPACINGS * spacing_mm, FREE_SPACINGS * spacing_mm, off_mm)
        there = np.linalg.inv(home) @ pose
        veil = Veil(*known, home)
        touches, contradicts = marks_on(other, view, there, some, *limits, veil)
        on |= touches
        against |= contradicts
        others = other.surface.some(FINE_POINTS)
        veil = Veil(*known, pose)
        back = marks_on(view, other, np.linalg.inv(there), others, *limits, veil)
        worst = max(worst, float(back[1].mean()))
    overlap = float(on.mean())
    return Fit(pose, (overlap, overlap), (float(against.mean()), worst), guessed)


def contradicted(chosen: Mapping[int, View], poses: Poses) -> dict[int, str]:
    """Scans that contradict the others in the end, and by how much; the worst first, then again."""
    left: dict[int, str] = {}
    kept = dict(poses)
    while len(kept) > 1:
        fits = {k: judged_by_all(chosen[k], pose, chosen, kept) for k, pose in kept.items()}
        k = max(fits, key=lambda k: max(fits[k].against))
        reason = why_not([fits[k]])
        if not reason:
            break
        left[k] = reason
        del kept[k]
    return left


def _even(chosen: Mapping[int, View], poses: Poses) -> None:
    """Share out what the poses disagree, each but the first against all others; in place."""
    for k in list(poses)[1:]:
        others = {m: pose for m, pose in poses.items() if m != k}
        within = np.array([1.0, 1.0]) * REACH_SPACINGS * chosen[k].spacing_mm
        whole = Surface.of(*_joined(chosen, others))
        poses[k] = settled(whole, chosen[k].surface, poses[k], within, FINE_POINTS)
