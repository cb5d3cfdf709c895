"""Walls beside what is missing, as sharp as the scan has them.

The solids' walls there come from cells of the scan, whose planes round off corners and waver by
some hundredths of a millimetre: whether a column of the field is wall or not is left to chance by
that, and one too many in a row keeps the nozzle's cone away all along. A plane through the points
of the wall itself, column by column, knows better.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from amrepair.deficit import walls_kernels as kernels
from amrepair.frames import in_box
from gcode.surfaces import HeightField

# A step from column to column that is a wall, not a slope.
WALL_STEP_MM = 0.3
# Around what is missing, so many cells: there the solids' walls are the scan's.
BESIDE_CELLS = 3
# Around a column; a round wall of 4 mm across leaves its plane by no more than noise within it.
RADIUS_MM = 0.4
# Points so near to a wall's ends, in the scan's noise, belong to what lies above or below it.
BELOW_TOP_SIGMA, OVER_FOOT_SIGMA = 2.5, 4.0
# What lies farther from its plane than noise alone, on average, is more than one wall.
MOST_SPREAD_SIGMA = 1.75
MOST_SLANT = 0.25  # cosine: steeper than 75°
# Thinner than a bead; and along it, as far as between two points that were seen.
CREST_CELLS, CREST_REACH_CELLS = 4, 2
SPLINTER_MM = 0.3  # a crest that stands so little lower than designed has lost its points, no more
# A face of what is missing is steep where it falls by this from one cell to the next (83°).
STEEP_MM = 0.8
# So much of a lip the solids' rounding may have taken, so many cells wide; what is as designed; how
# far from it the foot of a face is looked for.
ROUNDED_MM, ROUNDED_CELLS, AS_DESIGNED_MM, FOOT_CELLS = 0.4, 3, 0.1, 2
# A fall from cell to cell that is a top's edge; in spacings, how far from it tops are rounded off.
EDGE_MM, ROUNDED_SPACINGS = 0.4, 1.5
# Beyond that, as far a top is looked at, at so many columns at least; and how even it is.
SOUND_MM, LEAST_SOUND, UNEVEN_MM = 0.8, 20, 0.04


def with_sharp_walls(
    field: HeightField,
    gone: Bool[np.ndarray, "ny nx"],
    points_mm: Float[np.ndarray, "n 3"],
    sigma_mm: float,
) -> HeightField:
    """The as-built field, columns beside walls high or low as their middles lie to the wall.

    Parameters
    ----------
    gone
        Columns that something is missing from: only walls beside them are looked at.
    points_mm
        What was seen, build frame.
    """
    if not gone.any() or sigma_mm <= 0:
        return field
    rows, columns = window_around(gone, BESIDE_CELLS + int(np.ceil(RADIUS_MM / field.cell_mm)))
    z_mm = np.array(field.z_mm, dtype=np.float64)
    near = z_mm[rows, columns]
    beside = ndimage.maximum_filter(gone[rows, columns], 2 * BESIDE_CELLS + 1)
    step_mm = ndimage.maximum_filter(near, 3) - ndimage.minimum_filter(near, 3)
    iy, ix = (beside & (step_mm > WALL_STEP_MM)).nonzero()
    corner_mm = field.origin_mm + np.array([columns.start, rows.start]) * field.cell_mm
    sorted_mm, start = _by_cell(points_mm, corner_mm, field.cell_mm, near.shape)
    near[iy, ix] = kernels.sharpened(
        near.copy(), iy, ix, start, sorted_mm, corner_mm, field.cell_mm, RADIUS_MM,
        BELOW_TOP_SIGMA * sigma_mm, OVER_FOOT_SIGMA * sigma_mm, MOST_SPREAD_SIGMA * sigma_mm,
        MOST_SLANT,
    )  # fmt: skip
    return HeightField(field.origin_mm, field.cell_mm, z_mm, field.seen)


def with_even_crests(
    field: HeightField, lost_mm: Float[np.ndarray, "ny nx"], designed_mm: Float[np.ndarray, "ny nx"]
) -> HeightField:
    """The as-built field, what is thinner than a bead beside what is missing as high as near by.

    A crest, a splinter or the thin end of a lip is sampled by few points, and solids round it off:
    what lies between two of its columns that were seen is no lower than the higher of them, and
    where that is a little lower than designed, beside a steep face, it is as designed.

    Parameters
    ----------
    lost_mm, designed_mm
        How much is missing from each column, from end to end, and the top of what was expected.
    """
    gone = lost_mm > 0
    if not gone.any():
        return field
    rows, columns = window_around(gone, CREST_CELLS + BESIDE_CELLS)
    z_mm = np.array(field.z_mm, dtype=np.float64)
    near, designed = z_mm[rows, columns], designed_mm[rows, columns]
    lost = lost_mm[rows, columns]
    beside = ndimage.maximum_filter(gone[rows, columns], 2 * BESIDE_CELLS + 1)
    # where what is missing lies on what stands, not beside a wall that reads too far in
    on = (lost > STEEP_MM) & (designed - lost < near + AS_DESIGNED_MM)
    foot_mm = ndimage.minimum_filter(np.where(on, near, np.inf), 2 * BESIDE_CELLS + 1)
    reach = 2 * CREST_REACH_CELLS + 1
    # nothing thick as high beside it: what a wall's foot is rounded off by is no crest
    thick_mm = ndimage.maximum_filter(ndimage.grey_opening(near, CREST_CELLS), reach)
    crest = beside & (near - thick_mm > WALL_STEP_MM)
    highest_mm = ndimage.maximum_filter(np.where(crest, near, -np.inf), reach)
    cut = highest_mm - foot_mm > STEEP_MM  # the tip of a worn edge falls off on its outside alone
    whole = cut & (designed > highest_mm) & (designed < highest_mm + SPLINTER_MM)
    near[crest] = np.where(whole, designed, highest_mm)[crest]
    return field.raised(z_mm)


def with_rising_rims(
    field: HeightField,
    lost_mm: Float[np.ndarray, "ny nx"],
    designed_mm: Float[np.ndarray, "ny nx"],
    spacing_mm: float,
) -> HeightField:
    """The as-built field, tops that rise towards an edge extended up to it, or to the template.

    Solids round off a sharp rim: its last columns read as high as what lies some points farther in,
    up to 0.3 mm too low for a worn edge that rises at 45°. A plane through what lies beyond their
    rounding knows better.

    Parameters
    ----------
    lost_mm, designed_mm
        How much is missing from each column, from end to end, and the top of what was expected.
    spacing_mm
        Mean distance between neighbouring points.
    """
    deep = lost_mm > STEEP_MM
    if not deep.any():
        return field
    rounded = math.ceil(ROUNDED_SPACINGS * spacing_mm / field.cell_mm)
    reach = rounded + math.ceil(SOUND_MM / field.cell_mm)
    rows, columns = window_around(deep, reach + BESIDE_CELLS)
    z_mm = np.array(field.z_mm, dtype=np.float64)
    near, designed = z_mm[rows, columns], designed_mm[rows, columns]
    beside = ndimage.maximum_filter(deep[rows, columns], 2 * BESIDE_CELLS + 1)
    edge = near - ndimage.minimum_filter(near, 3) > EDGE_MM
    rim = ndimage.maximum_filter(edge, 2 * rounded + 1)
    iy, ix = (rim & beside & (near < designed)).nonzero()
    up_mm = kernels.extended(near.copy(), iy, ix, ~rim, reach, LEAST_SOUND, UNEVEN_MM)
    up_mm = np.minimum(up_mm, designed[iy, ix])
    low_mm = near[iy, ix]
    near[iy, ix] = np.where(up_mm - low_mm < ROUNDED_MM, up_mm, low_mm)
    return field.raised(z_mm)


def with_whole_rims(
    field: HeightField,
    lost_mm: Float[np.ndarray, "ny nx"],
    designed_mm: Float[np.ndarray, "ny nx"],
) -> HeightField:
    """The as-built field, tops beside a steep face of what is missing as designed up to the face.

    Solids round off such a lip by some tenths of a millimetre. Where a top is as designed up to a
    few columns from a face, and falls steeply there, it ends at the face and not before; what lies
    lower along a slope, as of a worn edge, is lower.

    Parameters
    ----------
    lost_mm, designed_mm
        How much is missing from each column, from end to end, and the top of what was expected.
    """
    deep = lost_mm > STEEP_MM  # beside a line that was skipped nothing stands as if cut
    if not deep.any():
        return field
    rows, columns = window_around(deep, ROUNDED_CELLS + BESIDE_CELLS)
    z_mm = np.array(field.z_mm, dtype=np.float64)
    near, designed = z_mm[rows, columns], designed_mm[rows, columns]
    deep, lost = deep[rows, columns], lost_mm[rows, columns] > 0
    off_mm = designed - near
    foot_mm = ndimage.minimum_filter(np.where(deep, near, np.inf), 2 * FOOT_CELLS + 1)
    lip = designed - foot_mm > STEEP_MM
    whole = (np.abs(off_mm) < AS_DESIGNED_MM) & ~ndimage.maximum_filter(lost, 3)
    lip &= ndimage.maximum_filter(whole, 2 * ROUNDED_CELLS + 1)
    rounded = lip & (off_mm > 0) & (off_mm < ROUNDED_MM)
    near[rounded] = designed[rounded]
    return field.raised(z_mm)


def window_around(gone: Bool[np.ndarray, "ny nx"], margin: int) -> tuple[slice, slice]:
    """Rows and columns of the window around those that something is missing from."""
    rows, columns = (
        slice(max(int(k.min()) - margin, 0), int(k.max()) + margin + 1) for k in gone.nonzero()
    )
    return rows, columns


def _by_cell(
    points_mm: Float[np.ndarray, "n 3"],
    corner_mm: Float[np.ndarray, " 2"],
    cell_mm: float,
    shape: tuple[int, int],
) -> tuple[Float[np.ndarray, "kept 3"], Int[np.ndarray, "ny nx1"]]:
    """Points over a grid sorted by its cells, and where those of each cell begin, by row."""
    ny, nx = shape
    high_mm = corner_mm + cell_mm * np.array([nx, ny])
    own = points_mm[in_box(points_mm[:, :2], corner_mm, high_mm)]
    index = np.floor((own[:, :2] - corner_mm) / cell_mm).astype(np.int64)
    cell = np.minimum(index[:, 1], ny - 1) * nx + np.minimum(index[:, 0], nx - 1)
    ends = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=ny * nx))])
    start = np.lib.stride_tricks.sliding_window_view(ends, nx + 1)[::nx]
    return own[np.argsort(cell, kind="stable")], np.ascontiguousarray(start)
