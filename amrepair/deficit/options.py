"""How solids are made of what a test found, and heights of what stands: each number once."""

from __future__ import annotations

from dataclasses import dataclass, field

from amrepair.regions.options import SkippedOptions


@dataclass(frozen=True, slots=True)
class VoxelOptions:
    """Grids of distances around defects, where they lie, and which solids are made on them.

    Attributes
    ----------
    most
        Samples of one grid, about.
    finest_mm, coarsest_mm
        Between samples.
    across_ratio, least_ratio
        Samples across a defect, and what must be left of them where a box is large.
    margin_mm
        Around what was found: of a grid.
    film_mm, even_mm, least_film_mm2, facing
        Beside what is deep, a film is sampled as finely as if it were alone: no thicker than the
        first, on a surface this even, this large, and facing out of the template by this cosine.
    path_step_mm
        Along ways from a void's floor to its mouth.
    sliver_ratio
        Under a layer's top, of the limit: what the surfel nearest to it is labelled for is missing.
    crumb_mm3
        Smaller pieces are what marching cubes makes of noise at a rim.
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
    """The as-built height field of the scan, and of scan and solids together.

    Attributes
    ----------
    cell_mm
        Width of the columns of what the scan alone says.
    unseen_margin_mm
        What nobody saw is solid up to the printed height, or the template, and this much more.
    beside_part_mm
        More than a nozzle's cone, so that what stands beside the part is in the field.
    top_band_mm
        Points within this of a cell's top are one surface with its noise.
    gap_mm2
        A smaller unseen patch between seen ones is a gap of sampling, not a place to hide.
    fine_cell_mm, most_fine_cells
        Of the field that has the solids' walls.
    by_wall_cells
        In cells of the scan: one that a wall's noise touches, and a gap beside it that took its
        height.
    trust_mm
        The scan may stand out this much before it overrules the solids: their tolerance, and noise.
    noise_mm
        Of a cell with many points.
    chance_mm
        What a cell with a single point may be off: of some thousand under the head one is so far.
    film_mm
        Two layers: thinner material over a void is the solids' own rounding at its rim.
    least_film_mm
        That the scan can tell from nothing.
    fin_cells, unseen_fin_cells, chance_cells
        In fine cells: thinner than a bead; than two, of which points would have been seen; and so
        few without a point among others are chance.
    most_steps_down
        By which what nobody saw is followed down.
    off_sigma
        In the scan's noise: how far a point is off upwards or aside, and tells of nothing. Of the
        thousands on walls beside what is missing one in fifty lies two off, and each would keep
        the head away.
    crest_sigma
        In the scan's noise: the highest of the points on what stands out lies so far over it.
    others_near, beside_spacings
        On any surface so many others lie within so many spacings: 4 π are expected on a flat one.
    """

    cell_mm: float = 0.25
    unseen_margin_mm: float = 1.0
    beside_part_mm: float = 8.0
    top_band_mm: float = 0.3
    gap_mm2: float = 1.0
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
    off_sigma: float = 3.5
    crest_sigma: float = 2.0
    others_near: int = 2
    beside_spacings: float = 2.0


@dataclass(frozen=True, slots=True)
class WallOptions:
    """Walls, crests and rims beside what is missing, in cells of the fine field.

    Attributes
    ----------
    step_mm
        From column to column: a wall, not a slope.
    beside_cells
        Around what is missing: there the solids' walls are the scan's.
    radius_mm
        Around a column; a round wall of 4 mm across leaves its plane by no more than noise within.
    below_top_sigma, over_foot_sigma
        Points so near to a wall's ends, in the scan's noise, belong to what lies above or below it.
    most_spread_sigma
        What lies farther from its plane than noise alone, on average, is more than one wall.
    inside_sigma
        A point so far inside the template, in the scan's noise, lies on what broke.
    most_slant
        Cosine: a wall is steeper than 75°.
    crest_cells, crest_reach_cells
        Thinner than a bead; and along it, as far as between two points that were seen.
    splinter_mm
        A crest that stands so little lower than designed has lost its points, no more.
    steep_mm
        A face of what is missing is steep where it falls by this from a cell to the next (83°).
    rounded_mm, rounded_cells, as_designed_mm, foot_cells
        So much of a lip the solids' rounding may have taken, so many cells wide; what is as
        designed; how far from it the foot of a face is looked for.
    edge_mm, rounded_spacings
        A fall from cell to cell that is a top's edge; how far from it tops are rounded off.
    sound_mm, least_sound, uneven_mm
        Beyond that, as far a top is looked at, at so many columns at least; and how even it is.
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


@dataclass(frozen=True, slots=True)
class DeficitOptions:
    """Settings of a deficit; it records those it was made with.

    Attributes
    ----------
    bead_mm3
        One bead of 0.45 × 0.2 mm as long as two nozzle widths: less cannot be placed.
    early_mm3
        From so much on heights will be asked for: what a clean layer's crumbs never are.
    skipped, voxels, heights, walls
        Of each stage.
    """

    bead_mm3: float = 0.08
    early_mm3: float = 0.5
    skipped: SkippedOptions = field(default_factory=SkippedOptions)
    voxels: VoxelOptions = field(default_factory=VoxelOptions)
    heights: HeightOptions = field(default_factory=HeightOptions)
    walls: WallOptions = field(default_factory=WallOptions)


USUAL_DEFICIT = DeficitOptions()
"""What the loop and the command line go by."""
