"""Walls beside what is missing, as sharp as the scan's points show them.

The solids' walls come from cells of the scan, whose planes round off corners and waver by some
hundredths of a millimetre. So it is left to chance whether a column beside a wall is high or low,
and a single column too many keeps the nozzle's cone away from the whole wall. Planes fitted to the
points of the wall itself, column by column, are more exact.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from amrepair.arrays import ColumnMask, HeightMap, Points, Values
from amrepair.deficit import walls_kernels as kernels
from amrepair.deficit.options import DEFAULT_DEFICIT, WallOptions
from amrepair.frames import cells_of, in_box
from gcode.surfaces import HeightField


def with_sharp_walls(
    field: HeightField,
    gone: ColumnMask,
    points_mm: Points,
    sigma_mm: float,
    options: WallOptions = DEFAULT_DEFICIT.walls,
    *,
    deviation_mm: Values | None = None,
) -> HeightField:
    """Make columns beside walls high or low, by the side of the wall on which their middles lie.

    Parameters
    ----------
    gone
        Columns in which something is missing; only walls beside them are sharpened.
    points_mm
        The scan's points, build frame.
    deviation_mm
        The signed distance of each point to the template; broken surface lies inside. A wall
        between a void and the part's outside may be thinner than `radius_mm`, and by this its two
        faces are kept apart. None where it is not known.
    """
    if not gone.any() or sigma_mm <= 0:
        return field
    rows, columns = window_around(
        gone, options.beside_cells + int(np.ceil(options.radius_mm / field.cell_mm))
    )
    z_mm = np.array(field.z_mm, dtype=np.float64)
    near, lost = z_mm[rows, columns], np.ascontiguousarray(gone[rows, columns])
    beside = ndimage.maximum_filter(lost, 2 * options.beside_cells + 1)
    corner_mm = field.origin_mm + np.array([columns.start, rows.start]) * field.cell_mm
    inside = np.zeros(len(points_mm), dtype=bool)
    if deviation_mm is not None:
        inside = deviation_mm < -options.inside_sigma * sigma_mm
    seen, broken = (
        _by_cell(of, corner_mm, field.cell_mm, near.shape) for of in (points_mm, points_mm[inside])
    )
    for _ in range(int(np.ceil(options.radius_mm / field.cell_mm))):  # from the rim in
        step_mm = ndimage.maximum_filter(near, 3) - ndimage.minimum_filter(near, 3)
        iy, ix = map(np.ascontiguousarray, (beside & (step_mm > options.step_mm)).nonzero())
        told_mm = kernels.sharpened(
            near.copy(), lost, iy, ix, seen, broken, corner_mm, field.cell_mm, options.radius_mm,
            options.below_top_sigma * sigma_mm, options.over_foot_sigma * sigma_mm,
            options.most_spread_sigma * sigma_mm, options.most_slant,
        )  # fmt: skip
        if np.array_equal(told_mm, near[iy, ix]):
            break
        near[iy, ix] = told_mm
    return replace(field, z_mm=z_mm)


def as_low_as_seen(
    field: HeightField,
    gone: ColumnMask,
    points_mm: Points,
    sigma_mm: float,
    spacing_mm: float,
    deviation_mm: Values,
    options: WallOptions = DEFAULT_DEFICIT.walls,
) -> HeightField:
    """Lower what the solids leave standing where the scan shows it gone, beside what is missing.

    Solids round off the edges of what is missing: floors read some tenths of a millimetre too high
    at the foot of a slope, and the corners of a pit stand as high as its walls. So floors are taken
    from the points on them; and a column goes where points would lie on it and do not, if broken
    surface lies behind it. Where the scan has no points, nothing changes. `gone`, `points_mm` and
    `deviation_mm` are those of `with_sharp_walls`.
    """
    if not gone.any() or sigma_mm <= 0:
        return field
    window = window_around(gone, options.beside_cells + options.behind_cells)
    z_mm = np.array(field.z_mm, dtype=np.float64)
    near, lost = np.ascontiguousarray(z_mm[window]), np.ascontiguousarray(gone[window])
    corner_mm = field.origin_mm + np.array([window[1].start, window[0].start]) * field.cell_mm
    inside = deviation_mm < -options.inside_sigma * sigma_mm
    seen, broken = (
        _by_cell(of, corner_mm, field.cell_mm, near.shape) for of in (points_mm, points_mm[inside])
    )
    may = ndimage.maximum_filter(lost, 2 * options.beside_cells + 1)
    # points on a lip are of its top and of its wall, and tell no floor
    across = 2 * math.ceil(options.radius_mm / field.cell_mm) + 1
    lip = near - ndimage.minimum_filter(near, across) > options.rounded_mm + options.radius_mm
    at = tuple(map(np.ascontiguousarray, (lost & ~lip).nonzero()))
    near[at] = kernels.floors(
        near, *at, seen, corner_mm, field.cell_mm, options.radius_mm, options.rounded_mm,
        options.most_spread_sigma * sigma_mm, options.steepest,
    )  # fmt: skip
    z_mm[window] = kernels.carved(
        near, lost, may, seen, broken, corner_mm, field.cell_mm, options.over_foot_sigma * sigma_mm,
        math.sqrt(0.5) * field.cell_mm + sigma_mm, spacing_mm, -math.log(options.bare_p),
        options.behind_cells, options.deepest_cells,
    )  # fmt: skip
    return replace(field, z_mm=z_mm)


def with_rims(
    field: HeightField,
    lost_mm: HeightMap,
    designed_mm: HeightMap,
    spacing_mm: float,
    options: WallOptions = DEFAULT_DEFICIT.walls,
) -> HeightField:
    """Raise crests, tops and lips beside what is missing to the height at which they stand.

    Parameters
    ----------
    lost_mm, designed_mm
        How much is missing in each column, from end to end, and the expected top of each column.
    """
    gone = lost_mm > 0
    if not gone.any():
        return field
    rounded, sound = (
        math.ceil(mm / field.cell_mm)
        for mm in (options.rounded_spacings * spacing_mm, options.sound_mm)
    )
    window = window_around(gone, options.beside_cells + max(rounded + sound, options.crest_cells))
    z_mm = np.array(field.z_mm, dtype=np.float64)
    lost, designed = lost_mm[window], designed_mm[window]
    even = even_crests(z_mm[window], lost, designed, options)
    risen = rising_rims(even, lost, designed, rounded, rounded + sound, options)
    z_mm[window] = whole_rims(risen, lost, designed, options)
    return replace(field, z_mm=z_mm)


def even_crests(
    z_mm: HeightMap, lost_mm: HeightMap, designed_mm: HeightMap, options: WallOptions
) -> HeightMap:
    """Raise crests, thinner than a bead, to their highest columns near by.

    A crest, a splinter or the thin end of a lip has few points on it, and solids round it off. So
    columns between two seen ones are taken to be as high as the higher of those; and where that is
    only a little lower than designed, beside a steep face, as high as designed.
    """
    beside = ndimage.maximum_filter(lost_mm > 0, 2 * options.beside_cells + 1)
    # where what is missing lies on what stands, not beside a wall that reads too far in
    on = (lost_mm > options.steep_mm) & (designed_mm - lost_mm < z_mm + options.as_designed_mm)
    foot_mm = ndimage.minimum_filter(np.where(on, z_mm, np.inf), 2 * options.beside_cells + 1)
    reach = 2 * options.crest_reach_cells + 1
    # nothing thick as high beside it: what a wall's foot is rounded off by is no crest
    thick_mm = ndimage.maximum_filter(ndimage.grey_opening(z_mm, options.crest_cells), reach)
    crest = beside & (z_mm - thick_mm > options.step_mm)
    highest_mm = ndimage.maximum_filter(np.where(crest, z_mm, -np.inf), reach)
    # the tip of a worn edge falls off on its outside alone
    cut = highest_mm - foot_mm > options.steep_mm
    whole = cut & (designed_mm > highest_mm) & (designed_mm < highest_mm + options.splinter_mm)
    return np.where(crest, np.where(whole, designed_mm, highest_mm), z_mm)


def rising_rims(
    z_mm: HeightMap,
    lost_mm: HeightMap,
    designed_mm: HeightMap,
    rounded: int,
    reach: int,
    options: WallOptions,
) -> HeightMap:
    """Extend tops that rise towards an edge up to that edge, but not beyond the template.

    Solids round off a sharp rim: its last columns read as high as those some points farther in, up
    to 0.3 mm too low for a worn edge that rises at 45°. So the outermost `rounded` columns are set
    by a plane through the columns farther in, within `reach`.
    """
    deep = lost_mm > options.steep_mm
    beside = ndimage.maximum_filter(deep, 2 * options.beside_cells + 1)
    edge = z_mm - ndimage.minimum_filter(z_mm, 3) > options.edge_mm
    rim = ndimage.maximum_filter(edge, 2 * rounded + 1)
    at = tuple(map(np.ascontiguousarray, (rim & beside & (z_mm < designed_mm)).nonzero()))
    up_mm = kernels.extended(z_mm, *at, ~rim, reach, options.least_sound, options.uneven_mm)
    up_mm = np.minimum(up_mm, designed_mm[at])
    risen_mm, low_mm = z_mm.copy(), z_mm[at]
    believed = up_mm - low_mm < options.rounded_mm
    risen_mm[at] = np.where(believed, np.maximum(up_mm, low_mm), low_mm)
    return risen_mm


def whole_rims(
    z_mm: HeightMap, lost_mm: HeightMap, designed_mm: HeightMap, options: WallOptions
) -> HeightMap:
    """Raise tops beside a steep face of what is missing to the designed height, up to the face.

    Solids round off such a lip by some tenths of a millimetre. A top that is as designed up to a
    few columns from a steep face ends at the face and not before it. Beside a slope, as of a worn
    edge, lower columns are left as they are.
    """
    deep = lost_mm > options.steep_mm  # beside a line that was skipped nothing stands as if cut
    off_mm = designed_mm - z_mm
    foot_mm = ndimage.minimum_filter(np.where(deep, z_mm, np.inf), 2 * options.foot_cells + 1)
    lip = designed_mm - foot_mm > options.steep_mm
    whole = (np.abs(off_mm) < options.as_designed_mm) & ~ndimage.maximum_filter(lost_mm > 0, 3)
    lip &= ndimage.maximum_filter(whole, 2 * options.rounded_cells + 1)
    rounded = lip & (off_mm > 0) & (off_mm < options.rounded_mm)
    return np.where(rounded, designed_mm, z_mm)


def window_around(gone: ColumnMask, margin: int) -> tuple[slice, slice]:
    """The window, with a margin, around the columns in which something is missing."""
    rows, columns = (
        slice(max(int(k.min()) - margin, 0), int(k.max()) + margin + 1) for k in gone.nonzero()
    )
    return rows, columns


def _by_cell(
    points_mm: Points, corner_mm: Float[np.ndarray, " 2"], cell_mm: float, shape: tuple[int, int]
) -> kernels.PointsByCell:
    """Sort points by the cells of a grid; with where each cell's points begin, row by row."""
    ny, nx = shape
    high_mm = corner_mm + cell_mm * np.array([nx, ny])
    own = points_mm[in_box(points_mm[:, :2], corner_mm, high_mm)]
    index = cells_of(own[:, :2], corner_mm, cell_mm)
    cell = np.minimum(index[:, 1], ny - 1) * nx + np.minimum(index[:, 0], nx - 1)
    ends = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=ny * nx))])
    start = np.lib.stride_tricks.sliding_window_view(ends, nx + 1)[::nx]
    return kernels.PointsByCell(np.ascontiguousarray(start), own[np.argsort(cell, kind="stable")])
