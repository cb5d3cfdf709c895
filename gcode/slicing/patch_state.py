"""The state of a patch's columns after some passes: immutable, each pass makes the next one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from gcode.slicing.patch_model import PatchModel

SAME_TIP_MM = 0.02  # passes nearer to each other lie beside, not on, each other


@dataclass(frozen=True, slots=True)
class PatchState:
    """The columns of a patch after some passes.

    Attributes
    ----------
    surface_mm
        The predicted height of each column's surface. Where a strand hangs over a gap, it is the
        strand's height less its sag.
    laid_mm, sunk_mm
        The thickness laid on each column, and the thickness given up under hanging strands.
    done_mm
        The height up to which the job's own lines are laid again.
    planar_top_mm
        The height at which each column ends for planar passes.
    hem
        Columns laid over air beside a rim.
    loose
        Columns whose beads fell onto the floor, or lie on such beads: they hold no strand.
    hung_mm
        The height at which each column was last laid over air; −∞ where it never was.
    too_long_mm
        The length of a bridge that would be longer than the material bears; 0 elsewhere.
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

    @classmethod
    def begun(cls, model: PatchModel) -> PatchState:
        """The state before the first pass."""
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
        """Columns that hang at a height, and so hold nothing that is laid at the same height."""
        return np.asarray(self.hung_mm > z_mm - SAME_TIP_MM)

    def firm_at(self, z_mm: float) -> Bool[np.ndarray, "ny nx"]:
        """Columns that hold a strand's end at a height: their top neither fell nor hangs there."""
        return ~self.loose & ~self.hangs_at(z_mm)

    def left_below(self, model: PatchModel, z_mm: float) -> Float[np.ndarray, "ny nx"]:
        """Thickness still missing below a height; negative where more was laid than was missing."""
        return model.wanted_below(z_mm) - self.laid_mm - self.sunk_mm

    def without(self, model: PatchModel, columns: Bool[np.ndarray, "ny nx"]) -> PatchState:
        """The state as if nothing had been laid on some columns."""
        nothing = np.where(columns, 0.0, 1.0)
        return replace(
            self,
            surface_mm=np.where(columns, model.floor_mm, self.surface_mm),
            laid_mm=self.laid_mm * nothing,
            sunk_mm=self.sunk_mm * nothing,
        )
