"""A run looked at again: the same decisions from the recorded scans, or where they differ.

Nothing is sent and nobody is asked: what was answered then is taken from the record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from amrepair.errors import InputError, LoopError
from amrepair.frames import Transform
from amrepair.loop.looks import Look, Stop, plan_stops
from amrepair.loop.options import Records
from amrepair.loop.run import run_loop
from amrepair.loop.run_folder import Recorded, open_run
from amrepair.loop.sites import sites
from amrepair.loop.tape import Tape, read_events
from amrepair.policy.replay import changed, decided_again
from amrepair.scans import Scan, ScanRequest
from gcode.hosts.file import FilePrinter
from gcode.progress import Progress, silent

SAME_RATIO, SAME_MM3 = 0.01, 0.05
"""Volumes that differ by less than a percent, or by less than a bead, are the same."""


@dataclass(frozen=True, slots=True)
class Replayed:
    """One look, then and now.

    Attributes
    ----------
    differences
        Whole sentences; none where the decision is the same, for the same reasons.
    """

    look: int
    stop: str
    then: dict[str, Any]
    differences: tuple[str, ...]


class _TapeScanner:
    """The pose of the run's scanner; its scans come from the tape."""

    def __init__(self, pose: Transform) -> None:
        self.build_from_scanner = pose

    def scan(self, request: ScanRequest) -> Scan:
        raise LoopError(f"the record has no scan for {request.label}")


def replay(folder: Path, *, progress: Progress = silent) -> tuple[Replayed, ...]:
    """Look at every recorded scan again.

    Raises
    ------
    InputError
        If the folder holds no recorded run, or a profile has changed.
    """
    run = open_run(folder)
    then = _recorded_looks(folder)
    now = looks_of(run, Tape(folder, only_read=True), progress=progress)
    return tuple(compare(event, look) for event, look in zip(then, now, strict=True))


def decide_again(folder: Path, rules: Sequence[str] = ()) -> tuple[Replayed, ...]:
    """Every recorded look decided again from its own facts, with some rules changed.

    Parameters
    ----------
    rules
        `name=value` of numbers of `PolicyOptions`; the others are those that the run went by.

    Raises
    ------
    InputError
        If the folder holds no recorded run, or there is no such rule.
    """
    policy = changed(open_run(folder).setting.policy, rules)
    again = []
    for event in _recorded_looks(folder):
        now = decided_again(event["decision"], policy).to_json()
        said = _differences(event["decision"], now)
        again.append(Replayed(event["look"], event["stop"], event["decision"], said))
    return tuple(again)


def _recorded_looks(folder: Path) -> list[dict[str, Any]]:
    found = [event for event in read_events(folder) if event.get("event") == "look"]
    if not found:
        raise InputError(f"{folder} has no recorded look; the run was ended before its first scan")
    return found


def looks_of(run: Recorded, tape: Tape, *, progress: Progress = silent) -> tuple[Look, ...]:
    """The looks of a tape, planned and decided anew."""
    setting = run.setting
    report = run_loop(
        run.job,
        run.judged(),
        FilePrinter(Path("/dev/null")),
        _TapeScanner(setting.scanner_pose),
        sites(run.job, run.template, setting.placed, run.setup, by_beads=setting.by_beads),
        stops=_looked_at(run, tape),
        options=replace(setting.options(run.setup.process), pace=None),
        records=Records(tape=tape),
        progress=progress,
    )
    return report.looks


def _looked_at(run: Recorded, tape: Tape) -> tuple[Stop, ...]:
    """The stops of a run: those that were planned, and those that its looks led to."""
    if not run.setting.adaptive:
        return run.stops
    layers = {stop.label: stop for stop in plan_stops(run.job, range(len(run.job.layers)))}
    labels = dict.fromkeys(label for label in tape.labels() if label in layers)
    return tuple(layers[label] for label in labels)


def compare(then: dict[str, Any], look: Look) -> Replayed:
    """One look as it was recorded, and as it is decided now."""
    was, now = then["decision"], look.decision.to_json()
    said = list(_differences(was, now))
    for key, value in (
        ("missing", (then["missing_mm3"], look.plan.deficit.missing_mm3)),
        ("excess", (then["excess_mm3"], look.plan.deficit.excess_mm3)),
    ):
        if abs(value[0] - value[1]) > max(SAME_MM3, SAME_RATIO * abs(value[0])):
            said.append(f"{value[0]:.2f} mm³ {key} then, {value[1]:.2f} mm³ now")
    return Replayed(look.number, look.stop.label, was, tuple(said))


def _differences(was: dict[str, Any], now: dict[str, Any]) -> tuple[str, ...]:
    """What is decided differently, in whole sentences."""
    said = []
    if (was["action"], was["row"]) != (now["action"], now["row"]):
        said.append(
            f"decided '{was['action']}' by {was['row']} then, '{now['action']}' by {now['row']} now"
        )
    rows = [[(f["kind"], f["type"], f["action"], f["row"]) for f in d["findings"]]
            for d in (was, now)]  # fmt: skip
    if rows[0] != rows[1]:
        said.append(f"findings were {_words(rows[0])}, and are {_words(rows[1])}")
    return tuple(said)


def _words(rows: list[tuple[str, str, str, str]]) -> str:
    return "; ".join(f"{kind} {type_} → {action} ({row})" for kind, type_, action, row in rows) or (
        "none"
    )
