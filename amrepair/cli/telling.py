"""What became of a run: its result and report, what is said of it, and its exit code."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import typer

from amrepair.errors import LoopError
from amrepair.loop import LoopReport, Tape
from amrepair.loop.learning import told
from amrepair.loop.probing import Felt
from amrepair.loop.run_folder import Recorded
from amrepair.repair import Stopwatch
from amrepair.report import TemperatureSeries, report_of_loop, summary_of_result, write_report
from amrepair.report.collect import loop_result, rounded
from amrepair.report.folder import RunFolder
from gcode.check import CheckedProgram
from gcode.cli import console
from gcode.cli.judging import warnings_json


@dataclass(frozen=True, slots=True)
class Begun(Recorded):
    """All that a run needs, new or gone on with."""

    folder: RunFolder
    checked: CheckedProgram
    tape: Tape
    felt: list[Felt] = field(default_factory=list)  # what each look by touches cost


def written(
    begun: Begun,
    report: LoopReport,
    warmth: tuple[TemperatureSeries, ...],
    watch: Stopwatch,
    bars: console.Bars,
) -> dict[str, Any]:
    """Result and report, in the run's folder; the result."""
    folder, setting, setup = begun.folder, begun.setting, begun.setup
    seconds = watch.rounded_s()
    result = loop_result(
        report, repaired_ratio=None, gcode=last_repair(report, folder),
        seed=setting.seed, seconds=seconds, setup=setup,
    )  # fmt: skip
    result |= warnings_json(begun.checked.report)
    if begun.felt:
        result["touches"] = [rounded(asdict(felt)) for felt in begun.felt]
    folder.write_json("result.json", result)
    with bars.shown(), bars.stage("report"):
        data = report_of_loop(
            report,
            result,
            title=f"Run: {setting.title}",
            setup=setup,
            about={"job": setting.title},
            expected=setting.placed.solid(begun.template.solid()),
            temperatures=warmth,
        )
        write_report(data, folder.file("report.html"))
    return result


def to_resume(folder: Path) -> str:
    """The command that goes on with a run."""
    return f"amrepair loop --resume {shlex.quote(str(folder))}"


def tell(begun: Begun, report: LoopReport, result: dict[str, Any], *, as_json: bool) -> None:
    """What became of it, and the exit code."""
    folder, within = begun.folder, report.within_tolerance
    if as_json:
        console.show_json(result)
    else:
        for line in summary_of_result(result, within_tolerance=within):
            console.out.print(line)
        for look in report.looks:
            for way in look.decision.ways:
                console.out.print(f"{look.stop.label}, what can be done: {way.told}.")
        for felt in begun.felt:
            console.out.print(f"{felt.stop}: {felt.told()}.")
        if report.calibration is not None:
            console.out.print(told(report.calibration))
        console.out.print(f"Report: {folder.file('report.html')}")
    if report.stopped:
        console.errors.print(
            f"The run was ended ({report.stopped}): parked. When somebody has looked: "
            f"{to_resume(folder.path)} --approve ask"
        )
    if code := exit_code_of(report):
        raise typer.Exit(code)


def last_repair(report: LoopReport, folder: RunFolder) -> str | None:
    """The file of the last repair that was printed."""
    printed = [look.number for look in report.looks if look.printed]
    return str(folder.file(f"repair-{printed[-1]}.gcode")) if printed else None


def exit_code_of(report: LoopReport) -> int:
    """Of a run: 4 where it was ended, 3 where what was printed is not within tolerance."""
    if report.stopped:
        return LoopError.exit_code
    return 0 if report.within_tolerance else console.NOT_WITHIN_TOLERANCE
