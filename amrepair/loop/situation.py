"""What the table of decisions says of a look: its findings, and how the stop stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import manifold3d

from amrepair.loop.buried_defects import (
    buried,
    buried_mm3,
    covered_at,
    pieces_of,
    printed_again,
    ways,
)
from amrepair.loop.filaments import other_material
from amrepair.loop.findings import findings
from amrepair.loop.looks import Look, Stop
from amrepair.loop.objects import Objects
from amrepair.policy import DEFAULT_POLICY, Decision, PolicyOptions, decide, gravest, judge
from amrepair.policy.acceptance import volume_mm3
from amrepair.policy.limits import exceeded
from amrepair.policy.stopping_criteria import is_laid_nothing, is_little, is_stuck
from amrepair.policy.table import Action, Situation
from amrepair.repair import RepairPlan, Site
from gcode.profiles import ProcessProfile
from gcode.reader import Job


def decide_look(
    plan: RepairPlan,
    job: Job,
    site: Site,
    stop: Stop,
    here: Sequence[Look],
    *,
    seen_twice: bool,
    limits: ProcessProfile | None,
    policy: PolicyOptions = DEFAULT_POLICY,
    objects: Objects | None = None,
) -> Decision:
    """What the table says of a plan.

    Parameters
    ----------
    here
        The earlier looks of this stop.
    limits
        Whose limits hold for what is printed unasked; None where somebody is asked, or all is
        allowed.
    objects
        The job's.
    """
    verdicts = tuple(
        judge(finding, policy)
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
    stuck, laid_nothing = _by_last_repair(here, plan, policy)
    left = buried(pieces_of(plan, here), stop, plan.layer_height_mm, policy)
    situation = Situation(
        gravest=gravest(verdicts),
        seen_twice=seen_twice,
        refused=plan.checked is None,
        last_pass=sum(look.printed for look in here) >= policy.most_passes,
        stuck=stuck,
        laid_nothing=laid_nothing,
        little_left=_done(here, plan, policy),
        beyond="" if limits is None else _beyond(plan, limits),
        buried_mm3=buried_mm3(left),
        other_material=other_material(plan, job, stop.line),
    )
    decision = decide(verdicts, situation, policy)
    first = plan.shifted_from
    if first is not None and decision.action in (Action.STOP, Action.PAUSE):
        if first > job.turn_at(stop.line).first_layer:
            decision = replace(decision, ways=(printed_again(first, job, stop, site.setup),))
        return decision
    if decision.action is not Action.OFFER:
        return decision
    covered = covered_at(plan, here)
    reason = decision.reason if covered is None else f"{covered.told}; {decision.reason}"
    return replace(decision, reason=reason, ways=ways(left, job, stop, site.setup))


def _by_last_repair(
    here: Sequence[Look], plan: RepairPlan, policy: PolicyOptions
) -> tuple[bool, bool]:
    """Of the last repair at this stop, whether it changed next to nothing, and laid nothing."""
    repair = next((look.plan for look in reversed(here) if look.printed), None)
    if repair is None:
        return False, False
    before = repair.deficit.missing
    before_mm3, left_mm3 = before.volume(), _left_in_place_mm3(before, plan.deficit.missing)
    if repair.patch is None:
        return is_stuck(before_mm3, left_mm3, policy), False
    # what was laid where nothing was missing stands out there
    stands_mm3, stood_mm3 = (_over_mm3(before, one.deficit.excess) for one in (plan, repair))
    risen_mm3 = before_mm3 - left_mm3 + max(stands_mm3 - stood_mm3, 0.0)
    laid_nothing = is_laid_nothing(before_mm3, repair.patch.reachable_mm3, risen_mm3, policy)
    return is_stuck(before_mm3, left_mm3, policy) and not laid_nothing, laid_nothing


def _over_mm3(missing: manifold3d.Manifold, excess: manifold3d.Manifold) -> float:
    """How much of what is too much lies over a place where something was missing."""
    place = missing.project()
    pieces = (piece for piece in excess.decompose() if (piece.project() ^ place).area() > 0.0)
    return float(sum(piece.volume() for piece in pieces))


def _left_in_place_mm3(before: manifold3d.Manifold, now: manifold3d.Manifold) -> float:
    """How much of what is missing now was missing there before.

    A later look also sees what an earlier one was not sure of, which no repair has tried to fill.
    Two scans of one defect differ at its rim, so a piece that mostly lies in what was missing
    counts whole; any other by what it shares with that.
    """
    left_mm3 = 0.0
    for piece in now.decompose():
        whole_mm3, shared_mm3 = piece.volume(), (piece ^ before).volume()
        left_mm3 += whole_mm3 if shared_mm3 > 0.5 * whole_mm3 else shared_mm3
    return left_mm3


def _done(looks: Sequence[Look], plan: RepairPlan, policy: PolicyOptions) -> bool:
    """Whether what is left at this stop is too little for another pass."""
    if not looks:
        return False
    left_mm3 = volume_mm3(plan.to_fill)
    return is_little(looks[0].plan.deficit.missing_mm3, left_mm3, policy)


def _beyond(plan: RepairPlan, limits: ProcessProfile) -> str:
    """The first limit that a plan's program exceeds; empty if none."""
    if plan.checked is None or plan.patch is None or plan.estimate is None:
        return ""
    return exceeded(
        limits,
        missing_mm3=volume_mm3(plan.to_fill),
        print_time_s=plan.estimate.print_time_s,
        unreachable_mm3=plan.unreachable_mm3,
    )
