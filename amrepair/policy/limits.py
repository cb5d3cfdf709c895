"""The limits that a process profile sets on repairs that are printed without asking."""

from __future__ import annotations

from gcode.profiles import ProcessProfile


def exceeded(
    limits: ProcessProfile, *, missing_mm3: float, print_time_s: float, unreachable_mm3: float
) -> str:
    """Says which limit a repair exceeds first, with both values; empty if it exceeds none."""
    if missing_mm3 > limits.unasked_max_mm3:
        return (
            f"{missing_mm3:.0f} mm³ is missing, the profile allows "
            f"{limits.unasked_max_mm3:g} unasked"
        )
    if print_time_s > limits.unasked_max_s:
        return (
            f"the repair takes {print_time_s:.0f} s, the profile allows "
            f"{limits.unasked_max_s:g} unasked"
        )
    reached = 1.0 - unreachable_mm3 / max(missing_mm3, 1e-9)
    if reached < limits.unasked_min_reachable_ratio:
        return (
            f"the nozzle reaches {reached:.0%} of what is missing, the profile asks for "
            f"{limits.unasked_min_reachable_ratio:.0%}"
        )
    return ""
