"""`LearnedSdf`: a prior field and what sound scans say on top of it.

The prior is a part's own field, or the surface that scans share. The scans' bias by place is in the
grid's distances already (`sound.learn`, `merge.fuse`); their spread by place is the tolerance of
the test. Learning is those modules' business.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from amrepair.arrays import Points, Values, Vector, Voxels
from amrepair.frames import cells_of
from amrepair.template.grid import GridSdf, stored_grid

LEARNED_KIND = "learned"
# Sound parts lie within three standard deviations of what they differ by.
TOLERATED_SPREADS = 3.0


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How far normal parts differ, where several scans of them disagreed.

    Attributes
    ----------
    origin_mm, cell_mm
        Corner and edge of the cells, template frame.
    spread_mm
        (x, y, z) standard deviation between normal parts; 0 away from the surface.
    """

    origin_mm: Vector
    cell_mm: float
    spread_mm: Voxels

    def at(self, points_mm: Points) -> Values:
        """(n,) spread at the points; beyond the cells that of the nearest."""
        index = cells_of(points_mm, self.origin_mm, self.cell_mm)
        index = np.clip(index, 0, np.array(self.spread_mm.shape) - 1)
        return self.spread_mm[tuple(index.T)].astype(np.float64)


@dataclass(frozen=True, slots=True)
class LearnedSdf(GridSdf):
    """A field that sound scans have taught (`Template`).

    Attributes
    ----------
    tolerance
        How far sound parts differ, by place.
    """

    tolerance: Tolerance = field(kw_only=True)

    @classmethod
    def on(cls, taught: GridSdf, tolerance: Tolerance) -> LearnedSdf:
        """A field whose distances are learned already, with its tolerance."""
        known = {f.name: getattr(taught, f.name) for f in fields(GridSdf)}
        return cls(**known, tolerance=tolerance)

    def _told_spread_mm(self, points_mm: Points) -> Values:
        return self.tolerance.at(points_mm)

    def _packed(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        arrays, head = GridSdf._packed(self)
        arrays["spread_mm"] = self.tolerance.spread_mm.astype(np.float32)
        return arrays, {
            **head,
            "kind": LEARNED_KIND,
            "spread_origin_mm": self.tolerance.origin_mm.tolist(),
            "spread_cell_mm": self.tolerance.cell_mm,
        }

    @classmethod
    def unpacked(
        cls, path: Path, arrays: dict[str, np.ndarray], head: dict[str, Any]
    ) -> LearnedSdf:
        """The template in a file's arrays and head."""
        tolerance = Tolerance(
            np.array(head["spread_origin_mm"], dtype=np.float64),
            float(head["spread_cell_mm"]),
            arrays["spread_mm"],
        )
        return cls(**stored_grid(path, arrays, head, LEARNED_KIND), tolerance=tolerance)
