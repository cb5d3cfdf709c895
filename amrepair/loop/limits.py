"""What may be printed without asking: limits that the process profile sets."""

from __future__ import annotations

from dataclasses import dataclass

from amrepair.repair import RepairPlan
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


def beyond(plan: RepairPlan, limits: Limits) -> str:
    """The first limit that a plan's program exceeds, with both values; empty if none."""
    if plan.checked is None or plan.patch is None or plan.estimate is None:
        return ""
    missing_mm3 = sum(region.volume_mm3 for region in plan.to_fill)
    if missing_mm3 > limits.volume_mm3:
        return f"{missing_mm3:.0f} mm³ is missing, the profile allows {limits.volume_mm3:g} unasked"
    if plan.estimate.print_time_s > limits.time_s:
        return (
            f"the repair takes {plan.estimate.print_time_s:.0f} s, the profile allows "
            f"{limits.time_s:g} unasked"
        )
    reached = 1.0 - plan.unreachable_mm3 / max(missing_mm3, 1e-9)
    if reached < limits.reachable_ratio:
        return (
            f"the nozzle reaches {reached:.0%} of what is missing, the profile asks for "
            f"{limits.reachable_ratio:.0%}"
        )
    return ""
