"""What an emulated probe that feels contact meets: heights of what stands on the bed.

Its tip has a flat, which rests on the highest place below it. After a power loss the firmware does
not know its Z: the nozzle is truly `lost_mm` higher than the firmware's own zero tells.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field

import numpy as np

from gcode.profiles import ProbeProfile
from gcode.surfaces import HeightField

Xyz = tuple[float, float, float]


@dataclass(slots=True)
class ProbeContact:
    """A probe that feels what it touches.

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
    tip_radius_mm, offset_mm
        Of the flat that meets the part, and of its middle from the nozzle's tip.
    """

    surface: HeightField
    lost_mm: float = 0.0
    sigma_mm: float = 0.005
    dead: bool = False
    seed: int = 0
    tip_radius_mm: float = 0.0
    offset_mm: Xyz = (0.0, 0.0, 0.0)
    deepest_mm: float = field(default=0.0, init=False)  # how far it ever was below the surface
    _rng: random.Random = field(init=False)

    def __post_init__(self) -> None:
        self._rng = random.Random(self.seed)

    @classmethod
    def of(cls, probe: ProbeProfile | None, surface: HeightField, *, seed: int = 0) -> ProbeContact:
        """The contact of a printer with this probe; of a point of a nozzle where it has none."""
        if probe is None:
            return cls(surface, seed=seed)
        return cls(
            surface,
            sigma_mm=probe.sigma_mm,
            seed=seed,
            tip_radius_mm=probe.tip_radius_mm,
            offset_mm=probe.offset_mm,
        )

    def height_mm(self, x_mm: float, y_mm: float, radius_mm: float = 0.0) -> float:
        """Height of the highest that stands within a radius of a place."""
        surface, cell_mm = self.surface, self.surface.cell_mm
        x, y = x_mm - surface.origin_mm[0], y_mm - surface.origin_mm[1]
        low_x, high_x = (int((x + s * radius_mm) // cell_mm) for s in (-1, 1))
        low_y, high_y = (int((y + s * radius_mm) // cell_mm) for s in (-1, 1))
        rows, columns = surface.z_mm.shape
        iy = np.arange(max(low_y, 0), min(high_y + 1, rows))
        ix = np.arange(max(low_x, 0), min(high_x + 1, columns))
        if not (len(iy) and len(ix)):
            return 0.0
        # the nearest corner of each cell
        dx = np.maximum(np.abs((ix + 0.5) * cell_mm - x) - 0.5 * cell_mm, 0.0)
        dy = np.maximum(np.abs((iy + 0.5) * cell_mm - y) - 0.5 * cell_mm, 0.0)
        within = np.hypot(dy[:, None], dx[None]) <= radius_mm + 1e-9
        return float(surface.z_mm[np.ix_(iy, ix)][within].max(initial=0.0))

    def met_at_mm(self, x_mm: float, y_mm: float) -> float | None:
        """The firmware's Z at which a nozzle on its way down is stopped; None: it never is."""
        if self.dead:
            return None
        dx, dy, dz = self.offset_mm
        height_mm = self.height_mm(x_mm + dx, y_mm + dy, self.tip_radius_mm) - dz
        return height_mm - self.lost_mm + self._rng.gauss(0.0, self.sigma_mm)

    def note(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """Take note of where the nozzle is, for whoever asks how hard it ever pressed."""
        below_mm = self.height_mm(x_mm, y_mm, self.tip_radius_mm) - (z_mm + self.lost_mm)
        self.deepest_mm = max(self.deepest_mm, below_mm)
