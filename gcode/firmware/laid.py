"""What an emulated printer has laid, as heights: for its own probe to feel.

A bead is as high as the nozzle was and as wide as its volume needs. Nothing sags, spreads or
shrinks here; whoever wants that has `amrepair.simulate`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gcode.firmware.motion import MotionBatch
from gcode.profiles import PrinterProfile
from gcode.surfaces import HeightField
from gcode.surfaces.lines import heights_by_lines
from gcode.units import filament_area_mm2

LAID_CELL_MM = 0.25
LEAST_STRAND_MM = 0.05  # thinner and shorter is none


class Laid:
    """Heights of all beads laid so far."""

    def __init__(self, profile: PrinterProfile) -> None:
        self.surface = HeightField.flat(
            profile.bed_size_mm, LAID_CELL_MM, origin_mm=profile.bed_min_mm
        )
        self._area_mm2 = filament_area_mm2(profile.filament_diameter_mm)

    def add(self, motion: MotionBatch) -> None:
        """Lay what the nozzle pushed out, in order; all of one height at a time."""
        length_mm = np.linalg.norm(motion.end_mm - motion.start_mm, axis=1)
        pick = (motion.filament_mm > 0) & (length_mm > LEAST_STRAND_MM)
        start, end = motion.start_mm[pick], motion.end_mm[pick]
        section = motion.filament_mm[pick] * self._area_mm2 / length_mm[pick]
        for high in np.unique(end[:, 2]):
            own = end[:, 2] == high
            self._add(start[own], end[own], section[own])

    def _add(
        self,
        start_mm: Float[np.ndarray, "n 3"],
        end_mm: Float[np.ndarray, "n 3"],
        section_mm2: Float[np.ndarray, " n"],
    ) -> None:
        surface = self.surface
        under_mm = surface.sample(0.5 * (start_mm + end_mm)[:, :2])
        height_mm = np.maximum(end_mm[:, 2] - under_mm, LEAST_STRAND_MM)
        top_mm = heights_by_lines(
            start_mm, end_mm, 0.5 * section_mm2 / height_mm, end_mm[:, 2],
            low_mm=surface.origin_mm, cell_mm=surface.cell_mm, shape=surface.shape,
        )  # fmt: skip
        np.maximum(surface.z_mm, top_mm, out=surface.z_mm)
