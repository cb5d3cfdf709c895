"""What the checker found of a user's own job, in words and as JSON."""

from __future__ import annotations

import re
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


# A click, M108 or M24 ends M0, M1, M25 and M226; M125, M600 and M601 park before they wait.
_FOR_SOMEBODY = re.compile(
    r"^[ \t]*(?:N\d+[ \t]*)?(?:M(?:0?0|0?1|25|125|226|600|601)|PAUSE)\b[^;\n]*",
    re.MULTILINE | re.IGNORECASE,
)


def waits_for_somebody(text: str) -> str:
    """The sentence on lines of a job at which the printer waits for a person; empty if none."""
    found = list(_FOR_SOMEBODY.finditer(text))
    if not found:
        return ""
    first = found[0]
    more = f"; {len(found)} lines do" if len(found) > 1 else ""
    return (
        f"line {text.count(chr(10), 0, first.start()) + 1} ({first[0].strip()!r}) waits for "
        f"somebody at the printer, and nothing is printed until then{more}"
    )


def tell_waits(file: Path | str, text: str) -> None:
    """That a job waits for a person, on standard error, before it begins."""
    if told := waits_for_somebody(text):
        console.errors.print(f"{file}: {told}.")


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
