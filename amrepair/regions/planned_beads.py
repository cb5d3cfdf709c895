"""Planned beads: the job's topmost lines, as they should lie where a scan looks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from amrepair.arrays import Mask, Points, Values
from amrepair.frames import cells_of
from amrepair.regions import skipped_kernels as kernels
from gcode.compiled import read_only
from gcode.stretches import places_to_ends

TOGETHER_MM = 0.5  # points in a cell so wide are asked together
RECENT_MM = 1.0  # below the highest: what lies deeper is under other beads


@dataclass(frozen=True, slots=True)
class PlannedBeads:
    """Beads that the job has laid and a scan should show, as straight lines, template frame.

    Attributes
    ----------
    start_mm, end_mm
        (n, 3) nozzle positions; a bead hangs below them by its height.
    width_mm, height_mm
        (n,) of the section, which is taken for a rectangle.
    strays
        (n,) whether a line may lie off its planned place, as a support's thin free lines do; None
        where none may.
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
        """The topmost of a job's beads (deeper ones are covered); widths follow from sections."""
        high_mm = np.maximum(start_mm[:, 2], end_mm[:, 2])
        width_mm = section_mm2 / np.maximum(height_mm, 1e-6)
        every = cls(start_mm, end_mm, width_mm, height_mm, strays)
        return every.some(high_mm > high_mm.max(initial=-np.inf) - RECENT_MM)

    def some(self, which: Mask | Int[np.ndarray, " k"]) -> PlannedBeads:
        """The chosen ones."""
        return PlannedBeads(
            self.start_mm[which],
            self.end_mm[which],
            self.width_mm[which],
            self.height_mm[which],
            None if self.strays is None else self.strays[which],
        )

    def samples_mm(self, step_mm: float) -> Points:
        """(p, 3) places along the lines, at the nozzle's height, at most `step_mm` apart."""
        return places_to_ends(self.start_mm, self.end_mm, step_mm)[0]

    def holds(self, points_mm: Points) -> Mask:
        """(p,) which points lie in a bead: between its top and floor, and within half its width."""
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
