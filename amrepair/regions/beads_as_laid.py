"""Beads as laid: how far walls stand inside the plan, and how much lower lines on strands lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from amrepair.arrays import Mask, Points, Values
from amrepair.field.as_built import Evidence
from amrepair.field.near import has_near
from amrepair.frames import box_of, unit_vectors
from amrepair.observe.robust import Problem, solve
from amrepair.regions.bead_paths import LEVEL
from amrepair.regions.options import SkippedOptions
from amrepair.regions.planned_beads import PlannedBeads
from amrepair.template.laid import strands_hang_lower_mm
from amrepair.template.port import Template
from gcode.stretches import places_to_ends

UP, FROM_ABOVE = np.array([0.0, 0.0, 1.0]), np.array([1.0, 1.0, 0.0])


def wall_shift_mm(
    middle_mm: Points, evidence: Evidence, template: Template, options: SkippedOptions
) -> Points:
    """(m, 3) how far the walls near each sample stand inside their planned place.

    In a part that shrank or lies a little aside every wall stands farther in, and so do its
    outermost lines. The wall below a line tells by how much, since a line that is gone does not
    move it. In the first layers there is too little wall below; then shift, turn and shrinkage are
    fitted to all walls together.
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
    """Cells of the scan on upright walls: places, outward directions from above, deviations."""

    place_mm: Points
    outward: Float[np.ndarray, "n 2"]
    deviation_mm: Values

    @classmethod
    def of(
        cls, evidence: Evidence, template: Template, high_mm: float, options: SkippedOptions
    ) -> _Walls:
        """The cells down to `wall_mm` below the lines that deviate no more than a part shrinks."""
        s = evidence.surfels
        deep_mm = high_mm - options.below_line_mm - options.wall_mm
        which = np.flatnonzero(
            (s.place_mm[:, 2] > deep_mm) & (np.abs(s.deviation_mm) < options.most_shift_mm)
        )
        outward = unit_vectors(template.distance_and_gradient(s.place_mm[which])[1])
        wall = np.abs(outward[:, 2]) < options.upright_wall
        return cls(s.place_mm[which[wall]], outward[wall, :2], s.deviation_mm[which[wall]])

    def some(self, pick: Mask) -> _Walls:
        """The chosen ones."""
        return _Walls(self.place_mm[pick], self.outward[pick], self.deviation_mm[pick])

    def beside(
        self, middle_mm: Float[np.ndarray, "m 3"], options: SkippedOptions
    ) -> tuple[Bool[np.ndarray, "m k"], Int[np.ndarray, "m k"], Float[np.ndarray, "m 2"]]:
        """Of each place's nearest cells, (m, k) which belong to the nearest one's wall.

        And (m, k) their numbers, and (m, 2) the outward direction of that wall.
        """
        near = cKDTree(self.place_mm[:, :2]).query(
            middle_mm[:, :2], k=options.wall_cells, distance_upper_bound=options.beside_wall_mm
        )[1]
        outward = np.vstack([self.outward, np.zeros(2)])[near]  # no neighbour is of no wall
        same = np.einsum("akx,ax->ak", outward, outward[:, 0]) > options.same_wall
        return same, near, outward[:, 0]

    def moved_by(
        self, at_mm: Float[np.ndarray, "m 2"], options: SkippedOptions
    ) -> Float[np.ndarray, "m 2"]:
        """(m, 2) how places have moved, by a shift, turn and shrinkage fitted to all walls."""
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
class HangingBeads:
    """Places at which beads hang over air, with their widths and heights, template frame."""

    place_mm: Points
    width_mm: Values
    height_mm: Values

    @classmethod
    def of(
        cls, beads: PlannedBeads, top_mm: Points, template: Template, options: SkippedOptions
    ) -> HangingBeads:
        """Where beads near some tops rest on the layer below by no more than a sliver.

        A line that sticks out over the layer below still rests on it by the rest of its width, as
        in walls that lean and in layers that close over a hole; such a line does not hang.
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
        """(p,) which tops lie in the few layers laid on hanging beads, but hang not themselves."""
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


def sunk_below_layer_mm(
    top_mm: Points,
    width_mm: Values,
    height_mm: Values,
    hanging: HangingBeads,
    evidence: Evidence,
    options: SkippedOptions,
) -> Values:
    """(k,) how much lower than its layer each line lies because it was laid on hanging strands.

    A hanging strand is round: part of its plastic lies below its layer, and the next layers first
    fill the grooves between strands. So the layers over a bridge or over lettering lie lower, by
    no more than the strands' own sag; how much is told by what was seen of the layers around. A
    line that is gone lies lower still.
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
