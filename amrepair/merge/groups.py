"""From poses of pairs to groups of views that hold together: the pose graph, grown by agreement.

Every view begins as a group of its own. The two groups that are surest of each other become one,
then the next: most of the smaller on what the other saw, next to nothing of any view in another's
free space, and no second pose nearly as good. A pair that is wrong contradicts what the other pairs
of its groups say, and is outvoted (cycles: Zach, Klopschitz and Pollefeys, CVPR 2010). What never
becomes sure stays a group of its own, and is said. A join that was wrong shows in that neither half
fits anywhere any more: where half of a group is surer of another group than of its own other half,
the join is undone.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from amrepair.arrays import Matrix
from amrepair.merge.match import (
    FreeSpace,
    apart,
    distinct,
    featured,
    searched,
)
from amrepair.merge.options import MergeOptions
from amrepair.merge.threads import in_threads
from amrepair.merge.views import Fit, Placed, View, joined, judged, settled
from gcode.progress import Progress, silent

Pairs = dict[tuple[int, int], list[Fit]]


@dataclass(frozen=True, slots=True)
class _Join:
    """Two groups that became one: what they were, and the score that held them together."""

    halves: tuple[Placed, Placed]
    score: float


@dataclass(frozen=True, slots=True)
class _Surest:
    """Of many pairs of groups the one that is surest: by their places in a list, and how."""

    margin: float
    fixed: int
    moving: int
    fit: Fit


@dataclass(slots=True)
class Graph:
    """Views, the poses that their pairs propose, and the groups so far.

    Attributes
    ----------
    search
        Tries every rotation of a pair.
    pairs
        By numbers i < j: poses of view j in view i's frame, best first.
    searched
        Pairs that have been.
    groups
        Each by number: (4, 4) the group's frame from the view.
    """

    views: Sequence[View]
    size_mm: float
    options: MergeOptions
    search: Callable[[int, int], list[Fit]] = lambda _i, _j: []
    pairs: Pairs = field(default_factory=dict)
    searched: set[tuple[int, int]] = field(default_factory=set)
    groups: list[Placed] = field(default_factory=list)
    _judged: dict[tuple[frozenset[int], frozenset[int], int], list[Fit]] = field(
        default_factory=dict
    )
    _joins: dict[frozenset[int], _Join] = field(default_factory=dict)

    def proposed(self, fixed: Placed, moving: Placed) -> list[Matrix]:
        """Poses of one group in the other's frame, those that most pairs speak for first."""
        found: list[tuple[float, np.ndarray]] = []
        for i, j in itertools.product(fixed, moving):
            for fit in self.pairs.get((min(i, j), max(i, j)), []):
                pose = fit.pose if i < j else np.linalg.inv(fit.pose)
                whole = fixed[i] @ pose @ np.linalg.inv(moving[j])
                found.append((max(fit.score, 0.01 * fit.overlap), whole))
        surface = joined(self.views, moving, self.options.group.points)
        near_mm = self.options.same_size * self.size_mm
        kept = apart([p for _, p in sorted(found, key=lambda f: -f[0])], surface, near_mm)
        votes = [
            sum(score for score, pose in found if len(apart([one, pose], surface, near_mm)) == 1)
            for one in kept
        ]
        return [
            kept[k] for k in np.argsort(-np.array(votes), kind="stable")[: self.options.group.tried]
        ]

    def ways(self, fixed: Placed, moving: Placed) -> list[Fit]:
        """How one group may lie on another, settled and judged by all that both saw; best first."""
        asked = sum((min(i, j), max(i, j)) in self.pairs for i in fixed for j in moving)
        key = frozenset(fixed), frozenset(moving), asked
        if key in self._judged:
            return self._judged[key]
        poses = self.proposed(fixed, moving)
        fits: list[Fit] = []
        if poses:
            whole, own = (joined(self.views, g, self.options.group.points) for g in (fixed, moving))
            spacing_mm = max(self.views[k].thin_spacing_mm for k in (*fixed, *moving))
            reach_mm = self.options.reach_spacings * spacing_mm
            within = np.geomspace(2.0 * reach_mm, reach_mm, self.options.group.steps)
            there = in_threads(
                lambda p: settled(
                    whole, own, p, within, self.options.group.points, self.options.judge
                ),
                poses,
            )
            fits = [judged(self.views, fixed, moving, pose, self.options) for pose in there]
            fits = self._ranked(distinct(fits, own, self.options.same_size * self.size_mm))
        self._judged[key] = fits
        return fits

    def _ranked(self, fits: Sequence[Fit]) -> list[Fit]:
        """Those that may be taken before those that may not, then by score."""
        return sorted(fits, key=lambda fit: (fit.why_not(self.options) != "", -fit.score))

    def why_not(self, fits: Sequence[Fit]) -> str:
        """Why the best of some fits is not to be trusted; nothing where it is."""
        if not fits:
            return "fits none of the others"
        reason = fits[0].why_not(self.options)
        if reason:
            return reason
        if any(fits[0].rivals(fit, self.options) for fit in fits[1:]):
            return "fits the others in more than one way"
        return ""

    def grow(self, progress: Progress) -> None:
        """Join groups, the surest first, as long as any two are sure."""
        while len(self.groups) > 1:
            progress("place views", float(len(self.views) - len(self.groups)),
                     float(len(self.views)))  # fmt: skip
            every = itertools.combinations(range(len(self.groups)), 2)
            best = self._surest(self.groups, every)
            if best is None:
                if not self._undo_a_join():
                    return
            elif not self._has_rival(self.groups[best.fixed], self.groups[best.moving]):
                self.join(best.fixed, best.moving, best.fit)

    def _surest(self, groups: Sequence[Placed], pairs: Iterable[tuple[int, int]]) -> _Surest | None:
        """The pair of some groups whose best pose is farthest before the next; None is sure."""
        best: _Surest | None = None
        for a, b in pairs:  # the larger group stays
            fixed, moving = (a, b) if len(groups[a]) >= len(groups[b]) else (b, a)
            fits = self.ways(groups[fixed], groups[moving])
            if self.why_not(fits):
                continue
            margin = fits[0].score - (fits[1].score if len(fits) > 1 else 0.0)
            if best is None or margin > best.margin:
                best = _Surest(margin, fixed, moving, fits[0])
        return best

    def join(self, fixed: int, moving: int, fit: Fit) -> None:
        """Two groups, by their places, become one whose poses share out what they disagree."""
        halves = self.groups[fixed], self.groups[moving]
        whole = halves[0] | {k: fit.pose @ pose for k, pose in halves[1].items()}
        self._joins[frozenset(whole)] = _Join(halves, fit.score)
        kept = [group for k, group in enumerate(self.groups) if k not in (fixed, moving)]
        self.groups = [*kept, whole]
        self.even(len(kept))

    def _undo_a_join(self) -> bool:
        """Whether half of a group is surer of another group than of its other half: it goes there.

        The sum of the scores that hold the groups together grows each time, so that it ends.
        """
        for own, group in enumerate(self.groups):
            was = self._joins.get(frozenset(group))
            if was is None:
                continue
            others = [g for k, g in enumerate(self.groups) if k != own]
            apart_ = [*others, *was.halves]
            halves = range(len(others), len(apart_))
            best = self._surest(apart_, itertools.product(range(len(others)), halves))
            if best is None or best.fit.score <= was.score:
                continue
            if self._has_rival(apart_[best.fixed], apart_[best.moving]):
                return True  # more is known of that pair now: all is asked again
            self.groups = apart_
            self.join(best.fixed, best.moving, best.fit)
            return True
        return False

    def _has_rival(self, fixed: Placed, moving: Placed) -> bool:
        """Whether every rotation of the pair that shares most proposes more; asked once a pair.

        Features find one pose of a part that lies on itself in several, and say nothing of these.
        """
        between = [(min(i, j), max(i, j)) for i in fixed for j in moving]
        best = max((p for p in between if self.pairs.get(p)),
                   key=lambda p: self.pairs[p][0].score)  # fmt: skip
        if best in self.searched or len(between) > len(self.views):
            return False  # many pairs agree already: a symmetry would have to be of all of them
        self.add(best, self.search(*best))
        self.searched.add(best)
        return True

    def add(self, pair: tuple[int, int], fits: Sequence[Fit]) -> None:
        """More poses of a pair."""
        near_mm = self.options.same_size * self.size_mm
        every = [*self.pairs.get(pair, []), *fits]
        self.pairs[pair] = distinct(every, self.views[pair[1]].thin, near_mm)
        one, other = pair
        self._judged = {
            sides: said
            for sides, said in self._judged.items()
            if not any(one in a and other in b for a, b in (sides[:2], sides[1::-1]))
        }

    def even(self, number: int) -> None:
        """Share out what a group's poses disagree, each but the first against all others."""
        group = self.groups[number]
        for k in list(group)[1:]:
            others = {m: pose for m, pose in group.items() if m != k}
            reach_mm = self.options.reach_spacings * self.views[k].thin_spacing_mm
            whole = joined(self.views, others, self.options.group.points)
            within = np.array([1.0, 1.0]) * reach_mm
            group[k] = settled(
                whole,
                self.views[k].thin,
                group[k],
                within,
                self.options.group.points,
                self.options.judge,
            )


def grouped(
    views: Sequence[View],
    size_mm: float,
    options: MergeOptions,
    *,
    begun: Placed | None = None,
    progress: Progress = silent,
) -> Graph:
    """Groups of views that hold together, the largest first.

    Parameters
    ----------
    begun
        Poses that are known already, and hold.
    """
    known = begun or {}
    first = [dict(known)] if known else []
    spaces: dict[int, FreeSpace] = {}
    graph = Graph(
        views, size_mm, options, lambda i, j: searched(views, spaces, i, j, size_mm, options)
    )
    graph.groups = first + [{k: np.eye(4)} for k in range(len(views)) if k not in known]
    _ask(graph, "match features", lambda i, j: featured(views, i, j, size_mm, options), progress)
    graph.grow(progress)
    if len(graph.groups) > 1:
        _ask(graph, "try every rotation", graph.search, progress)
        graph.searched |= set(graph.pairs)
        graph.grow(progress)
    graph.groups.sort(key=lambda group: (-len(group), min(group)))
    return graph


def _ask(
    graph: Graph, stage: str, find: Callable[[int, int], list[Fit]], progress: Progress
) -> None:
    """Poses of all pairs of views that are in different groups."""
    home = {k: g for g, group in enumerate(graph.groups) for k in group}
    wanted = [
        p for p in itertools.combinations(range(len(graph.views)), 2) if home[p[0]] != home[p[1]]
    ]
    for done, (i, j) in enumerate(wanted):
        progress(stage, float(done), float(len(wanted)))
        if (i, j) not in graph.searched:
            graph.add((i, j), find(i, j))
