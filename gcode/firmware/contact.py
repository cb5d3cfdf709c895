"""What an emulated nozzle that feels contact meets: heights of what stands on the bed.

After a power loss the firmware does not know its Z: the nozzle is truly `lost_mm` higher than the
firmware's own zero tells.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field

from gcode.surfaces import HeightField


@dataclass(slots=True)
class Contact:
    """A nozzle that feels what it touches.

    Parameters
    ----------
    surface
        What stands on the bed, build frame; beyond it the bare bed at 0.
    lost_mm
        True height of the nozzle where the firmware's own zero of Z is.
    sigma_mm
        Standard deviation of one touch.
    dead
        The probe never triggers.
    """

    surface: HeightField
    lost_mm: float = 0.0
    sigma_mm: float = 0.005
    dead: bool = False
    seed: int = 0
    deepest_mm: float = field(default=0.0, init=False)  # how far it ever was below the surface
    _rng: random.Random = field(init=False)

    def __post_init__(self) -> None:
        self._rng = random.Random(self.seed)

    def height_mm(self, x_mm: float, y_mm: float) -> float:
        """Height of what stands at a place."""
        surface = self.surface
        column = int((x_mm - surface.origin_mm[0]) / surface.cell_mm)
        row = int((y_mm - surface.origin_mm[1]) / surface.cell_mm)
        rows, columns = surface.z_mm.shape
        if not (0 <= row < rows and 0 <= column < columns):
            return 0.0
        return float(surface.z_mm[row, column])

    def met_at_mm(self, x_mm: float, y_mm: float) -> float | None:
        """The firmware's Z at which a nozzle on its way down is stopped; None: it never is."""
        if self.dead:
            return None
        height_mm = self.height_mm(x_mm, y_mm) - self.lost_mm
        return height_mm + self._rng.gauss(0.0, self.sigma_mm)

    def note(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """Take note of where the nozzle is, for whoever asks how hard it ever pressed."""
        below_mm = self.height_mm(x_mm, y_mm) - (z_mm + self.lost_mm)
        self.deepest_mm = max(self.deepest_mm, below_mm)
