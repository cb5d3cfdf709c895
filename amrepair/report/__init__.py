"""Report: what people see of a run. It reads results and never changes them."""

from amrepair.report.assemble import plan_is_enough, report_of_loop, report_of_plan
from amrepair.report.data import (
    BeadPath,
    Counter,
    Decision,
    Figures,
    HeightMap,
    Look,
    Outcome,
    RegionRow,
    ReportData,
    SolidMesh,
    TemperatureSeries,
    regions_from_result,
)
from amrepair.report.document import render_report, write_report
from amrepair.report.text import outcome_of, summary, summary_of, summary_of_result

__all__ = [
    "BeadPath",
    "Counter",
    "Decision",
    "Figures",
    "HeightMap",
    "Look",
    "Outcome",
    "RegionRow",
    "ReportData",
    "SolidMesh",
    "TemperatureSeries",
    "outcome_of",
    "plan_is_enough",
    "regions_from_result",
    "render_report",
    "report_of_loop",
    "report_of_plan",
    "summary",
    "summary_of",
    "summary_of_result",
    "write_report",
]
