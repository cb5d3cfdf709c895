"""Options of the deficit: how solids and the heights of what stands are made, each number once."""

from __future__ import annotations

from dataclasses import dataclass, field

from amrepair.regions.options import SkippedOptions


@dataclass(frozen=True, slots=True)
class VoxelOptions:
    """The grids of distances around defects on which solids are made.

    Attributes
    ----------
    most
        About how many samples one grid has at most.
    finest_mm, coarsest_mm
        Least and largest distance between samples.
    across_ratio, least_ratio
        How many samples lie across a defect's depth, and the least number where a box is so large
        that `most` limits it.
    margin_mm
        Margin of a box around what was found.
    film_mm, even_mm, least_film_mm2, facing
        A film beside a deep defect is sampled as finely as if it were alone. It is a film if it is
        thinner than `film_mm`, even to `even_mm`, larger than `least_film_mm2`, and faces out of
        the template (`facing`, a cosine).
    path_step_mm
        Step along the straight lines from a void's floor to its mouth.
    sliver_ratio
        Under the top of the layer just printed: share of the threshold above which a place counts
        as missing if the nearest surfel is labelled so.
    crumb_mm3
        Smaller pieces are dropped: they are what marching cubes makes of noise at a rim.
    """

    most: int = 1_000_000
    finest_mm: float = 0.05
    coarsest_mm: float = 0.25
    across_ratio: float = 4.0
    least_ratio: float = 2.5
    margin_mm: float = 1.0
    film_mm: float = 0.5
    even_mm: float = 0.05
    least_film_mm2: float = 5.0
    facing: float = 0.5
    path_step_mm: float = 1.0
    sliver_ratio: float = 0.25
    crumb_mm3: float = 0.02


@dataclass(frozen=True, slots=True)
class HeightOptions:
    """The height field of what stands, from the scan alone and from scan and solids together.

    Attributes
    ----------
    cell_mm
        Width of the columns of the scan's own height field.
    unseen_margin_mm
        Unseen columns count as solid up to the printed height, or the template, plus this margin.
    beside_part_mm
        Margin of the field around the part: more than the radius of a nozzle's cone, so that what
        stands beside the part is in it.
    top_band_mm
        Points within this band below a column's topmost point are one surface with its noise.
    gap_mm
        Where no wider square fits, an unseen patch is a gap of sampling or a slot, out of which
        nothing stands that would not have been seen, and into which no nozzle goes.
    fine_cell_mm, most_fine_cells
        Width and largest number of columns of the fine field, which has the solids' walls.
    by_wall_cells
        How far beside a wall the scan's columns are not trusted, in columns of the scan: one that
        the wall's noise touches, and a gap beside it that took its height.
    trust_mm
        The scan overrules the solids where it stands out of them by more than this: their
        tolerance, and noise.
    noise_mm
        Noise of a column with many points.
    chance_mm
        How far a column with a single point may be off: of some thousand under the head one is.
    film_mm
        Thinner material over a void is the solids' rounding at its rim, and ignored: two layers.
    least_film_mm
        The thinnest film that the scan can tell from nothing.
    fin_cells, unseen_fin_cells, chance_cells
        In fine columns: a fin is thinner than a bead; an unseen fin is thinner than two, of which
        points would have been seen; and so few columns without a point are chance.
    most_steps_down
        In how many steps, at most, unseen columns are lowered along rays.
    cut_beside_mm, cut_strays
        A scan was cut to its part if of the columns so far beside it and farther no more than this
        share hold a point: strays.
    off_sigma
        A point stands out if it lies this many standard deviations of the scan's noise above all
        surface that is as near to it, seen from above. With 2 one in fifty of the thousands of
        points on walls beside a defect would, and each keeps the head away.
    crest_sigma
        The highest point on something that stands out lies so many standard deviations above it.
    others_near, beside_spacings
        A point counts only if so many others lie within so many point spacings: on a flat surface
        4 π are expected, along an edge four, and of a real scanner's strays, which are up to 2 % of
        the points, hardly any has as many.
    """

    cell_mm: float = 0.25
    unseen_margin_mm: float = 1.0
    beside_part_mm: float = 8.0
    top_band_mm: float = 0.3
    gap_mm: float = 1.0
    fine_cell_mm: float = 0.1
    most_fine_cells: int = 2_000_000
    by_wall_cells: float = 2.5
    trust_mm: float = 0.3
    noise_mm: float = 0.1
    chance_mm: float = 0.2
    film_mm: float = 0.4
    least_film_mm: float = 0.1
    fin_cells: int = 2
    unseen_fin_cells: int = 8
    chance_cells: int = 5
    most_steps_down: int = 64
    cut_beside_mm: float = 1.0
    cut_strays: float = 0.01
    off_sigma: float = 3.5
    crest_sigma: float = 2.0
    others_near: int = 3
    beside_spacings: float = 2.0


@dataclass(frozen=True, slots=True)
class WallOptions:
    """Walls, crests and rims beside what is missing; cells are columns of the fine field.

    Attributes
    ----------
    step_mm
        A larger step from column to column is a wall, not a slope.
    beside_cells
        How far around what is missing walls are sharpened.
    radius_mm
        Points within this distance of a column tell its wall's plane; a round wall 4 mm across
        leaves its plane there by no more than noise.
    below_top_sigma, over_foot_sigma
        Points nearer than this to a wall's top or foot, in the scan's noise, belong to what lies
        above or below it, and are left out.
    most_spread_sigma
        Points that scatter more than this about their plane, in the scan's noise, are of more than
        one wall.
    inside_sigma
        A point deeper than this inside the template, in the scan's noise, lies on broken surface.
    most_slant
        A wall's normal rises by at most this cosine: it is steeper than 75°.
    crest_cells, crest_reach_cells
        A crest is thinner than this, a bead; and it is followed so far along, from one seen point
        to the next.
    splinter_mm
        A crest lower than designed by no more than this has only lost its points.
    steep_mm
        A face of what is missing is steep where it falls by this from one column to the next (83°).
    rounded_mm, rounded_cells, as_designed_mm, foot_cells
        The solids' rounding may have lowered a lip by up to `rounded_mm`, over `rounded_cells`. A
        column counts as designed within `as_designed_mm`, and the foot of a face is looked for
        within `foot_cells` of it.
    edge_mm, rounded_spacings
        A larger fall from column to column is the edge of a top; up to `rounded_spacings` point
        spacings from it tops are rounded off.
    sound_mm, least_sound, uneven_mm
        Beyond that a top is looked at over `sound_mm`, at `least_sound` columns or more; it is
        even if it varies by no more than `uneven_mm`.
    steepest
        Rise by run of what counts as a floor: 63°, about as steep as plastic wears.
    bare_p
        The chance at most that what stands shows no point where the scan should have some.
    behind_cells, deepest_cells
        A column that the solids left standing goes only if broken surface lies within so many
        columns behind it; and so many go at most, one behind the other. Their rounding is no wider.
    """

    step_mm: float = 0.3
    beside_cells: int = 3
    radius_mm: float = 0.4
    below_top_sigma: float = 2.5
    over_foot_sigma: float = 4.0
    most_spread_sigma: float = 1.75
    inside_sigma: float = 2.0
    most_slant: float = 0.25
    crest_cells: int = 4
    crest_reach_cells: int = 2
    splinter_mm: float = 0.3
    steep_mm: float = 0.8
    rounded_mm: float = 0.4
    rounded_cells: int = 3
    as_designed_mm: float = 0.1
    foot_cells: int = 2
    edge_mm: float = 0.4
    rounded_spacings: float = 1.5
    sound_mm: float = 0.8
    least_sound: int = 20
    uneven_mm: float = 0.04
    steepest: float = 2.0
    bare_p: float = 0.001
    behind_cells: int = 5
    deepest_cells: int = 6


@dataclass(frozen=True, slots=True)
class DeficitOptions:
    """Settings of a deficit; a result records those it was made with.

    Attributes
    ----------
    bead_mm3
        The smallest bead that can be placed: 0.45 × 0.2 mm, as long as two nozzle widths.
    early_mm3
        From this missing volume on heights are made at once, beside the solids, since they will be
        asked for; the crumbs of a clean layer are never so large together.
    skipped, voxels, heights, walls
        Options of the stages.
    """

    bead_mm3: float = 0.08
    early_mm3: float = 0.5
    skipped: SkippedOptions = field(default_factory=SkippedOptions)
    voxels: VoxelOptions = field(default_factory=VoxelOptions)
    heights: HeightOptions = field(default_factory=HeightOptions)
    walls: WallOptions = field(default_factory=WallOptions)


DEFAULT_DEFICIT = DeficitOptions()
"""The default of the loop and the command line."""
