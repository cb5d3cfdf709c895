"""`amrepair doctor`: what this machine lacks, and how to fix it."""

from __future__ import annotations

import platform
import sys
from dataclasses import asdict
from typing import Annotated, Any

import typer

from amrepair.doctor import CheckFinding, State, examine
from gcode.cli import console
from gcode.cli.options import JsonOption

_STATE_MARKS = {State.OK: "ok  ", State.NOTE: "note", State.BAD: "BAD "}
_STATE_COLOURS = {State.OK: "green", State.NOTE: "yellow", State.BAD: "bold red"}
BAD_EXIT = 2


@console.command(
    "doctor", "amrepair doctor", "amrepair doctor --json > doctor.json", "amrepair doctor --options"
)
def doctor(
    options: Annotated[
        bool,
        typer.Option(
            "--options", help="Tell every number that can be set, with its unit and its reason."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check Python, libraries, torch, open3d, profiles, ports, disk and cache; say how to fix.

    Exit 0 where every command can work, 2 where one cannot.
    """
    if options:
        _tell_options(as_json=as_json)
        return
    with console.errors.status("doctor") as status:
        findings = examine(lambda name: status.update(f"doctor: {name}"))
    healthy = all(finding.state is not State.BAD for finding in findings)
    if as_json:
        console.show_json(_result(findings, healthy))
    else:
        for finding in findings:
            _say(finding)
    if not healthy:
        raise typer.Exit(BAD_EXIT)


def _tell_options(*, as_json: bool) -> None:
    from amrepair.doctor.options import tunables

    with console.errors.status("doctor: options"):
        found = tunables()
    if as_json:
        console.show_json({"options": [asdict(one) for one in found]})
        return
    said = ""
    for one in found:
        if one.options != said:
            said = one.options
            console.out.print(f"\n{said}", style="bold")
        value = f"{one.value}{' ' + one.unit if one.unit not in ('', 'ratio') else ''}"
        console.out.print(f"  {one.name:<24}{value:<16}{one.reason}")


def _say(finding: CheckFinding) -> None:
    colour = _STATE_COLOURS[finding.state]
    console.out.print(_STATE_MARKS[finding.state], style=colour, end=" ")
    console.out.print(f"{finding.name:<17}{finding.found}")
    if finding.mend:
        console.out.print(f"{'':22}→ {finding.mend}")


def _result(findings: tuple[CheckFinding, ...], healthy: bool) -> dict[str, Any]:
    import amrepair

    return {
        "ok": healthy,
        "checks": [
            {
                "name": finding.name,
                "state": str(finding.state),
                "found": finding.found,
                "mend": finding.mend or None,
            }
            for finding in findings
        ],
        "versions": {
            "amrepair": amrepair.__version__,
            "python": platform.python_version(),
            "executable": sys.executable,
        },
    }
