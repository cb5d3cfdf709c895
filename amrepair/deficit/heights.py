"""The as-built height field: how high something stands at each place of the bed.

The slicer lays beads onto it, and the checker keeps the head clear of it. A height is a robust mean
of the topmost points in a column. A column that no ray reached counts as solid up to the printed
height and a margin. A cloud without rays cannot tell empty from unseen: where it has no points, the
part is taken to stand as designed, with that margin, and nothing where it was designed open. Beside
a part to which somebody has cut its scan nothing stands either, sensors or not: rays that ended on
the bed are gone. What is too narrow to hide anything is as high as what is beside it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import manifold3d
import numpy as np
from jaxtyping import Float, Int, Num
from scipy import ndimage

from amrepair.arrays import ColumnMask, HeightMap, Mask, Numbers, Points
from amrepair.deficit import heights_kernels as kernels
from amrepair.deficit.options import DEFAULT_DEFICIT, HeightOptions
from amrepair.deficit.walls import window_around
from amrepair.field.near import has_near
from amrepair.frames import Transform, box_corners, box_of, in_box
from amrepair.observe.rays import RangeImage, clearances
from amrepair.scans import Scan
from amrepair.template.port import Template
from gcode.compiled import read_only
from gcode.meshes import mesh_of
from gcode.surfaces import HeightField, raster_kernels

HALF_AROUND = 4  # of the eight cells around one
# Directions to the columns around a point; its own comes first, and suffices for most points.
OWN_COLUMN_FIRST = sorted(itertools.product((-1.0, 0.0, 1.0), repeat=2), key=np.linalg.norm)


def as_built_heights(
    scan: Scan,
    template: Template,
    spacing_mm: float,
    *,
    build_from_template: Transform,
    printed_z_mm: float | None,
    images: tuple[RangeImage, ...] = (),
    options: HeightOptions = DEFAULT_DEFICIT.heights,
) -> HeightField:
    """Make the height field that a scan shows, build frame.

    Parameters
    ----------
    images
        The scan's range images, template frame. Where no point was seen, as at the bottom of a
        deep hole, a column counts as solid only up to where rays crossed it.
    """
    points = build_from_template.apply(scan.points_mm)
    corners = box_corners(template.bounds_mm)
    box = build_from_template.apply(corners)
    low, high = box.min(axis=0) - options.beside_part_mm, box.max(axis=0) + options.beside_part_mm
    cell_mm = _cell_mm(spacing_mm, options)
    nx, ny = (math.ceil(v) for v in (high[:2] - low[:2]) / cell_mm)
    grid = HeightField(low[:2].copy(), cell_mm, np.zeros((ny, nx)), np.zeros((ny, nx), bool))
    top_z = float(box[:, 2].max()) if printed_z_mm is None else printed_z_mm
    solid_z = np.full(grid.shape, top_z + options.unseen_margin_mm)
    z, seen = _tops(points, grid, spacing_mm, options)
    known = seen
    cut = scan.sensors_mm is not None and _is_cut_to(box, grid, seen, options)
    if scan.sensors_mm is None or cut:
        placed = build_from_template.solid(template.solid())
        designed_z = HeightField.from_manifold(placed, cell_mm, box_mm=grid.box_mm).z_mm
        designed_z = designed_z[:ny, :nx].astype(np.float64)
        bare = ~seen & (designed_z <= 0)
        z = np.where(bare, 0.0, z)
        known = seen | bare
        if not cut:  # where sensors are known, what stands in front of a place may hide more
            solid_z = np.minimum(solid_z, designed_z + options.unseen_margin_mm)
    z, closed = _close_gaps(z, known, cell_mm, options)
    seen = seen | (closed & ~known)
    known = closed
    if images:
        solid = replace(grid, z_mm=solid_z, seen=known)
        solid_z = _crossed(solid, float(low[2]), build_from_template.inverse(), images, options)
    return replace(grid, z_mm=np.where(known, np.maximum(z, 0.0), solid_z), seen=seen)


def _cell_mm(spacing_mm: float, options: HeightOptions) -> float:
    """Width of the scan's columns: each holds a point of a surface, however sparse."""
    return max(options.cell_mm, 1.2 * spacing_mm)


def _is_cut_to(
    corners: Points, grid: HeightField, seen: ColumnMask, options: HeightOptions
) -> bool:
    """Whether a scan holds nothing beside the part in that box, no bed either: it was cut to it."""
    low, high = box_of(corners)[:, :2]
    x, y = grid.centres_mm()
    beside = options.cut_beside_mm
    off_x = (x < low[0] - beside) | (x > high[0] + beside)
    off_y = (y < low[1] - beside) | (y > high[1] + beside)
    off = off_y[:, None] | off_x[None, :]
    return bool(seen[off].sum() <= options.cut_strays * off.sum())


def _crossed(
    solid: HeightField,
    low_mm: float,
    template_from_build: Transform,
    images: tuple[RangeImage, ...],
    options: HeightOptions,
) -> HeightMap:
    """Lower the unseen columns, from above, as far down as rays went through them."""
    iy, ix = np.nonzero(~solid.seen)
    z_mm, (x_mm, y_mm) = solid.z_mm.copy(), solid.centres_mm()
    high_mm = float(z_mm.max()) - max(low_mm, 0.0)
    step_mm = max(solid.cell_mm, high_mm / options.most_steps_down)
    while len(iy):
        down_mm = np.maximum(z_mm[iy, ix] - step_mm, 0.0)
        points = template_from_build.apply(np.column_stack([x_mm[ix], y_mm[iy], down_mm]))
        empty = clearances(images, points, -np.inf)[1] > options.noise_mm
        iy, ix = iy[empty], ix[empty]
        z_mm[iy, ix] = down_mm[empty]
        further = down_mm[empty] > 0
        iy, ix = iy[further], ix[further]
    return z_mm


def standing_heights(
    seen: HeightField,
    expected: manifold3d.Manifold,
    missing: manifold3d.Manifold,
    excess: manifold3d.Manifold,
    options: HeightOptions = DEFAULT_DEFICIT.heights,
) -> tuple[HeightField, HeightMap, HeightMap]:
    """Sharpen the walls of a scan's height field with the solids, build frame.

    The expected solid, less what is missing and plus what is too much, gives heights on a fine
    grid. They are taken beside walls, where the scan's coarse cells (`seen`, of `as_built_heights`)
    saw nothing higher; everywhere else the scan decides.

    Returns
    -------
    The field; from end to end how much is missing in each of its columns; and each column's top as
    expected.
    """
    fine = fine_over(seen, options)
    ny, nx = fine.shape
    whole, lost = (columns_of(solid, fine)[:2] for solid in (expected, missing))
    z_mm = raster_kernels.column_rest(*whole, *lost, options.film_mm, 0.0).reshape(ny, nx)
    at = cells_over(seen, fine)
    # a thin film is kept where the scan sees it and its surroundings: it is left of the part
    films = raster_kernels.column_rest(*whole, *lost, options.least_film_mm, 0.0).reshape(ny, nx)
    # a few cells without a point among others that have some are chance
    sampled = ndimage.grey_closing(np.where(seen.seen, seen.z_mm, 0.0), options.chance_cells)
    z_mm = np.where(ndimage.minimum_filter(sampled, 3)[at] > films - options.trust_mm, films, z_mm)
    gone = (lost[0][1:] != lost[0][:-1]).reshape(ny, nx)
    if gone.any():
        # fins are looked for near the missing solid, in a window with room around for the filters
        rows, columns = window_around(gone, 3 * options.unseen_fin_cells)
        seen_mm = ndimage.maximum_filter(np.where(seen.seen, seen.z_mm, -np.inf), 3)
        seen_mm = seen_mm[at[0][rows], at[1][:, columns]]
        z_mm[rows, columns] = _without_rims_fins(
            z_mm[rows, columns], gone[rows, columns], seen_mm, options
        )
    if not excess.is_empty():
        more = HeightField.from_manifold(excess, fine.cell_mm, box_mm=seen.box_mm)
        z_mm = np.maximum(z_mm, more.z_mm)
    field = _sharpened(seen, fine, z_mm, gone, options)
    offset, z = lost
    ends = [raster_kernels.column_top(*of, 0.0) for of in (whole, lost, (offset, -z))]
    designed_mm, high_mm, low_mm = (of.reshape(ny, nx) for of in ends)
    return field, high_mm + low_mm, designed_mm


def fine_over(seen: HeightField, options: HeightOptions) -> HeightField:
    """An empty field over the same area, in cells as fine as their allowed number permits."""
    box = seen.box_mm
    area_mm2 = (box[2] - box[0]) * (box[3] - box[1])
    cell_mm = max(options.fine_cell_mm, float(np.sqrt(area_mm2 / options.most_fine_cells)))
    ny, nx = (math.ceil((box[k + 2] - box[k]) / cell_mm - 1e-9) for k in (1, 0))
    return HeightField(
        np.array(box[:2]), cell_mm, np.zeros((ny, nx)), np.ones((ny, nx), dtype=bool)
    )


def _sharpened(
    seen: HeightField, fine: HeightField, z_mm: HeightMap, gone: ColumnMask, options: HeightOptions
) -> HeightField:
    """The scan's heights on a fine grid, and beside walls those of the solids (`z_mm`)."""
    at = cells_over(seen, fine)
    # a cell of the scan is as high as the highest thing that touches it: true of floors, not
    # beside walls, where the solids are the sharper of the two unless something else stands there
    around = around_walls(seen, fine, options)
    by_wall = beside_walls(z_mm, seen.z_mm[at], around, options)
    # where nothing is missing and the scan agrees, its noise would only raise what is highest
    off_mm = seen.z_mm[at] - z_mm
    agrees = ~gone & ((np.abs(off_mm) < options.noise_mm) | _by_chance(off_mm, around, options))
    # what is much lower was seen on another side: of this one no point fell into the cell
    beneath = seen.z_mm[at] < z_mm - options.trust_mm
    known = seen.seen[at]
    # where something is missing it was seen to be, near a point of the scan, or nothing is left to
    # be seen; below it there is what was expected, and at its rim, where columns and cells do not
    # end alike
    rim = ndimage.maximum_filter(gone, around)
    rim &= ndimage.maximum_filter(known, around) | (z_mm <= 0.0)
    sharp = np.where(known, by_wall | agrees | beneath, rim)
    return HeightField(
        fine.origin_mm, fine.cell_mm, np.where(sharp, z_mm, seen.z_mm[at]), known | rim
    )


def around_walls(seen: HeightField, fine: HeightField, options: HeightOptions) -> int:
    """Cells of the fine grid across which a cell of the scan may be wrong beside a wall."""
    return 2 * math.ceil(options.by_wall_cells * seen.cell_mm / fine.cell_mm) + 1


def beside_walls(
    planned_mm: HeightMap, seen_mm: HeightMap, around: int, options: HeightOptions
) -> ColumnMask:
    """Cells beside a planned step, but for those in which something higher than it was seen."""
    highest, lowest = (
        of(planned_mm, around) for of in (ndimage.maximum_filter, ndimage.minimum_filter)
    )
    is_step = highest - lowest > options.trust_mm
    return np.asarray(is_step & (seen_mm < highest + options.trust_mm))


def cells_over(
    coarse: HeightField, fine: HeightField
) -> tuple[Int[np.ndarray, "ny 1"], Int[np.ndarray, "1 nx"]]:
    """Indices of the coarse field's cells under every cell of the fine one."""
    ny, nx = coarse.shape
    iy, ix = coarse.rows_and_columns_of(fine)
    return np.clip(iy, 0, ny - 1)[:, None], np.clip(ix, 0, nx - 1)[None, :]


def with_what_stands_out(
    field: HeightField,
    points_mm: Points,
    sigma_mm: float,
    spacing_mm: float,
    options: HeightOptions,
) -> HeightField:
    """Raise the field to points that stand out of it by more than the scan's noise.

    Solids round off lips, and cells average over what is in them, so a crest, a splinter or a burr
    thinner than the point spacing reads too low. No bead is laid on it, but the head may run into
    it. A point does not stand out if the field is as high within the distance that noise moves a
    point aside. A single point with no others around is a reflection in mid-air and ignored. Points
    are in the build frame.
    """
    off_mm = options.off_sigma * sigma_mm
    out = points_mm[
        kernels.unexplained(
            read_only(points_mm), off_mm, off_mm * np.array(OWN_COLUMN_FIRST),
            field.origin_mm, field.cell_mm, read_only(field.z_mm, np.float64),
        )
    ]  # fmt: skip
    if len(out) == 0:
        return field
    out = out[has_others_beside(out, points_mm, spacing_mm, options)]
    index = field.cells_of(out[:, :2])
    inside = ((index >= 0) & (index < field.shape)).all(axis=1)
    z_mm = np.array(field.z_mm, dtype=np.float64)
    np.maximum.at(z_mm, tuple(index[inside].T), out[inside, 2] - options.crest_sigma * sigma_mm)
    return field.raised(z_mm)


def has_others_beside(
    asked_mm: Points,
    points_mm: Float[np.ndarray, "m 3"],
    spacing_mm: float,
    options: HeightOptions = DEFAULT_DEFICIT.heights,
) -> Mask:
    """(k,) whether some of the points have others beside them, as on a surface.

    Those that have none stray: real scanners have them in mid-air, up to one in fifty.
    """
    within_mm = options.beside_spacings * spacing_mm
    return has_near(asked_mm, points_mm, within_mm, enough=options.others_near + 1)  # itself too


def with_others(field: HeightField, others: HeightField) -> HeightField:
    """Join a field with what stands in another one beside it, in the cells of the first."""
    rows, columns = np.nonzero(others.z_mm > 0.0)
    if not len(rows):
        return field
    step = others.cell_mm
    low_mm = others.origin_mm + step * np.array([columns.min(), rows.min()])
    high_mm = others.origin_mm + step * np.array([columns.max() + 1, rows.max() + 1])
    box_mm, cell_mm = np.array(field.box_mm), field.cell_mm
    before = np.maximum(np.ceil((box_mm[:2] - low_mm) / cell_mm), 0.0).astype(np.int64)
    behind = np.maximum(np.ceil((high_mm - box_mm[2:]) / cell_mm), 0.0).astype(np.int64)
    around = [(int(before[k]), int(behind[k])) for k in (1, 0)]
    bare = HeightField(
        field.origin_mm - before * cell_mm,
        cell_mm,
        np.pad(field.z_mm.astype(np.float64), around),
        np.pad(field.seen, around, constant_values=True),
    )
    iy, ix = cells_over(others, bare)
    return bare.raised(others.z_mm[iy, ix])


def heights_beside(
    field: HeightField,
    points_mm: Points,
    spacing_mm: float,
    *,
    over_mm: float,
    within_mm: tuple[float, float, float, float],
    options: HeightOptions = DEFAULT_DEFICIT.heights,
) -> HeightField | None:
    """What a scan shows around a field that stands higher than the head goes past it.

    Parameters
    ----------
    points_mm
        (n, 3) of all of the scan, build frame.
    over_mm, within_mm
        Only what is higher than this counts, and lies in this rectangle of the bed
        (x_min, y_min, x_max, y_max).

    Returns
    -------
    Heights of it, 0 where there is none; None if there is none at all.
    """
    points = points_mm[points_mm[:, 2] > over_mm]
    inside, on_bed = (
        in_box(points[:, :2], np.array(box[:2]), np.array(box[2:]))
        for box in (field.box_mm, within_mm)
    )
    points = points[on_bed & ~inside]
    if not len(points):
        return None
    cell_mm = _cell_mm(spacing_mm, options)
    # with an empty cell on each side, as which everything around it counts
    low = points[:, :2].min(axis=0) - cell_mm
    nx, ny = (int(n) + 3 for n in np.ptp(points[:, :2], axis=0) / cell_mm)
    shape = (ny, nx)
    grid = HeightField(low, cell_mm, np.zeros(shape), np.zeros(shape, bool))
    z_mm, seen = _tops(points, grid, spacing_mm, options)
    return replace(grid, z_mm=np.where(seen, z_mm, 0.0), seen=seen) if seen.any() else None


def _without_rims_fins(
    z_mm: HeightMap, gone: ColumnMask, seen_mm: HeightMap, options: HeightOptions
) -> HeightMap:
    """Lower fins beside what is missing that are too thin to be there.

    `seen_mm` is the highest point that was seen around each column.
    """
    # right beside the missing solid, a fin thinner than a bead is that solid's rounding
    beside = ndimage.maximum_filter(gone, 3)
    z_mm = np.where(beside, _without_fins(z_mm, options.fin_cells), z_mm)
    # a little farther off, a fin thinner than a wall is there only if points of it were seen
    near = ndimage.maximum_filter(gone, 2 * options.unseen_fin_cells - 1)
    unseen = near & (seen_mm < z_mm - options.trust_mm)
    return np.where(unseen, _without_fins(z_mm, options.unseen_fin_cells), z_mm)


def _without_fins(z_mm: HeightMap, cells: int) -> HeightMap:
    """Lower what is thinner than so many cells, but keep the corners of what is thicker."""
    thick_mm = ndimage.grey_opening(z_mm, cells)
    return np.asarray(np.minimum(z_mm, ndimage.maximum_filter(thick_mm, 3)))


def _by_chance(off_mm: HeightMap, around: int, options: HeightOptions) -> ColumnMask:
    """Cells that are off by chance, for having few points: those around them are not off, too."""
    bounded = np.clip(off_mm, -options.chance_mm, options.chance_mm)
    together = ndimage.uniform_filter(bounded, around)
    return np.asarray(
        (np.abs(off_mm) < options.chance_mm) & (np.abs(together) < 0.5 * options.noise_mm)
    )


def without_missing(
    seen: HeightField,
    missing: manifold3d.Manifold,
    options: HeightOptions = DEFAULT_DEFICIT.heights,
) -> HeightField:
    """Lower unseen columns to the bottom of what is missing there.

    What is missing was found to be empty, so it does not stand, even where the scan saw no floor.
    """
    if missing.is_empty():
        return seen
    offset, z, _ = columns_of(missing, seen)
    high_mm, low_mm = (
        sign * raster_kernels.column_top(offset, sign * z, -np.inf).reshape(seen.shape)
        for sign in (1.0, -1.0)
    )
    hidden = ~seen.seen & (high_mm >= seen.z_mm - options.noise_mm) & (low_mm < seen.z_mm)
    return HeightField(seen.origin_mm, seen.cell_mm, np.where(hidden, low_mm, seen.z_mm), seen.seen)


def columns_of(
    solid: manifold3d.Manifold, field: HeightField
) -> tuple[Numbers, Float[np.ndarray, " crossings"], Num[np.ndarray, " crossings"]]:
    """Where vertical lines through the columns cross a solid: offsets by column, heights, signs."""
    x, y = field.origin_mm.tolist()
    ny, nx = field.shape
    offset, *crossed = raster_kernels.column_crossings(*mesh_of(solid), x, y, field.cell_mm, nx, ny)
    return offset, *crossed


def _tops(
    points_mm: Points, grid: HeightField, spacing_mm: float, options: HeightOptions
) -> tuple[HeightMap, ColumnMask]:
    """The mean height of each cell's topmost surface, and whether the cell has points.

    A scanner's stray points would keep the nozzle away from everything around them. So a single
    point above the others of its cell is ignored where no neighbouring cell is as high, and a few
    that stand out of most of those around where no others are near.
    """
    points, band_mm = read_only(points_mm), options.top_band_mm
    column = kernels.columns(points, grid.origin_mm, grid.cell_mm, *grid.shape)
    below_mm = np.full(grid.z_mm.size, np.inf)
    first = True
    while True:
        top_mm, mean_mm, count, among = kernels.topmost(column, points, below_mm, band_mm)
        as_high = _neighbours_as_high(top_mm.reshape(grid.shape), band_mm).ravel()
        alone = (count == 1) & (among > 1) & (as_high == 0) & first
        asked = (count > 0) & (count <= options.others_near) & (as_high < HALF_AROUND) & ~alone
        which = np.flatnonzero((column >= 0) & asked[column])
        own = column[which]
        inside = (points[which, 2] >= top_mm[own] - band_mm) & (points[which, 2] < below_mm[own])
        which = which[inside]
        asked[column[which[has_others_beside(points[which], points, spacing_mm, options)]]] = False
        strays = alone | asked
        if not strays.any():
            return mean_mm.reshape(grid.shape), count.reshape(grid.shape) > 0
        below_mm[strays] = np.where(count == 1, top_mm, top_mm - band_mm)[strays]
        first = False


def _neighbours_as_high(top_mm: HeightMap, band_mm: float) -> Int[np.ndarray, "ny nx"]:
    """How many of the eight cells around each one are as high, but for a band."""
    around = np.pad(top_mm, 1, constant_values=-np.inf)
    ny, nx = top_mm.shape
    return np.asarray(
        sum(
            (around[i : i + ny, j : j + nx] >= top_mm - band_mm).astype(np.int64)
            for i, j in itertools.product(range(3), repeat=2)
            if (i, j) != (1, 1)
        )
    )


def _close_gaps(
    z_mm: HeightMap, seen: ColumnMask, cell_mm: float, options: HeightOptions
) -> tuple[HeightMap, ColumnMask]:
    """Fill narrow gaps: each empty cell takes the height of its highest neighbour.

    Cell by cell and not gap by gap, since gaps may touch by their corners over some distance, and a
    wall beside one cell is not beside the next.
    """
    side = int(options.gap_mm / cell_mm) + 1
    narrow = ~seen & ~ndimage.binary_opening(~seen, np.ones((side, side)))
    z_mm, known = z_mm.copy(), seen.copy()
    while True:  # from the rim inwards
        highest = ndimage.maximum_filter(np.where(known, z_mm, -np.inf), 3)
        new = narrow & ~known & np.isfinite(highest)
        if not new.any():
            return z_mm, known
        z_mm[new] = highest[new]
        known |= new
