"""`ReportData` of whole runs: one planned repair, or a loop over a job.

The command line and scripts share it; figures come from `collect`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from amrepair.loop import LoopReport
from amrepair.loop.afterwards import Afterwards
from amrepair.repair import RepairPlan
from amrepair.report.collect import (
    decision_of,
    decision_of_plan,
    look_label,
    look_of,
    region_rows,
    solid_mesh,
    versions,
    wire_counters,
)
from amrepair.report.data import Figures, ReportData, TemperatureSeries
from amrepair.report.options import DEFAULT_PAGE
from amrepair.report.text import outcome_of
from amrepair.template.port import Template
from gcode.profiles import PrintSetup


def plan_is_enough(plan: RepairPlan, late: Afterwards | None = None) -> bool:
    """Whether the program fills all that is missing, and nothing else is wrong.

    Parameters
    ----------
    late
        What stays open inside, where the part's job is at hand: to be asked about, or not enough.
    """
    if late is not None and late.told:
        return False
    if plan.within_tolerance:
        return True
    if plan.checked is None or plan.patch is None or plan.too_much:
        return False
    left_mm3 = plan.unreachable_mm3 + plan.unprintable_mm3
    return left_mm3 <= DEFAULT_PAGE.left_out_ratio * plan.deficit.missing_mm3


def report_of_plan(
    plan: RepairPlan,
    result: Mapping[str, Any],
    *,
    title: str,
    setup: PrintSetup,
    template: Template,
    scan_name: str = "",
    late: Afterwards | None = None,
) -> ReportData:
    """The page of one planned repair.

    Parameters
    ----------
    result
        Of `plan_result`.
    late
        What stays open inside, where the part's job is at hand.
    """
    placed = plan.build_from_template
    enough = plan_is_enough(plan, late)
    return ReportData(
        title=title,
        outcome=outcome_of(result, within_tolerance=enough),
        figures=Figures.from_result(result),
        looks=(look_of(plan, "as scanned", printed=False),),
        setup={"scan": scan_name or Path(plan.scan.source).name, **_profiles(setup)},
        expected=solid_mesh(placed.solid(template.solid())),
        regions=region_rows(plan),
        decisions=(decision_of_plan(plan, enough=enough, late=late),),
        seconds=result["seconds"],
        provenance=versions(setup),
    )


def report_of_loop(
    report: LoopReport,
    result: Mapping[str, Any],
    *,
    title: str,
    setup: PrintSetup,
    about: Mapping[str, str] | None = None,
    expected: Any = None,
    temperatures: tuple[TemperatureSeries, ...] = (),
) -> ReportData:
    """The page of a job with its looks.

    Parameters
    ----------
    result
        Of `loop_result`.
    about
        What else stands under the title.
    expected
        The part as it should be (`manifold3d.Manifold`, build frame), or None.
    """
    return ReportData(
        title=title,
        outcome=outcome_of(result, within_tolerance=report.within_tolerance),
        figures=Figures.from_result(result),
        looks=tuple(
            look_of(
                look.plan,
                look_label(look),
                printed=look.printed,
                stop=look.stop.label,
                scanned_points=look.scanned_points,
            )
            for look in report.looks
        ),
        setup={**_profiles(setup), **(about or {})},
        expected=None if expected is None else solid_mesh(expected),
        regions=tuple(row for look in report.first_looks for row in region_rows(look.plan)),
        decisions=tuple(decision_of(look) for look in report.looks),
        wire=wire_counters(report),
        temperatures=temperatures,
        seconds=result["seconds"],
        provenance={"seed": str(result.get("seed")), **versions(setup)},
    )


def _profiles(setup: PrintSetup) -> dict[str, str]:
    return {
        "printer": setup.printer.name,
        "material": setup.material.name,
        "process": setup.process.name,
    }
