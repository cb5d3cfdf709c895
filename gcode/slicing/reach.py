"""Where the nozzle can be: the tool head's envelope over what stands there, height by height.

A column is out of reach at a height where any slice of the envelope, placed there, would touch.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from gcode.profiles import EnvelopeSlice, PrinterProfile
from gcode.surfaces import HeightField

# So deep the flat may press into the plastic beside it, and the body lie in the noise of the field;
# with what a scan gets wrong it stays under the checker's limits, 0.2 and 0.1 mm.
PRESS_MM = 0.06
# A wall may stand this much nearer than its cells say: beside the flat, where a hundredth counts.
# Beside a cone half a cell is half a cell of depth and no wall: there it only keeps a rim that just
# touches a cell from being taken to miss it.
SIDE_MM = 0.03
CONE_SIDE_MM = 0.01
# What reaches farther than a nozzle's hexagon, a block or a carriage, keeps off by a column more:
# it passes many walls at once, and one column that a scan tells too low is enough to graze one.
HEXAGON_MM = 6.0
# In cells of this size; in wider ones a cone, which rises by one in one, reads as much deeper.
PRESS_CELL_MM = 0.1
LEAST_TOLD_MM = 0.1


@dataclass(frozen=True, slots=True)
class Obstacle:
    """One slice of the envelope over the field: how high the tip must at least be, by column."""

    part: EnvelopeSlice
    least_tip_mm: Float[np.ndarray, "ny nx"]


def least_tip(
    part: EnvelopeSlice, field: HeightField, window: tuple[slice, slice], finer: int = 1
) -> Float[np.ndarray, "ny nx"]:
    """How high the tip must at least be for a slice to clear all, wherever in its cell it is.

    By column of the window, each cut into `finer` × `finer`. A cone is asked about at their
    middles: a little aside it is as little higher, not a wall.
    """
    if part.widening_mm > 0:
        near, inside = _cut(field, window, part.reach_mm, finer)
        under_mm = near.max_within(
            part.polygon_mm,
            inside,
            aside_mm=CONE_SIDE_MM,
            widening_mm=part.widening_mm,
            height_mm=part.height_mm,
        )
        deeper_mm = max(field.cell_mm - PRESS_CELL_MM, 0.0)
        return under_mm - part.z_from_mm - max(PRESS_MM - deeper_mm, 0.0)
    side_mm = SIDE_MM if part.reach_mm <= HEXAGON_MM else field.cell_mm
    rows, columns = (finer * (w.stop - w.start) for w in window)
    least = np.empty((rows, columns))
    cell_mm = field.cell_mm / finer
    for iy in range(finer):
        for ix in range(finer):
            dx, dy = ((k - 0.5 * (finer - 1)) * cell_mm for k in (ix, iy))
            moved = [(x + dx, y + dy) for x, y in part.polygon_mm]
            under_mm = field.max_within(moved, window, aside_mm=0.5 * cell_mm + side_mm)
            least[iy::finer, ix::finer] = under_mm - part.z_from_mm - PRESS_MM
    return least


def _cut(
    field: HeightField, window: tuple[slice, slice], around_mm: float, finer: int
) -> tuple[HeightField, tuple[slice, slice]]:
    """A window of the field and so much around it, each cell cut into `finer` × `finer`.

    And the window in it. A cone's rim, which is 0.6 mm wide, is rounded to cells on the way: by a
    tenth of a millimetre of depth in the field's own.
    """
    near = tuple(_wider(w, _cells_within(field, around_mm)) for w in window)
    first = [w.start for w in near]
    z_mm = field.z_mm[near].repeat(finer, axis=1).repeat(finer, axis=0)
    seen = np.ones(z_mm.shape, dtype=bool)  # nobody asks
    origin_mm = field.origin_mm + np.array(first[::-1]) * field.cell_mm
    y, x = (
        slice(finer * (w.start - a), finer * (w.stop - a))
        for a, w in zip(first, window, strict=True)
    )
    return HeightField(origin_mm, field.cell_mm / finer, z_mm, seen), (y, x)


def _cells_within(field: HeightField, around_mm: float) -> int:
    """Cells that what reaches so far may touch, rounding and margins included."""
    return math.ceil(around_mm / field.cell_mm) + 3


def _wider(window: slice, more: int) -> slice:
    """So many cells more on both sides; a slice may end beyond its field, not begin before it."""
    return slice(max(window.start - more, 0), window.stop + more)


class Reach:
    """Answers where the tip may go.

    Parameters
    ----------
    field
        What stands there; the answers are on its grid, within the window.
    lowest_tip_mm
        The tip is never asked about below this height.
    window_mm
        (x_min, y_min, x_max, y_max) where the tip is asked about; None is all of the field.
    finer
        Cells of the tip in one of the field, each way: the smaller they are, the less is lost to
        not knowing where in its cell the tip is.
    before
        The same over the same grid, when other things stood there: only around what has changed
        since is asked again.
    """

    def __init__(
        self,
        field: HeightField,
        printer: PrinterProfile,
        *,
        lowest_tip_mm: float = 0.0,
        window_mm: tuple[float, float, float, float] | None = None,
        finer: int = 1,
        before: Reach | None = None,
    ) -> None:
        window = field.window(window_mm or field.box_mm)
        self._whole = field
        self._top_mm = field.top_mm
        # A slice that stays above everything when the tip is lowest cannot touch anything.
        high_mm = field.top_mm - lowest_tip_mm
        self.obstacles = tuple(
            Obstacle(part, self._least_tip(part, window, finer, before))
            for part in printer.head
            if part.z_from_mm <= high_mm
        )
        self.field = field.crop(window_mm or field.box_mm)
        self.cell_mm = field.cell_mm / finer
        self.shape = (finer * self.field.shape[0], finer * self.field.shape[1])

    def _least_tip(
        self,
        part: EnvelopeSlice,
        window: tuple[slice, slice],
        finer: int,
        before: Reach | None,
    ) -> Float[np.ndarray, "ny nx"]:
        """`least_tip`; of a slice that is no cone, from what was so before where nothing changed.

        A cone's sweep hands on from cell to cell: what changes may count anywhere.
        """
        known = [o for o in before.obstacles if o.part == part] if before is not None else []
        if before is None or not known or part.widening_mm > 0:
            return least_tip(part, self._whole, window, finer)
        more = _cells_within(self._whole, part.reach_mm)
        near = tuple(_wider(w, more) for w in window)
        changed = self._whole.z_mm[near] != before._whole.z_mm[near]
        if not changed.any():
            return known[0].least_tip_mm
        around = []
        for axis, (beside, w) in enumerate(zip(near, window, strict=True)):
            at = beside.start + np.flatnonzero(changed.any(axis=1 - axis))
            around.append(slice(max(at[0] - more, w.start), min(at[-1] + 1 + more, w.stop)))
        least = known[0].least_tip_mm.copy()
        rows, columns = (
            slice(finer * (a.start - w.start), finer * (a.stop - w.start))
            for a, w in zip(around, window, strict=True)
        )
        least[rows, columns] = least_tip(part, self._whole, (around[0], around[1]), finer)
        return least

    def least_over(self, way_mm: Float[np.ndarray, "n 2"]) -> float:
        """How high the tip must at least be to go along points; where unknown, over everything."""
        index, inside = self.cells_of(way_mm)
        if not self.obstacles or not inside.all():
            return self._top_mm
        return float(self.need_mm[index[:, 0], index[:, 1]].max())

    @functools.cached_property
    def need_mm(self) -> Float[np.ndarray, "ny nx"]:
        """How high the tip must at least be, by column."""
        need = np.full(self.shape, -np.inf)
        for obstacle in self.obstacles:
            np.maximum(need, obstacle.least_tip_mm, out=need)
        return need

    def centres_mm(self) -> Float[np.ndarray, "n 2"]:
        """Middles of its cells, row by row."""
        y, x = ((np.arange(n) + 0.5) * self.cell_mm for n in self.shape)
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) + self.field.origin_mm

    def at(self, z_mm: float | Float[np.ndarray, "ny nx"]) -> Bool[np.ndarray, "ny nx"]:
        """Columns over which the tip may be at this height."""
        return self.need_mm <= z_mm + 1e-9

    def free_at_points(
        self, points_mm: Float[np.ndarray, "n 2"], free: Bool[np.ndarray, "ny nx"]
    ) -> Bool[np.ndarray, " n"]:
        """Values of an answer of `at` at points; outside the field nothing stands."""
        return self.free_in_cells(self.cells_of(points_mm), free)

    def free_in_cells(
        self,
        cells: tuple[Int[np.ndarray, "n 2"], Bool[np.ndarray, " n"]],
        free: Bool[np.ndarray, "ny nx"],
    ) -> Bool[np.ndarray, " n"]:
        """The same for cells that `cells_of` gave, for those who ask again and again."""
        index, inside = cells
        return np.asarray(~inside | np.asarray(free)[index[:, 0], index[:, 1]])

    def cells_of(
        self, points_mm: Float[np.ndarray, "n 2"]
    ) -> tuple[Int[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
        """Cells of points, the first one for those outside, and which lie inside."""
        return cells_below(points_mm, self.field.origin_mm, self.cell_mm, self.shape)

    def reason_at(self, point_mm: Float[np.ndarray, " 2"], z_mm: float) -> str | None:
        """What stands in the way of the tip at one place; None where nothing does."""
        index, inside = self.cells_of(point_mm[None])
        iy, ix = (int(v) for v in index[0])
        worst, part = 0.0, None
        if not inside[0]:
            return None
        for obstacle in self.obstacles:
            depth = float(obstacle.least_tip_mm[iy, ix]) - z_mm
            if depth > worst:
                worst, part = depth, obstacle.part
        if part is None:
            return None
        by = f"{worst:.1f} mm" if worst >= LEAST_TOLD_MM else f"less than {LEAST_TOLD_MM:g} mm"
        return f"the {part.part} would touch what stands beside it by {by}"


def cells_below(
    points_mm: Float[np.ndarray, "n 2"],
    origin_mm: Float[np.ndarray, " 2"],
    cell_mm: float,
    shape: tuple[int, int],
) -> tuple[Int[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Rows and columns of a grid's cells below points, the first for those beyond; which are in."""
    index = np.floor((points_mm - origin_mm) / cell_mm).astype(np.int64)[:, ::-1]
    inside = np.asarray(((index >= 0) & (index < shape)).all(axis=1))
    return np.where(inside[:, None], index, 0), inside
