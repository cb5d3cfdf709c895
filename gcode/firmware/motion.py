"""What the emulated firmware really did with its nozzle, in order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, slots=True)
class MotionBatch:
    """Executed moves, in order, build frame.

    Attributes
    ----------
    start_mm, end_mm
        (n, 3) nozzle positions.
    filament_mm
        (n,) filament pushed during the move (negative: pulled), after cold-extrusion prevention.
    speed_mm_s
        (n,) commanded speed.
    time_s
        (n,) the printer's own clock at the end of the move, s since power-up.
    """

    start_mm: Float[np.ndarray, "n 3"]
    end_mm: Float[np.ndarray, "n 3"]
    filament_mm: Float[np.ndarray, " n"]
    speed_mm_s: Float[np.ndarray, " n"]
    time_s: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.filament_mm)

    @classmethod
    def concatenate(cls, batches: list[MotionBatch]) -> MotionBatch:
        """One batch from many, order kept; none gives an empty batch."""
        if not batches:
            none3, none1 = np.zeros((0, 3)), np.zeros(0)
            return cls(none3, none3, none1, none1, none1)
        return cls(
            np.concatenate([batch.start_mm for batch in batches]),
            np.concatenate([batch.end_mm for batch in batches]),
            np.concatenate([batch.filament_mm for batch in batches]),
            np.concatenate([batch.speed_mm_s for batch in batches]),
            np.concatenate([batch.time_s for batch in batches]),
        )
