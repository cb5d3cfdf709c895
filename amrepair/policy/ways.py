"""What can be done about a defect that was found too late for the nozzle to get to all of it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Way:
    """One way to go on, told before anybody chooses.

    Attributes
    ----------
    name
        `reprint`: stop, cut the part down, print from there on; `leave`: go on as it is.
    filled_mm3, left_mm3
        Of what is buried: what this way brings back, and what stays open.
    print_time_s, filament_mm3
        What is printed a second time.
    layer
        First layer of the job that is printed again; None where none is.
    cut_to_mm
        Height to which the part is cut down, build frame; None where nothing is cut.
    command
        What makes the program that prints it again; empty where none does.
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
