"""What stands in mid-job: the scan's heights, with walls where the job's lines have them.

A cell of the scan is as high as the highest thing in it. Beside a void this makes walls up to a
cell thicker than they are, and keeps the head farther off. The job knows to a hundredth of a
millimetre where its lines lie, and the deficit says which of them are missing.
"""

from __future__ import annotations

import manifold3d
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from amrepair.arrays import ColumnMask, HeightMap
from amrepair.deficit.heights import (
    around_walls,
    beside_walls,
    cells_over,
    columns_of,
    fine_over,
    with_what_stands_out,
    without_missing,
)
from amrepair.deficit.options import DEFAULT_DEFICIT, HeightOptions
from amrepair.scans import Scan
from gcode.slicing.job_lines import SAME_LEVEL_MM, JobLines
from gcode.surfaces import HeightField
from gcode.surfaces.lines import heights_by_lines


def standing_in_job(
    seen: HeightField,
    lines: JobLines | None,
    missing: manifold3d.Manifold,
    scan: Scan,
    spacing_mm: float,
    options: HeightOptions = DEFAULT_DEFICIT.heights,
) -> HeightField:
    """Make the height field in mid-job: as seen, less what is missing, with the lines' walls.

    All is in the build frame.

    Parameters
    ----------
    lines
        All lines that the job has laid so far; None where they are not known: then heights stay as
        they were seen.
    scan
        Points that stand out of the field raise it.
    """
    seen = without_missing(seen, missing, options)
    if lines is None or missing.is_empty():
        return seen
    sharp = standing_lines(seen, lines, missing, options)
    return with_what_stands_out(sharp, scan.points_mm, scan.sigma_mm, spacing_mm, options)


def standing_lines(
    seen: HeightField,
    lines: JobLines,
    missing: manifold3d.Manifold,
    options: HeightOptions = DEFAULT_DEFICIT.heights,
) -> HeightField:
    """The height field on a fine grid, where walls beside what is missing are those of the lines.

    Elsewhere the scan alone decides, and also where it saw something higher. Something must be
    missing; all is in the build frame.
    """
    fine = fine_over(seen, options)
    at = cells_over(seen, fine)
    z_mm, known = seen.z_mm[at].astype(np.float64), seen.seen[at].copy()
    x0, y0, _, x1, y1, _ = (float(v) for v in missing.bounding_box())
    far_mm = options.beside_part_mm
    box = (x0 - far_mm, y0 - far_mm, x1 + far_mm, y1 + far_mm)
    rows, columns = fine.window(box)
    near = fine.crop(box)
    planned_mm, gone = _planned(near, lines, missing)
    z_mm[rows, columns], known[rows, columns] = _steps_of_plan(
        z_mm[rows, columns],
        known[rows, columns],
        planned_mm,
        gone,
        around_walls(seen, fine, options),
        options,
    )
    return HeightField(fine.origin_mm, fine.cell_mm, z_mm, known)


def lines_beside(
    field: HeightField,
    lines: JobLines,
    *,
    over_mm: float,
    options: HeightOptions = DEFAULT_DEFICIT.heights,
) -> HeightField | None:
    """What the job has laid that is higher than the head goes past it; as `heights_beside`."""
    high = lines.some(lines.end_mm[:, 2] > over_mm)
    if not len(high.end_mm):
        return None
    cell_mm, ends = options.cell_mm, np.concatenate([high.start_mm, high.end_mm])[:, :2]
    margin_mm = float(high.section_mm2.max() / max(high.height_mm.min(), SAME_LEVEL_MM)) + cell_mm
    low_mm = ends.min(axis=0) - margin_mm
    nx, ny = (int(n) + 2 for n in (ends.max(axis=0) + margin_mm - low_mm) / cell_mm)
    z_mm = _tops_of(high, low_mm, cell_mm, (ny, nx))
    x0, y0, x1, y1 = field.box_mm
    x, y = (low + (np.arange(n) + 0.5) * cell_mm for low, n in zip(low_mm, (nx, ny), strict=True))
    inside = ((y > y0) & (y < y1))[:, None] & ((x > x0) & (x < x1))[None, :]
    z_mm = np.where(inside | ~np.isfinite(z_mm), 0.0, z_mm)
    return HeightField(low_mm, cell_mm, z_mm, np.ones((ny, nx), bool)) if z_mm.any() else None


def _tops_of(
    some: JobLines, low_mm: Float[np.ndarray, " 2"], cell_mm: float, shape: tuple[int, int]
) -> HeightMap:
    """How high the highest of some lines is in each column; −inf where there is none."""
    within = 0.5 * some.section_mm2 / np.maximum(some.height_mm, SAME_LEVEL_MM)
    return heights_by_lines(
        some.start_mm, some.end_mm, within, some.end_mm[:, 2],
        low_mm=low_mm, cell_mm=cell_mm, shape=shape,
    )  # fmt: skip


def _steps_of_plan(
    seen_mm: HeightMap,
    told: ColumnMask,
    planned_mm: HeightMap,
    gone: ColumnMask,
    around: int,
    options: HeightOptions,
) -> tuple[HeightMap, ColumnMask]:
    """Heights as seen, but with steps where the plan has them; and which columns are known.

    A cell of the scan reads as high as the highest thing in it, so beside a wall its excess height
    is the wall's, and the plan decides. What was seen lower than planned is not there. Where scan
    and plan agree, the scan is right: layers are not quite as high as planned, and a floor that is
    off by a tenth of a layer is a tenth of a bead.
    """
    off_mm = seen_mm - planned_mm
    agrees = told & (np.abs(off_mm) < options.trust_mm)
    share = ndimage.uniform_filter(agrees.astype(np.float64), around)
    level_mm = ndimage.uniform_filter(np.where(agrees, off_mm, 0.0), around)
    # how far off the plan what lies around was seen to be
    as_planned_mm = planned_mm + level_mm / np.maximum(share, 1.0 / around**2)
    by_wall = beside_walls(planned_mm, seen_mm, around, options)
    rim = ndimage.maximum_filter(gone, around)
    by_plan = np.where(told, by_wall & (off_mm >= options.trust_mm), rim)
    return np.where(by_plan, as_planned_mm, seen_mm), told | rim


def _planned(
    near: HeightField, lines: JobLines, missing: manifold3d.Manifold
) -> tuple[HeightMap, ColumnMask]:
    """How high the lines stand that are not missing, and the columns in which something is.

    In each column a layer stands if more of it is there than is missing.
    """
    ny, nx = near.shape
    low_mm = float(missing.bounding_box()[2])
    (x0, y0, x1, y1), high_mm = near.box_mm, float(lines.end_mm[:, 2].max())
    lines = lines.near(np.array([x0, y0, -np.inf]), np.array([x1, y1, high_mm]))
    offsets, z, up = columns_of(missing, near)
    column = np.repeat(np.arange(nx * ny), np.diff(offsets))

    def lost_below(level_mm: float) -> HeightMap:
        below = np.bincount(column, up * np.minimum(z, level_mm), minlength=nx * ny)
        return below.reshape(ny, nx)

    def over(some: JobLines) -> HeightMap:
        return _tops_of(some, near.origin_mm, near.cell_mm, near.shape)

    tops_mm = lines.end_mm[:, 2]
    stands_mm = np.maximum(over(lines.some(tops_mm <= low_mm)), 0.0)
    levels = np.unique(np.round(tops_mm[tops_mm > low_mm], 3))
    for level_mm in levels.tolist():
        own = lines.at(level_mm)
        if not len(own.rim):
            continue
        height_mm = float(np.median(own.height_mm))
        lost = lost_below(level_mm) - lost_below(level_mm - height_mm)
        there = np.isfinite(over(own)) & (lost < 0.5 * height_mm)
        stands_mm = np.where(there, level_mm, stands_mm)
    return stands_mm, np.asarray(lost_below(np.inf) > 0)
