"""What the emulated firmware really did with its nozzle, in order."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float

ROW_NUMBERS = 9


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

    @classmethod
    def from_bytes(cls, data: bytes) -> MotionBatch:
        """Rows of nine float64: start, end, filament, speed, time; what the emulator writes."""
        rows = np.frombuffer(data, dtype=np.float64).reshape(-1, ROW_NUMBERS)
        return cls(rows[:, 0:3], rows[:, 3:6], rows[:, 6], rows[:, 7], rows[:, 8])

    def __len__(self) -> int:
        return len(self.filament_mm)

    @classmethod
    def concatenate(cls, batches: list[MotionBatch]) -> MotionBatch:
        """One batch from many, order kept; none gives an empty batch."""
        if not batches:
            none3, none1 = np.zeros((0, 3)), np.zeros(0)
            return cls(none3, none3, none1, none1, none1)
        rows = ([getattr(batch, each.name) for batch in batches] for each in fields(cls))
        return cls(*(np.concatenate(each) for each in rows))


class MotionFile:
    """Moves that another process's emulated printer executed (`gcode emulate --motion FILE`).

    Parameters
    ----------
    path
        Of the file; it may not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._read_bytes = 0

    def take(self) -> MotionBatch:
        """Everything executed since the last call, in order; a row half written waits."""
        if not self.path.is_file():
            return MotionBatch.concatenate([])
        with self.path.open("rb") as file:
            file.seek(self._read_bytes)
            data = file.read()
        whole = len(data) - len(data) % (8 * ROW_NUMBERS)
        self._read_bytes += whole
        return MotionBatch.from_bytes(data[:whole])
