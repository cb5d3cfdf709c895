"""Report: what people see of a run. It reads results and never changes them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gcode.lazy import lazy_names

if TYPE_CHECKING:
    from amrepair.report.assemble import plan_is_enough, report_of_loop, report_of_plan
    from amrepair.report.data import (
        BeadPath,
        Counter,
        Figures,
        Outcome,
        RegionRow,
        ReportData,
        ReportDecision,
        ReportLook,
        SolidMesh,
        TemperatureSeries,
    )
    from amrepair.report.document import write_report
    from amrepair.report.text import outcome_of, summary, summary_of_result

__all__ = [
    "BeadPath",
    "Counter",
    "Figures",
    "Outcome",
    "RegionRow",
    "ReportData",
    "ReportDecision",
    "ReportLook",
    "SolidMesh",
    "TemperatureSeries",
    "outcome_of",
    "plan_is_enough",
    "report_of_loop",
    "report_of_plan",
    "summary",
    "summary_of_result",
    "write_report",
]

_HOMES = {
    "amrepair.report.assemble": "plan_is_enough, report_of_loop, report_of_plan",
    "amrepair.report.data": (
        "BeadPath, Counter, Figures, Outcome, RegionRow, ReportData, ReportDecision, "
        "ReportLook, SolidMesh, TemperatureSeries"
    ),
    "amrepair.report.document": "write_report",
    "amrepair.report.text": "outcome_of, summary, summary_of_result",
}

__getattr__, __dir__ = lazy_names(globals(), _HOMES)
