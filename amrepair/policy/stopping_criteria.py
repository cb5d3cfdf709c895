"""When to stop repairing at a stop of a job.

Another pass is not worth it when the last one changed nearly nothing, or when little is left. Where
nothing of it came out of the nozzle, neither is the rest of the job.
"""

from __future__ import annotations

from amrepair.policy.options import DEFAULT_POLICY, PolicyOptions


def is_stuck(before_mm3: float, left_mm3: float, options: PolicyOptions = DEFAULT_POLICY) -> bool:
    """Whether the last repair left nearly all of what was missing before it."""
    return left_mm3 > options.stuck_ratio * before_mm3


def is_laid_nothing(
    before_mm3: float, laid_mm3: float, risen_mm3: float, options: PolicyOptions = DEFAULT_POLICY
) -> bool:
    """Whether nothing of the last repair came out of the nozzle, by its balance.

    Either all that was to be laid has risen, or nothing has: the nozzle is clogged, or the filament
    out. Two scans of one defect differ by no more than the share by which a repair counts as
    stuck, so where more than twice that was to be laid, what has risen tells which.

    Parameters
    ----------
    before_mm3
        What was missing before the repair.
    laid_mm3
        What of it the repair was to fill.
    risen_mm3
        What rose there: of what was missing, and on top of it.
    """
    differ_mm3 = (1.0 - options.stuck_ratio) * before_mm3
    return risen_mm3 < differ_mm3 < laid_mm3 - differ_mm3


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
