"""Where the nozzle can be: the tool head's envelope over what stands there, height by height.

A column is out of reach at a height where any slice of the envelope, placed there, would touch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from gcode.profiles import EnvelopeSlice, PrinterProfile
from gcode.surfaces import HeightField

# The flat may press this deep into the plastic beside it; with what a scan gets
# wrong it stays under the checker's limit.
TIP_PRESS_MM = 0.06
# The noise of the field: half of what the checker allows.
BODY_PRESS_MM = 0.05
# The tip lies somewhere in its cell: half of a fine one.
ASIDE_MM = 0.05
LEAST_TOLD_MM = 0.1


@dataclass(frozen=True, slots=True)
class Obstacle:
    """One slice of the envelope over the field: how high the tip must at least be, by column."""

    part: EnvelopeSlice
    least_tip_mm: Float[np.ndarray, "ny nx"]

    @property
    def is_tip(self) -> bool:
        """Whether it is the flat around the bore."""
        return self.part.z_from_mm < 1e-9


def least_tip(
    part: EnvelopeSlice, field: HeightField, window: tuple[slice, slice]
) -> Float[np.ndarray, "ny nx"]:
    """How high the tip must at least be, by column of the window, for a slice to clear all."""
    press_mm = TIP_PRESS_MM if part.z_from_mm < 1e-9 else BODY_PRESS_MM
    under_mm = field.max_within(part.polygon_mm, window, aside_mm=ASIDE_MM)
    return np.asarray(under_mm - part.z_from_mm - press_mm)


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
    """

    def __init__(
        self,
        field: HeightField,
        printer: PrinterProfile,
        *,
        lowest_tip_mm: float = 0.0,
        window_mm: tuple[float, float, float, float] | None = None,
    ) -> None:
        window = field.window(window_mm or field.box_mm)
        self._top_mm = field.top_mm
        # a slice that stays above everything when the tip is lowest cannot touch
        high_mm = field.top_mm - lowest_tip_mm
        self.obstacles = tuple(
            Obstacle(part, least_tip(part, field, window))
            for part in printer.envelope
            if part.z_from_mm <= high_mm
        )
        self.field = field.crop(window_mm or field.box_mm)

    def least_over(self, way_mm: Float[np.ndarray, "n 2"]) -> float:
        """How high the tip must at least be to go along points; where unknown, over everything."""
        index, inside = self._cells(way_mm)
        if not self.obstacles or not inside.all():
            return self._top_mm
        return max(float(o.least_tip_mm[index[:, 0], index[:, 1]].max()) for o in self.obstacles)

    def at(self, z_mm: float) -> Bool[np.ndarray, "ny nx"]:
        """Columns over which the tip may be at this height."""
        free = np.ones(self.field.shape, dtype=bool)
        for obstacle in self.obstacles:
            free &= obstacle.least_tip_mm <= z_mm + 1e-9
        return free

    def free_at_points(
        self, points_mm: Float[np.ndarray, "n 2"], free: Bool[np.ndarray, "ny nx"]
    ) -> Bool[np.ndarray, " n"]:
        """Values of an answer of `at` at points; outside the field nothing stands."""
        index, inside = self._cells(points_mm)
        return np.asarray(~inside | np.asarray(free)[index[:, 0], index[:, 1]])

    def _cells(
        self, points_mm: Float[np.ndarray, "n 2"]
    ) -> tuple[Int[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
        """Cells of points, the first one for those outside, and which lie inside."""
        index = self.field.cells_of(points_mm)
        inside = np.asarray(((index >= 0) & (index < self.field.shape)).all(axis=1))
        return np.where(inside[:, None], index, 0), inside

    def reason_at(self, iy: int, ix: int, z_mm: float) -> str | None:
        """What stands in the way of the tip at one column; None where nothing does."""
        worst, part = 0.0, None
        for obstacle in self.obstacles:
            depth = float(obstacle.least_tip_mm[iy, ix]) - z_mm
            if depth > worst:
                worst, part = depth, obstacle.part
        if part is None:
            return None
        by = f"{worst:.1f} mm" if worst >= LEAST_TOLD_MM else f"less than {LEAST_TOLD_MM:g} mm"
        return f"the {part.part} would touch what stands beside it by {by}"
