"""Questions to whoever sits at the terminal."""

from __future__ import annotations

import typer

from amrepair.loop import Decision
from amrepair.repair import RepairPlan
from gcode.cli import console


def ask_to_print(plan: RepairPlan) -> bool:
    """Show what would be printed, and wait for a word."""
    cost = plan.estimate
    console.errors.print(
        f"{len(plan.to_fill)} regions, {plan.deficit.missing_mm3:.1f} mm³ missing; a repair takes "
        f"{cost.print_time_s if cost else 0:.0f} s and {cost.filament_mm if cost else 0:.0f} mm of "
        f"filament; the nozzle cannot reach {plan.unreachable_mm3:.1f} mm³."
    )
    return typer.confirm("Print it?", default=False, err=True)


def ask_to_go_on(decision: Decision) -> bool:
    """Say why the run rests, and wait for a word."""
    for verdict in decision.verdicts:
        if verdict.action is decision.action:
            one = verdict.finding
            low, high = one.box_mm
            console.errors.print(
                f"{one.type}, {one.volume_mm3:.1f} mm³ {one.kind} at X {low[0]:.0f} to "
                f"{high[0]:.0f}, Y {low[1]:.0f} to {high[1]:.0f} mm: {verdict.reason}."
            )
    return typer.confirm("Go on all the same? (no ends the run)", default=False, err=True)
