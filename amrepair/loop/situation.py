"""What the table of decisions says of a look: its findings, and how the stop stands."""

from __future__ import annotations

from collections.abc import Sequence

from amrepair.loop.decide import Decision, Situation, decide, gravest, judge
from amrepair.loop.findings import findings
from amrepair.loop.limits import Limits, beyond
from amrepair.loop.looks import Look, Stop
from amrepair.loop.objects import Objects
from amrepair.repair import RepairPlan, Site
from gcode.reader import Job

# A repair that leaves more than this share of what it found has met something else than noise.
STUCK_RATIO = 0.8
# Less than this share of what was found at a stop is not worth another pass.
LITTLE_RATIO = 0.03


def decide_look(
    plan: RepairPlan,
    job: Job,
    site: Site,
    stop: Stop,
    here: Sequence[Look],
    *,
    seen_twice: bool,
    max_iterations: int,
    limits: Limits | None,
    objects: Objects | None = None,
) -> Decision:
    """What the table says of a plan.

    Parameters
    ----------
    here
        The earlier looks of this stop.
    limits
        What may be printed unasked; None where somebody is asked, or all is allowed.
    objects
        The job's.
    """
    verdicts = tuple(
        judge(finding)
        for finding in findings(
            plan,
            job,
            site.setup,
            layer_index=stop.layer_index,
            line=stop.line,
            seen_twice=seen_twice,
            objects=objects,
        )
    )
    situation = Situation(
        gravest=gravest(verdicts),
        seen_twice=seen_twice,
        refused=plan.checked is None,
        last_pass=sum(look.printed for look in here) >= max_iterations,
        stuck=_stuck(here, plan),
        little_left=_done(here, plan),
        beyond="" if limits is None else beyond(plan, limits),
    )
    return decide(verdicts, situation)


def _stuck(here: Sequence[Look], plan: RepairPlan) -> bool:
    """Whether the last repair at this stop changed next to nothing."""
    if not here or not here[-1].printed:
        return False
    return plan.deficit.missing_mm3 > STUCK_RATIO * here[-1].plan.deficit.missing_mm3


def _done(looks: Sequence[Look], plan: RepairPlan) -> bool:
    """Whether what is left is a small share of what was found: more passes would only add rims."""
    if not looks:
        return False
    left_mm3 = sum(region.volume_mm3 for region in plan.to_fill)
    return left_mm3 <= LITTLE_RATIO * looks[0].plan.deficit.missing_mm3
