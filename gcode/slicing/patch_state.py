"""What has been laid on a patch's columns so far: immutable, each pass makes the next one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from gcode.slicing.layer_plan import Unfilled
from gcode.slicing.patch_model import PatchModel

SAME_TIP_MM = 0.02  # passes nearer to each other lie beside, not on, each other


@dataclass(frozen=True, slots=True)
class PatchState:
    """Columns of a patch after some passes.

    Attributes
    ----------
    surface_mm
        Height predicted over each column; where something hangs the nozzle's, whatever lies open
        below, less what a bridge sags.
    laid_mm, sunk_mm
        Thickness laid on each column, and given up under what hangs over it.
    done_mm
        Up to where the job's own lines are laid again.
    planar_top_mm
        Where each column ends for passes at one height.
    hem
        Columns laid in the air beside a rim.
    loose
        Columns whose beads fell onto the floor, and those on top of them: no strand is held there.
    hung_mm
        Height at which each column was last laid over air; −∞ where it never was.
    too_long_mm
        Where a bridge would be longer than the material bears, how long; 0 elsewhere.
    lost
        What was found too thin, pass by pass.
    """

    surface_mm: Float[np.ndarray, "ny nx"]
    laid_mm: Float[np.ndarray, "ny nx"]
    sunk_mm: Float[np.ndarray, "ny nx"]
    done_mm: Float[np.ndarray, "ny nx"]
    planar_top_mm: Float[np.ndarray, "ny nx"]
    hem: Bool[np.ndarray, "ny nx"]
    loose: Bool[np.ndarray, "ny nx"]
    hung_mm: Float[np.ndarray, "ny nx"]
    too_long_mm: Float[np.ndarray, "ny nx"]
    lost: tuple[Unfilled, ...] = ()

    @classmethod
    def begun(cls, model: PatchModel) -> PatchState:
        """Before the first pass."""
        nothing = np.zeros(model.shape)
        return cls(
            surface_mm=model.floor_mm,
            laid_mm=nothing,
            sunk_mm=nothing,
            done_mm=np.full(model.shape, -np.inf),
            planar_top_mm=model.top_mm,
            hem=np.zeros(model.shape, dtype=bool),
            loose=np.zeros(model.shape, dtype=bool),
            hung_mm=np.full(model.shape, -np.inf),
            too_long_mm=nothing,
        )

    def hangs_at(self, z_mm: float) -> Bool[np.ndarray, "ny nx"]:
        """Columns that hang at a height: what is laid at the same height they do not hold."""
        return np.asarray(self.hung_mm > z_mm - SAME_TIP_MM)

    def firm_at(self, z_mm: float) -> Bool[np.ndarray, "ny nx"]:
        """Columns whose top holds a strand's end at a height: it neither fell nor hangs there."""
        return ~self.loose & ~self.hangs_at(z_mm)

    def left_below(self, model: PatchModel, z_mm: float) -> Float[np.ndarray, "ny nx"]:
        """Thickness wanted below a height and not laid or given up; negative where more was."""
        return model.wanted_below(z_mm) - self.laid_mm - self.sunk_mm

    def without(self, model: PatchModel, columns: Bool[np.ndarray, "ny nx"]) -> PatchState:
        """As if nothing had been laid on some columns."""
        nothing = np.where(columns, 0.0, 1.0)
        return replace(
            self,
            surface_mm=np.where(columns, model.floor_mm, self.surface_mm),
            laid_mm=self.laid_mm * nothing,
            sunk_mm=self.sunk_mm * nothing,
        )
