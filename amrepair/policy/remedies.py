"""What can be done about a defect that later layers have buried.

A defect that is found layers later may lie where the nozzle no longer gets to all of it. Then there
are two remedies: cut the part down and print it again from there, or leave the rest open.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Way:
    """One remedy, with what it costs, as it is shown to whoever has to choose.

    Attributes
    ----------
    name
        `reprint`: stop, cut the part down, print from there on; `leave`: go on as it is.
    filled_mm3, left_mm3
        How much of the buried volume this remedy fills, and how much stays open.
    print_time_s, filament_mm3
        Time and material for what is printed a second time.
    layer
        The first layer of the job that is printed again; None for `leave`.
    cut_to_mm
        The height to which the part is cut down, build frame; None for `leave`.
    command
        The command that makes the program for the reprint; empty for `leave`.
    """

    name: str
    filled_mm3: float
    left_mm3: float
    print_time_s: float = 0.0
    filament_mm3: float = 0.0
    layer: int | None = None
    cut_to_mm: float | None = None
    command: str = ""

    @property
    def told(self) -> str:
        """One sentence, with the command where there is one."""
        if self.layer is None or self.cut_to_mm is None:
            return f"let it be: {self.left_mm3:.1f} mm³ stay open inside"
        return (
            f"stop, cut the part down to {self.cut_to_mm:.2f} mm and print from there on "
            f"('{self.command}'): {self.filled_mm3:.1f} mm³ come back, "
            f"{self.print_time_s / 60.0:.1f} min and {self.filament_mm3:.0f} mm³ of plastic are "
            "printed again"
        )

    def to_json(self) -> dict[str, Any]:
        """As it stands in results and records."""
        return {
            key: round(value, 3) if isinstance(value, float) else value
            for key, value in asdict(self).items()
        }
