"""What the checker found of a user's own job, in words and as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gcode.cli import console
from gcode.profiles import DEFAULT_MATERIAL

if TYPE_CHECKING:
    from gcode.check import CheckReport, Refusal
    from gcode.profiles import PrintSetup

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
        console.errors.print(f"{file}: warning: {warned}", markup=False)


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


def setup_to_judge(printer: str, material: str | None) -> PrintSetup:
    """Profiles to judge by; of a filament that nobody named only the hotend's limit is known."""
    from gcode.profiles import load_setup

    setup = load_setup(printer, material or DEFAULT_MATERIAL)
    return setup if material is not None else setup.melting_all()
