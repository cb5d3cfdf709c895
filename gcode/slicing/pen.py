"""`Pen`: turns beads and places into moves, keeping position and retraction straight.

It decides how to get from here to there (directly, or retracted and lifted), not where to go.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gcode.moves import Extrude, Move, Retract, Role, SetFan, Travel
from gcode.profiles import PrintSetup
from gcode.slicing.beads import Bead, width_of

MERGE_MM = 0.02  # a bead that starts this near needs no travel
LEAST_STEP_MM = 1e-4


class Pen:
    """Collects moves.

    Parameters
    ----------
    position_mm
        (3,) where the nozzle stands before the first move.
    """

    def __init__(self, setup: PrintSetup, position_mm: Float[np.ndarray, " 3"]) -> None:
        self._setup = setup
        self.moves: list[Move] = []
        self.position_mm = np.asarray(position_mm, float).copy()
        self.retracted = False
        self.fan_ratio: float | None = None  # not told yet

    def add(self, move: Move) -> None:
        """Append a move that does not change the place."""
        self.moves.append(move)
        if isinstance(move, SetFan):
            self.fan_ratio = move.ratio

    def retract(self) -> None:
        """Pull the filament back, once."""
        printer = self._setup.printer
        if not self.retracted and printer.retraction_mm > 0:
            self.add(Retract(printer.retraction_mm, printer.retraction_speed_mm_s))
            self.retracted = True

    def unretract(self) -> None:
        """Push it out again, once."""
        printer = self._setup.printer
        if self.retracted:
            self.add(Retract(-printer.retraction_mm, printer.retraction_speed_mm_s))
            self.retracted = False

    def move_to(self, point_mm: Float[np.ndarray, " 3"]) -> None:
        """One straight travel; vertical ones at the Z axis's own speed."""
        target = np.asarray(point_mm, float)
        step = np.abs(target - self.position_mm)
        if step.max() < LEAST_STEP_MM:
            return
        printer = self._setup.printer
        flat = float(np.hypot(step[0], step[1]))
        speed = printer.travel_speed_mm_s
        if step[2] > LEAST_STEP_MM:
            # The Z axis limits the speed of a slanted move.
            share = step[2] / float(np.hypot(flat, step[2]))
            speed = min(speed, printer.z_speed_mm_s / share)
        self.add(Travel(target[None, :].copy(), speed))
        self.position_mm = target.copy()

    def hop_to(self, point_mm: Float[np.ndarray, " 3"], *, over_mm: float) -> None:
        """Retract, rise to `over_mm` (never down), go across, come down, ready to extrude."""
        target = np.asarray(point_mm, float)
        over = max(over_mm, float(self.position_mm[2]), float(target[2]))
        self.retract()
        self.move_to(np.array([*self.position_mm[:2], over]))
        self.move_to(np.array([*target[:2], over]))
        self.move_to(target)
        self.unretract()

    def extrude(
        self,
        points_mm: Float[np.ndarray, "n 3"],
        section_mm2: Float[np.ndarray, " m"],
        *,
        speed_mm_s: float,
        role: Role,
        width_mm: float,
        height_mm: float,
    ) -> None:
        """Lay a chain of beads from the present place, as fast as the melt and the Z axis allow."""
        fastest = self._setup.max_volumetric_mm3_s / max(float(section_mm2.max()), 1e-9)
        z_mm = points_mm[:, 2]
        if (z_mm != z_mm[0]).any():
            step = np.abs(np.diff(points_mm, axis=0))
            climb = float((step[:, 2] / np.maximum(np.linalg.norm(step, axis=1), 1e-9)).max())
            fastest = min(fastest, self._setup.printer.z_speed_mm_s / max(climb, 1e-9))
        self.unretract()
        self.add(
            Extrude(points_mm, section_mm2, min(speed_mm_s, fastest), role, width_mm, height_mm)
        )
        self.position_mm = points_mm[-1].astype(float).copy()

    def lay(self, bead: Bead, *, z_mm: float, height_mm: float, speed_mm_s: float) -> None:
        """Lay a plane bead of one layer."""
        points = np.empty((len(bead.xy_mm), 3))
        points[:, :2], points[:, 2] = bead.xy_mm, z_mm
        self.extrude(
            points,
            bead.share_mm * height_mm,
            speed_mm_s=speed_mm_s,
            role=bead.role,
            width_mm=width_of(float(bead.share_mm.mean()), height_mm),
            height_mm=height_mm,
        )
