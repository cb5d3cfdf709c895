"""What may be printed without asking: limits that the process profile sets."""

from __future__ import annotations

from dataclasses import dataclass

from gcode.profiles import ProcessProfile


@dataclass(frozen=True, slots=True)
class Limits:
    """The most that `--approve auto` prints by itself.

    Attributes
    ----------
    volume_mm3, time_s
        Of one repair.
    reachable_ratio
        The least share of what is missing that the nozzle must reach.
    """

    volume_mm3: float
    time_s: float
    reachable_ratio: float

    @classmethod
    def of(cls, process: ProcessProfile) -> Limits:
        """Those of a process profile."""
        return cls(
            process.unasked_max_mm3, process.unasked_max_s, process.unasked_min_reachable_ratio
        )

    def exceeded(self, *, missing_mm3: float, print_time_s: float, unreachable_mm3: float) -> str:
        """The first limit that a repair exceeds, with both values; empty if none."""
        if missing_mm3 > self.volume_mm3:
            return (
                f"{missing_mm3:.0f} mm³ is missing, the profile allows {self.volume_mm3:g} unasked"
            )
        if print_time_s > self.time_s:
            return (
                f"the repair takes {print_time_s:.0f} s, the profile allows {self.time_s:g} unasked"
            )
        reached = 1.0 - unreachable_mm3 / max(missing_mm3, 1e-9)
        if reached < self.reachable_ratio:
            return (
                f"the nozzle reaches {reached:.0%} of what is missing, the profile asks for "
                f"{self.reachable_ratio:.0%}"
            )
        return ""
