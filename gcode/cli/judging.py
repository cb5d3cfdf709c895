"""What the checker found of a user's own job, in words and as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gcode.cli import console

if TYPE_CHECKING:
    from gcode.check import CheckReport, Refusal

LeaveHeatersOption = Annotated[
    bool,
    typer.Option(
        "--leave-heaters",
        help="Leave on what the job leaves on; else it is switched off by lines put at its end.",
    ),
]


def tell_warnings(file: Path | str, report: CheckReport) -> None:
    """What a user's job does beyond the profiles' figures, on standard error."""
    for warned in report.warnings:
        console.errors.print(f"{file}: warning: {warned}")


def warnings_json(report: CheckReport, key: str = "job_warnings") -> dict[str, Any]:
    """Keys `policy`, `job_warnings` (or what it shall be called) and `added`."""
    return {
        "policy": str(report.policy),
        key: [{**refusal_json(w.worst), "lines": w.lines} for w in report.warnings],
        "added": list(report.added),
    }


def refusal_json(refusal: Refusal) -> dict[str, Any]:
    """One refusal, or one line that is warned of."""
    return {
        "line": refusal.line,
        "move": refusal.text.strip(),
        "what": refusal.what,
        "value": refusal.value,
        "limit": refusal.limit,
    }
