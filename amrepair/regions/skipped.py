"""Skipped beads: stretches of the job's own lines where rays say that no plastic is.

A line one bead wide beside a wall lies so near to the template's surface that no distance to it
tells that it is gone; samples along the line's own middle do. What follows is for the deficit.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from amrepair.arrays import Mask, Numbers, Points, Values
from amrepair.field.as_built import Evidence
from amrepair.field.near import has_near
from amrepair.frames import box_of, cells_of, unit_vectors
from amrepair.observe.rays import rays_crossing
from amrepair.observe.robust import Problem, solve
from amrepair.regions import skipped_kernels as kernels
from amrepair.regions.options import USUAL_SKIPPED, SkippedOptions
from amrepair.scans import Scan
from amrepair.template.laid import strands_hang_lower_mm
from amrepair.template.port import Template
from gcode.compiled import read_only
from gcode.stretches import in_turn, places_to_ends

LEVEL = 1e-9
TOGETHER_MM = 0.5  # points in a cell so wide are asked together
UP, FROM_ABOVE = np.array([0.0, 0.0, 1.0]), np.array([1.0, 1.0, 0.0])
RECENT_MM = 1.0  # below the highest: what lies deeper is under other beads


@dataclass(frozen=True, slots=True)
class PlannedBeads:
    """Lines that should lie where a scan looks, template frame.

    Attributes
    ----------
    start_mm, end_mm
        (n, 3) nozzle positions; a bead hangs below them by its height.
    width_mm, height_mm
        (n,) of its section, a rectangle.
    strays
        (n,) whose lines lie as they like: a support's, thin and free on both sides. None: of none.
    """

    start_mm: Points
    end_mm: Points
    width_mm: Values
    height_mm: Values
    strays: Mask | None = None

    @classmethod
    def recent(
        cls,
        start_mm: Points,
        end_mm: Points,
        section_mm2: Values,
        height_mm: Values,
        strays: Mask | None = None,
    ) -> PlannedBeads:
        """Those near the highest, of beads as a job tells them: as wide as section over height."""
        high_mm = np.maximum(start_mm[:, 2], end_mm[:, 2])
        width_mm = section_mm2 / np.maximum(height_mm, 1e-6)
        every = cls(start_mm, end_mm, width_mm, height_mm, strays)
        return every.some(high_mm > high_mm.max(initial=-np.inf) - RECENT_MM)

    def some(self, which: Mask | Int[np.ndarray, " k"]) -> PlannedBeads:
        """Some of them."""
        return PlannedBeads(
            self.start_mm[which],
            self.end_mm[which],
            self.width_mm[which],
            self.height_mm[which],
            None if self.strays is None else self.strays[which],
        )

    def samples_mm(self, step_mm: float) -> Points:
        """(p, 3) places along the middles of their tops, at most so far apart."""
        return places_to_ends(self.start_mm, self.end_mm, step_mm)[0]

    def holds(self, points_mm: Points) -> Mask:
        """Which points lie in any of them: beside its line no farther than half its width."""
        if not len(points_mm):
            return np.zeros(0, bool)
        corner = points_mm[:, :2].min(axis=0)
        cell = cells_of(points_mm[:, :2], corner, TOGETHER_MM)
        shape = cell.max(axis=0) + 1
        number = cell[:, 0] * shape[1] + cell[:, 1]
        order = np.argsort(number, kind="stable")
        first = np.searchsorted(number, np.arange(np.prod(shape) + 1), sorter=order)
        beads = (self.start_mm, self.end_mm, self.width_mm, self.height_mm)
        return kernels.held(
            read_only(points_mm), order, first, corner, TOGETHER_MM,
            (int(shape[0]), int(shape[1])), *(read_only(each) for each in beads),
        )  # fmt: skip


def skipped(
    beads: PlannedBeads,
    scan: Scan,
    evidence: Evidence,
    template: Template,
    options: SkippedOptions = USUAL_SKIPPED,
    *,
    over_mm: float = 0.0,
) -> PlannedBeads:
    """Stretches of beads that are not there.

    Parameters
    ----------
    beads
        What the job has laid last, template frame.
    scan
        In the template's frame, its sensors known; without rays nothing is said.
    over_mm
        The scanner errs by a line's height over less: views together tell over so much.
    """
    paths = _Paths.of(beads, options)
    lines, line = paths.lines, paths.line
    planned, together = _Samples.planned(paths), 0
    if evidence.has_rays and len(line):
        together = _enough_together(paths, planned, scan, over_mm, options)
    if not together:
        return lines.some(np.zeros(len(lines.width_mm), dtype=bool))
    # the emptiest of all rays cost little; only where they say "open" all of them are asked
    ask = np.flatnonzero(evidence.rays_say(planned.middle_mm) > 0)
    samples = planned.some(ask).as_laid(beads, evidence, template, options)
    ask, samples = ask[samples.rays_mm > 0], samples.some(samples.rays_mm > 0)
    opens = np.full(len(line), -1.0)
    opens[ask] = _by_views(samples, planned, scan, template, options)
    less = max(together // 2, options.samples_together)  # over which it must be the surer
    whole, part = (_together(opens, paths.path, count) for count in (together, less))
    share = options.gone_erring if over_mm else options.gone_share
    gone = (whole >= share) | (part >= options.sure_share)
    kept = paths.kept(gone, np.full(len(line), options.least_stretch_mm))
    found = paths.stretches(kept)
    if not len(found.width_mm):
        return found
    # what lies under such a stretch is seen through it
    gone |= found.holds(planned.middle_mm + 2.0 * planned.half_mm[:, None] * UP) & (part > 0)
    # where the extruder has slipped in a layer it is likelier to have slipped there again
    high_mm, slipped_mm = (np.maximum(b.start_mm[:, 2], b.end_mm[:, 2]) for b in (lines, found))
    off_mm = np.abs(high_mm[:, None] - np.unique(slipped_mm))
    again = (off_mm < options.same_layer_mm).any(axis=1)
    least_mm = np.where(again, options.least_again_mm, options.least_stretch_mm)[line]
    return paths.stretches(paths.grown(paths.kept(gone, least_mm), opens, options))


@dataclass(frozen=True, slots=True)
class _Paths:
    """Lines that go on from one another without a corner, as one: curves are many short lines.

    Attributes
    ----------
    lines
        Those of paths that are long enough.
    ends_mm
        (n + 1,) length of all lines before each, and of all.
    path, at_mm, step_mm, line, share
        (m,) samples along the paths: the path, how far along all lines, the distance between two,
        the line, and where on it from 0 to 1.
    """

    lines: PlannedBeads
    ends_mm: Float[np.ndarray, " _k"]
    path: Numbers
    at_mm: Values
    step_mm: Values
    line: Numbers
    share: Values

    @classmethod
    def of(cls, beads: PlannedBeads, options: SkippedOptions) -> _Paths:
        """Paths of beads in the order in which they are laid, sampled step by step."""
        over = beads.end_mm - beads.start_mm
        length_mm = np.linalg.norm(over, axis=1)
        begins = np.ones(len(length_mm), dtype=bool)
        joined = np.abs(beads.start_mm[1:] - beads.end_mm[:-1]).max(axis=1) < options.joined_mm
        along = np.einsum("ij,ij->i", over[1:], over[:-1])
        begins[1:] = ~joined | (along < options.straight_on * length_mm[1:] * length_mm[:-1])
        path = np.cumsum(begins) - 1
        # nothing begins in a shorter path, but what is gone goes on round its corners
        chain = np.concatenate([[0], np.cumsum(~joined)])[: len(length_mm)]
        keep = np.bincount(chain, length_mm)[chain] >= options.least_stretch_mm
        lines, length_mm = beads.some(keep), length_mm[keep]
        path = np.unique(path[keep], return_inverse=True)[1]
        ends_mm = np.concatenate([[0.0], np.cumsum(length_mm)])
        first = np.searchsorted(path, np.arange(path.max(initial=-1) + 1))
        path_mm = np.bincount(path, length_mm)
        count = np.ceil(path_mm / options.sample_step_mm).astype(np.int64)
        of, number = in_turn(count)
        step_mm = (path_mm / np.maximum(count, 1))[of]
        at_mm = ends_mm[first[of]] + (number + 0.5) * step_mm
        line = np.searchsorted(ends_mm[1:], at_mm)
        share = (at_mm - ends_mm[line]) / length_mm[line]
        return cls(lines, ends_mm, of, at_mm, step_mm, line, share)

    @property
    def middles_mm(self) -> Points:
        """(m, 3) middles of the lines where the samples are."""
        lines, line = self.lines, self.line
        over_mm = (lines.end_mm - lines.start_mm)[line]
        middle_mm = lines.start_mm[line] + self.share[:, None] * over_mm
        middle_mm[:, 2] -= 0.5 * lines.height_mm[line]
        return middle_mm

    def kept(self, gone: Mask, least_mm: Values) -> Mask:
        """Neighbouring samples that say so, over a length."""
        a, b = self._runs(gone, self.path)
        long = (b - a + 1) * self.step_mm[a] >= least_mm[a]
        found = np.zeros(len(gone), dtype=bool)
        for first, last in zip(a[long], b[long], strict=True):
            found[first : last + 1] = True
        return found

    def grown(self, kept: Mask, gone: Values, options: SkippedOptions) -> Mask:
        """Stretches go on, round corners too, as long as the next samples on the whole say so.

        `gone` is above 0 where less than half of a bead is there. Where a stretch is known to have
        slipped that is enough; nothing begins by it.
        """
        apart_mm = np.abs(self.lines.start_mm[1:] - self.lines.end_mm[:-1]).max(axis=1)
        chain = np.concatenate([[0], np.cumsum(apart_mm >= options.joined_mm)])[self.line]
        open_on = kept | (_best_mean(gone, chain, options.samples_together) > 0)
        found = np.zeros_like(kept)
        for a, b in zip(*self._runs(open_on, chain), strict=True):
            mine = np.arange(a, b + 1)
            seen = mine[kept[a : b + 1] | (gone[a : b + 1] > 0)]  # an end that is there is none
            if kept[a : b + 1].any():
                found[seen[0] : seen[-1] + 1] = True
        return found

    @staticmethod
    def _runs(pick: Mask, of: Numbers) -> tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"]]:
        """First and last of neighbouring samples that are picked, of one path or chain."""
        at = np.flatnonzero(pick)
        begins = np.ones(len(at), dtype=bool)
        begins[1:] = (np.diff(at) > 1) | (np.diff(of[at]) != 0)
        return at[begins], at[np.roll(begins, -1)]  # one ends where the next begins

    def stretches(self, gone: Mask) -> PlannedBeads:
        """Neighbouring samples that say so, as one bead for each line of theirs."""
        a, b = self._runs(gone, self.path)
        from_mm, to_mm = (
            self.at_mm[k] + sign * self.step_mm[k] for k, sign in ((a, -0.5), (b, 0.5))
        )
        inner = self.ends_mm[1:-1]
        first, last = np.searchsorted(inner, from_mm + LEVEL), np.searchsorted(inner, to_mm - LEVEL)
        count = last - first + 1
        which = np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())
        length_mm = np.diff(self.ends_mm)[which]
        low, high = (
            np.clip((np.repeat(mm, count) - self.ends_mm[which]) / length_mm, 0.0, 1.0)[:, None]
            for mm in (from_mm, to_mm)
        )
        lines = self.lines.some(which)
        over = lines.end_mm - lines.start_mm
        return replace(
            lines, start_mm=lines.start_mm + low * over, end_mm=lines.start_mm + high * over
        )


@dataclass(frozen=True, slots=True)
class _Samples:
    """Looks at lines of which rays say that they are open.

    Attributes
    ----------
    middle_mm
        (k, 3) the line's middle, as its walls stand and as low as it was laid.
    half_mm, width_mm, along
        (k,) half its height, its width, and (k, 2) its way as seen from above.
    sunk_mm
        (k,) how much lower than its layer it was laid.
    rays_mm
        (k,) how far in the open rays say that the middle lies.
    strays
        (k,) of lines that lie as they like.
    """

    middle_mm: Points
    half_mm: Values
    width_mm: Values
    along: Float[np.ndarray, "k 2"]
    sunk_mm: Values
    rays_mm: Values
    strays: Mask

    @classmethod
    def planned(cls, paths: _Paths) -> _Samples:
        """Those along paths, as the job has them: of rays nothing is known yet."""
        lines, line = paths.lines, paths.line
        half_mm, width_mm = 0.5 * lines.height_mm[line], lines.width_mm[line]
        over_mm = (lines.end_mm - lines.start_mm)[line, :2]
        along = over_mm / np.maximum(np.linalg.norm(over_mm, axis=1), LEVEL)[:, None]
        sunk_mm, rays_mm = np.zeros((2, len(line)))
        strays = np.zeros(len(line), bool) if lines.strays is None else lines.strays[line]
        return cls(paths.middles_mm, half_mm, width_mm, along, sunk_mm, rays_mm, strays)

    def as_laid(
        self, beads: PlannedBeads, evidence: Evidence, template: Template, options: SkippedOptions
    ) -> _Samples:
        """Where walls stand and lines on strands lie, and what rays say there."""
        middle_mm, sunk_mm = self.middle_mm, self.sunk_mm
        if len(middle_mm):
            middle_mm = middle_mm + _wall_shift(middle_mm, evidence, template, options)
            top_mm = middle_mm + self.half_mm[:, None] * UP
            hanging = _Hanging.of(beads, top_mm, template, options)
            high_mm = 2.0 * self.half_mm
            sunk_mm = _sunk_mm(top_mm, self.width_mm, high_mm, hanging, evidence, options)
            middle_mm[:, 2] -= sunk_mm
        rays_mm = evidence.rays_say(middle_mm)
        return replace(self, middle_mm=middle_mm, sunk_mm=sunk_mm, rays_mm=rays_mm)

    def some(self, which: Mask | Int[np.ndarray, " q"]) -> _Samples:
        """Some of them."""
        return _Samples(*(getattr(self, each.name)[which] for each in fields(self)))

    def held(self, template: Template, options: SkippedOptions) -> Numbers:
        """(k,) of so many places across each line how many rest on the layer below.

        None where nothing is below its middle: it hangs.
        """
        below_mm = self.middle_mm - 2.0 * self.half_mm[:, None] * UP
        aside_mm = self.width_mm[:, None] * self.along[:, ::-1] * np.array([-1.0, 1.0])
        rest = np.zeros((len(below_mm), options.held_places), bool)
        middles = (np.arange(options.held_places) + 0.5) / options.held_places - 0.5
        for place, share in enumerate(middles):
            under_mm = below_mm.copy()
            under_mm[:, :2] += share * aside_mm
            rest[:, place] = template.distance(under_mm) <= 0
        return np.where(rest[:, options.held_places // 2], rest.sum(axis=1), 0)


def _wall_shift(
    middle_mm: Points, evidence: Evidence, template: Template, options: SkippedOptions
) -> Points:
    """How much farther in than planned the walls at each sample stand.

    A part that has shrunk, or is laid a little aside, shows each wall farther in: its outermost
    lines are there, that much farther in too. The wall below tells; a line that is gone does not
    move it. Where too little of a wall is below, in the first layers, all walls together do.
    """
    shift = np.zeros_like(middle_mm)
    walls = _Walls.of(evidence, template, float(middle_mm[:, 2].max(initial=-np.inf)), options)
    low_mm = float(middle_mm[:, 2].max(initial=-np.inf)) - options.below_line_mm
    below = walls.some(walls.place_mm[:, 2] < low_mm)
    same, near, outward = below.beside(middle_mm, options)
    ask = np.flatnonzero(same.sum(axis=1) >= options.least_wall_cells)
    deviation_mm = np.append(below.deviation_mm, 0.0)[near[ask]]
    farther_mm = np.nanmedian(np.where(same[ask], deviation_mm, np.nan), axis=1)
    shift[ask, :2] = np.minimum(farther_mm, 0.0)[:, None] * outward[ask]
    rest = np.setdiff1d(np.arange(len(middle_mm)), ask)
    beside = np.zeros(len(rest), bool)
    for turn_rad in np.arange(0.0, 2.0 * np.pi, 0.25 * np.pi):
        way_mm = options.beside_wall_mm * np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0])
        beside |= template.distance(middle_mm[rest] + way_mm) > 0
    rest = rest[beside]
    if len(rest) and len(walls.place_mm):
        shift[rest, :2] = walls.moved_by(middle_mm[rest, :2], options)
    return shift


@dataclass(frozen=True, slots=True)
class _Walls:
    """Cells on upright walls, down to some depth below the lines: places, ways out, deviations."""

    place_mm: Points
    outward: Float[np.ndarray, "n 2"]
    deviation_mm: Values

    @classmethod
    def of(
        cls, evidence: Evidence, template: Template, high_mm: float, options: SkippedOptions
    ) -> _Walls:
        """Those that lie no farther off than a part shrinks."""
        s = evidence.surfels
        deep_mm = high_mm - options.below_line_mm - options.wall_mm
        which = np.flatnonzero(
            (s.place_mm[:, 2] > deep_mm) & (np.abs(s.deviation_mm) < options.most_shift_mm)
        )
        outward = unit_vectors(template.distance_and_gradient(s.place_mm[which])[1])
        wall = np.abs(outward[:, 2]) < options.upright_wall
        return cls(s.place_mm[which[wall]], outward[wall, :2], s.deviation_mm[which[wall]])

    def some(self, pick: Mask) -> _Walls:
        """Some of them."""
        return _Walls(self.place_mm[pick], self.outward[pick], self.deviation_mm[pick])

    def beside(
        self, middle_mm: Float[np.ndarray, "m 3"], options: SkippedOptions
    ) -> tuple[Bool[np.ndarray, "m k"], Int[np.ndarray, "m k"], Float[np.ndarray, "m 2"]]:
        """(m, k) of the nearest cells those of the nearest one's wall; and (m, 2) its way out."""
        near = cKDTree(self.place_mm[:, :2]).query(
            middle_mm[:, :2], k=options.wall_cells, distance_upper_bound=options.beside_wall_mm
        )[1]
        outward = np.vstack([self.outward, np.zeros(2)])[near]  # no neighbour is of no wall
        same = np.einsum("akx,ax->ak", outward, outward[:, 0]) > options.same_wall
        return same, near, outward[:, 0]

    def moved_by(
        self, at_mm: Float[np.ndarray, "m 2"], options: SkippedOptions
    ) -> Float[np.ndarray, "m 2"]:
        """(m, 2) how places have moved by the shift, turn and shrinkage that walls agree on."""
        low, high = box_of(self.place_mm)[:, :2]
        reach_mm = max(0.5 * float((high - low).max()), LEVEL)
        shrinks_mm = options.shrinks_ratio * reach_mm
        prior_mm = np.array([*[options.most_shift_mm] * 3, shrinks_mm, shrinks_mm])

        def ways(place_mm: Float[np.ndarray, "p d"]) -> Float[np.ndarray, "p 2 5"]:
            x, y = (place_mm[:, :2] - 0.5 * (low + high)).T / reach_mm
            none, one = np.zeros_like(x), np.ones_like(x)
            rows = np.array([[one, none, -y, x, none], [none, one, x, none, y]])
            return np.moveaxis(rows, 2, 0) * prior_mm

        design = np.einsum("px,pxu->pu", self.outward, ways(self.place_mm))
        share = np.full(len(design), options.wall_share)
        found = solve(Problem(design, self.deviation_mm, share, options.wall_off_mm))
        return np.asarray(ways(at_mm) @ found.unknown)


@dataclass(frozen=True, slots=True)
class _Hanging:
    """Nozzle positions at which beads hang, and their widths and heights."""

    place_mm: Points
    width_mm: Values
    height_mm: Values

    @classmethod
    def of(
        cls, beads: PlannedBeads, top_mm: Points, template: Template, options: SkippedOptions
    ) -> _Hanging:
        """Where nothing but a sliver of a bead rests on the layer below, about tops of lines.

        A line that sticks out of the layer below rests on it by the rest of its width, however far
        the one below that is from reaching there: walls that lean, and what closes over a hole.
        """
        place_mm, which = places_to_ends(beads.start_mm, beads.end_mm, options.sample_step_mm)
        reach_mm = options.sunk_reach_mm + float(beads.width_mm.max(initial=0.0))
        near = has_near(place_mm * FROM_ABOVE, top_mm * FROM_ABOVE, reach_mm)
        place_mm, which = place_mm[near], which[near]
        over_mm = (beads.end_mm - beads.start_mm)[:, :2]
        along = over_mm / np.maximum(np.linalg.norm(over_mm, axis=1), LEVEL)[:, None]
        rests_mm = (0.5 - options.held_share) * beads.width_mm[:, None]
        aside_mm = (rests_mm * along[:, ::-1] * np.array([-1.0, 1.0]))[which]
        width_mm, height_mm = beads.width_mm[which], beads.height_mm[which]
        below_mm = place_mm - 1.5 * height_mm[:, None] * UP
        # lower lies the bed, or what nobody knows
        hangs = np.flatnonzero(below_mm[:, 2] > template.bounds_mm[0, 2])
        for side in (0.0, -1.0, 1.0):
            under_mm = below_mm[hangs]
            under_mm[:, :2] += side * aside_mm[hangs]
            hangs = hangs[template.distance(under_mm) > 0]
        return cls(place_mm[hangs], width_mm[hangs], height_mm[hangs])

    def under(self, top_mm: Points, options: SkippedOptions) -> Mask:
        """Which tops of lines lie on layers that were laid on it, and hang not themselves."""
        found = np.zeros(len(top_mm), dtype=bool)
        if not len(top_mm) or not len(self.width_mm):
            return found
        pairs = cKDTree(top_mm[:, :2]).sparse_distance_matrix(
            cKDTree(self.place_mm[:, :2]), float(self.width_mm.max()), output_type="ndarray"
        )
        top, hanging = pairs["i"], pairs["j"]
        layers = (top_mm[top, 2] - self.place_mm[hanging, 2]) / self.height_mm[hanging]
        found[top[(layers > 0.5) & (layers < options.sunk_layers + 0.5)]] = True
        found[top[np.abs(layers) <= 0.5]] = False
        return found


def _sunk_mm(
    top_mm: Points,
    width_mm: Values,
    height_mm: Values,
    hanging: _Hanging,
    evidence: Evidence,
    options: SkippedOptions,
) -> Values:
    """How much lower than its layer each sample's line lies because it was laid on strands.

    What hangs is round: of its plastic some lies below its layer, and what is laid on it fills
    the grooves between strands first. So the layers over a bridge or over lettering are all lower,
    by no more than that; by how much tells what was seen around. What is gone lies lower still.
    """
    found_mm = np.zeros(len(top_mm))
    which = np.flatnonzero(hanging.under(top_mm, options))
    if not len(which):
        return found_mm
    top_mm, height_mm = top_mm[which], height_mm[which]
    most_mm = strands_hang_lower_mm(width_mm[which], height_mm)
    place_mm, reach_mm = evidence.surfels.place_mm, options.sunk_reach_mm
    off_mm = cKDTree(top_mm).query(place_mm, distance_upper_bound=reach_mm)[0]
    place_mm = place_mm[np.isfinite(off_mm)]
    place_mm = place_mm[hanging.under(place_mm, options)]
    near = cKDTree(place_mm[:, :2]).query(
        top_mm[:, :2], k=options.sunk_cells, distance_upper_bound=reach_mm
    )[1]
    lower_mm = top_mm[:, 2:] - np.append(place_mm[:, 2], np.nan)[near]
    mine = np.abs(lower_mm - most_mm[:, None]) < height_mm[:, None]  # not of another layer
    lower_mm = np.sort(np.where(mine, lower_mm, np.inf), axis=1)
    here_mm, cells = 0.5 * most_mm, mine.sum(axis=1)
    for count in range(options.least_sunk_cells, options.sunk_cells + 1):
        told = cells == count
        here_mm[told] = np.quantile(lower_mm[told, :count], options.sunk_share, axis=1)
    found_mm[which] = np.clip(here_mm, 0.0, most_mm)
    return found_mm


def _by_views(
    samples: _Samples, planned: _Samples, scan: Scan, template: Template, options: SkippedOptions
) -> Values:
    """(k,) how open a line is by all views, each once, in halves of a line.

    A scanner that errs does so view by view: one that sees a line gone is outvoted. What nobody
    looked into is there, and a view that does not see it takes half of it to be.
    """
    met, deep, came = _met(samples, scan, options)
    sag = _sag(samples, planned, scan, template, options)
    assert scan.sensor_index is not None
    open_by = np.clip(2.0 * (deep - sag[met]), -1.0, 1.0)
    return _each_view_once(open_by, met, scan.sensor_index[came], len(sag))


def _each_view_once(
    value: Values, met: Numbers, view: Int[np.ndarray, " n"], samples: int
) -> Float[np.ndarray, " k"]:
    """(k,) mean of the means of the views, of which so many see a sample as of most; −1 of none."""
    views = int(view.max(initial=0)) + 1
    seen = np.bincount(met * views + view, minlength=samples * views).reshape(samples, views)
    total = np.bincount(met * views + view, value, samples * views).reshape(samples, views)
    count = (seen > 0).sum(axis=1)
    usual = float(np.median(count[count > 0])) if len(met) else 1.0
    mean = (total / np.maximum(seen, 1)).sum(axis=1) / np.maximum(count, usual)
    return np.where(count > 0, mean, -1.0)


def _enough_together(
    paths: _Paths, planned: _Samples, scan: Scan, over_mm: float, options: SkippedOptions
) -> int:
    """So many samples that no stretch of the top lines is as much too high as a gone one too low.

    At least over a length; 0 where that is not to be had. A scanner's errors are both, and no line
    that is gone lies too high.
    """
    if not over_mm:
        return options.samples_together
    if not np.isfinite(over_mm):
        return 0
    high_mm = planned.middle_mm[:, 2]
    which = np.flatnonzero(high_mm > high_mm.max() - options.same_layer_mm)
    met, deep, came = _met(planned.some(which), scan, options)
    assert scan.sensor_index is not None
    closed = np.clip(-2.0 * (deep + 1.0), -1.0, 1.0)
    closes = _each_view_once(closed, met, scan.sensor_index[came], len(which))
    together = int(np.ceil(max(over_mm, options.errs_along_mm) / options.sample_step_mm))
    while together * options.sample_step_mm <= options.most_together_mm:
        whole, part = (
            _best_mean(closes, paths.path[which], count).max()
            for count in (together, together // 2)
        )
        if whole < options.gone_erring and part < options.sure_share:
            return together
        together *= 2
    return 0


def _sag(
    samples: _Samples, planned: _Samples, scan: Scan, template: Template, options: SkippedOptions
) -> Values:
    """(k,) how much lower than planned each line lies if it is there, in heights of a line.

    One that rests on the layer below lies where it should, and one that hangs may lie lower by its
    height; so may one that strays: rays see both its sides, and run past it. A line over the rim of
    what is below, as in walls that lean and in cubic infill, spreads over it: how low it lies then,
    lines about that are held alike tell, of which so many are there.
    """
    held = samples.held(template, options)
    sag = np.where((held == 0) | samples.strays, 1.0, 0.0)
    rim = (held > 0) & (held < options.held_places) & ~samples.strays
    if not rim.any():
        return sag
    alike = planned.held(template, options)
    z_mm, other_mm = (np.round(each.middle_mm[:, 2], 6) for each in (samples, planned))
    for high_mm, held_by in np.unique(np.column_stack([z_mm, held])[rim], axis=0):
        mine = np.flatnonzero((z_mm == high_mm) & (held == held_by))
        others = planned.some((other_mm == high_mm) & (alike == held_by))
        met, deep, _ = _met(others, scan, options)
        order = np.lexsort((deep, met))
        which, first, count = np.unique(met[order], return_index=True, return_counts=True)
        if not len(which):
            continue
        lies = 0.5 + deep[order][first + count // 2]
        near = cKDTree(others.middle_mm[which, :2]).query(
            samples.middle_mm[mine, :2], k=np.arange(1, min(len(which), options.alike) + 1)
        )[1]
        sag[mine] = np.clip(np.quantile(lies[near], options.there_of_alike, axis=1), 0.0, 1.0)
    return sag


def _met(samples: _Samples, scan: Scan, options: SkippedOptions) -> tuple[Numbers, Values, Numbers]:
    """(r,) samples whose lines' cores rays met, how deep below the middle each ended, and which.

    In heights of a line. A ray counts where it crosses the height of the line's middle, however far
    aside the floor lies that it saw: between strands that hang apart slanting rays see all of what
    is under them.
    """
    core_mm = options.under_share * samples.width_mm
    reach_mm = float(np.hypot(core_mm.max(initial=0.0), 0.5 * options.sample_step_mm))
    height_mm = np.round(samples.middle_mm[:, 2], 6)
    none = np.zeros(0, np.int64)
    found: list[tuple[Numbers, Values, Numbers]] = [(none, np.zeros(0), none)]
    for z_mm in np.unique(height_mm):
        mine = np.flatnonzero(height_mm == z_mm)
        place_mm, thick_mm = samples.middle_mm[mine], 2.0 * samples.half_mm[mine]
        came, crossing_mm = rays_crossing(
            scan, place_mm[:, :2], reach_mm, z_mm, z_mm + options.errs_over * float(thick_mm.max())
        )
        near = cKDTree(place_mm[:, :2]).query(crossing_mm, distance_upper_bound=reach_mm)[1]
        met = near < len(mine)
        near, crossing_mm, points_mm = near[met], crossing_mm[met], scan.points_mm[came[met]]
        off_mm = crossing_mm - place_mm[near, :2]
        x, y = samples.along[mine[near]].T
        deep = (z_mm - points_mm[:, 2]) / thick_mm[near]
        in_core = np.abs(off_mm[:, 0] * y - off_mm[:, 1] * x) < core_mm[mine[near]]
        in_core &= deep >= -options.errs_over
        found.append((mine[near[in_core]], deep[in_core], came[met][in_core]))
    which, depths, rays = (np.concatenate(each) for each in zip(*found, strict=True))
    return which, depths, rays


def _together(value: Values, path: Numbers, together: int) -> Values:
    """(m,) `_best_mean` where a sample says "gone" itself: an end that is there does not belong."""
    return np.where(value > 0, _best_mean(value, path, together), -np.inf)


def _best_mean(value: Values, of: Numbers, together: int) -> Values:
    """(m,) the best mean of so many neighbours of one path that each belongs to."""
    m = len(value)
    whole = np.full(m, -np.inf)
    if m < together:
        return whole
    total = np.concatenate([[0.0], np.cumsum(value)])
    mean = (total[together:] - total[:-together]) / together
    mean[of[together - 1 :] != of[: m - together + 1]] = -np.inf
    for k in range(together):
        np.maximum(whole[k : k + len(mean)], mean, out=whole[k : k + len(mean)])
    return whole
