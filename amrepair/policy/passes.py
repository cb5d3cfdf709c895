"""When enough has been done at a stop: another pass would not help, or what is left may be left."""

from __future__ import annotations

from amrepair.policy.options import USUAL_POLICY, PolicyOptions


def is_stuck(before_mm3: float, left_mm3: float, options: PolicyOptions = USUAL_POLICY) -> bool:
    """Whether the last repair changed next to nothing of what is missing."""
    return left_mm3 > options.stuck_ratio * before_mm3


def is_little(found_mm3: float, left_mm3: float, options: PolicyOptions = USUAL_POLICY) -> bool:
    """Whether what is left is a small share of what was found: more passes would only add rims."""
    return left_mm3 <= options.little_ratio * found_mm3


def may_be_left(
    found_mm3: float,
    *,
    missing_mm3: float,
    excess_mm3: float,
    excess_before_mm3: float,
    options: PolicyOptions = USUAL_POLICY,
) -> bool:
    """Whether a stop was left within tolerance.

    Nothing that is worth a repair is left, beyond a share of what was found; and no more than
    that share stands out: a repair's own rims are not a new defect.

    Parameters
    ----------
    found_mm3
        Volume found missing in the job so far: a later look sees earlier repairs, too.
    missing_mm3, excess_mm3
        What the last look found: worth a repair, and standing out.
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
