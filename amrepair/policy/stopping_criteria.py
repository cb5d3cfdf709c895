"""When to stop repairing at a stop of a job.

Another pass is not worth it when the last one changed nearly nothing, or when little is left.
"""

from __future__ import annotations

from amrepair.policy.options import DEFAULT_POLICY, PolicyOptions


def is_stuck(before_mm3: float, left_mm3: float, options: PolicyOptions = DEFAULT_POLICY) -> bool:
    """Whether the last repair left nearly all of what was missing before it."""
    return left_mm3 > options.stuck_ratio * before_mm3


def is_little(found_mm3: float, left_mm3: float, options: PolicyOptions = DEFAULT_POLICY) -> bool:
    """Whether little of what was found is left: a further pass would mostly add rims."""
    return left_mm3 <= options.little_ratio * found_mm3


def may_be_left(
    found_mm3: float,
    *,
    missing_mm3: float,
    excess_mm3: float,
    excess_before_mm3: float,
    options: PolicyOptions = DEFAULT_POLICY,
) -> bool:
    """Whether what is left at a stop is within tolerance, so that the job may go on.

    A share of the volume that was found may stay missing, and repairs may leave as much standing
    out as rims. What stood out before the first repair, and still does, has a limit of its own.

    Parameters
    ----------
    found_mm3
        Volume found missing in the whole job so far, since a look also sees earlier repairs.
    missing_mm3, excess_mm3
        What the last look found: missing and worth a repair, and standing out.
    excess_before_mm3
        What stood out before the first repair.
    """
    allowed_mm3 = options.left_ratio * found_mm3
    unmended_mm3 = min(excess_before_mm3, excess_mm3)
    return (
        missing_mm3 <= allowed_mm3
        and excess_mm3 - unmended_mm3 <= allowed_mm3
        and unmended_mm3 <= max(allowed_mm3, options.least_mm3)
    )
