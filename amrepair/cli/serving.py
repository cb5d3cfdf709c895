"""What `amrepair agent` does: one print after another, each a run of the loop."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from amrepair.agent.screens import Button, KlipperScreens, OctoPrintTab, Screens
from amrepair.agent.talk import Talk
from amrepair.cli.approval import AtDesk
from amrepair.cli.live import NoView, ShownRun, ViewPlace, live_view
from amrepair.cli.running import (
    Looks,
    gone_on_with,
    new_run,
    print_run,
)
from amrepair.cli.scanners import known_scanner
from amrepair.cli.telling import Begun, exit_code_of, written
from amrepair.errors import AmrepairError, InputError, LoopError
from amrepair.loop.calibrate import read_calibration
from amrepair.loop.looks import LoopReport
from amrepair.loop.tape import read_events
from amrepair.loop.travel import park, way_back
from amrepair.policy import Decision
from amrepair.repair import RepairPlan, Stopwatch
from amrepair.report.text import summary_of_result
from amrepair.scans import PROBE
from gcode.cli import console
from gcode.errors import GcodeError, LinkError
from gcode.hosts.moonraker_job import KlipperJob
from gcode.hosts.octoprint_job import OctoPrintJob
from gcode.hosts.port import PullsAtRest, TellsTouches
from gcode.hosts.secret import ApiKey
from gcode.hosts.served_job import ServedJob, UnderWay
from gcode.hosts.web import Address, heaters_word
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, load_setup
from gcode.resumption.head import state_at_rest
from gcode.solids import SOLID_SUFFIXES
from gcode.whole import write_bytes

LOOK_S = 1.0  # between looks at whether something is printed
PARTS = frozenset({".safetensors", *SOLID_SUFFIXES})


@dataclass(frozen=True, slots=True)
class Served:
    """What an agent is begun with; `said` is what a run's setting takes as it is."""

    address: Address
    key: ApiKey
    template: Path
    out: Path
    named: tuple[str | None, str | None, str]
    calibration: Path | None
    page: ViewPlace
    once: bool
    pose_confirmed: bool
    said: dict[str, Any]


def serve(told: Served) -> int:
    """Serve a printer's prints until interrupted; the exit code of the last, where it is the last.

    Raises
    ------
    LinkError, PortBusyError
        If the server cannot be reached at the beginning, or has an agent already.
    """
    if not told.template.exists():
        raise InputError(f"--template {told.template}: there is no such file or folder")
    _refuse_early(told)
    machine, screens = _machine(told.address, told.key)
    touches = told.said["scanner"] == PROBE
    machine.connect()
    talk = Talk(machine, screens, console.errors.print)
    try:
        machine.require_partner()
        if touches and isinstance(machine, TellsTouches):
            machine.require_touches()
        talk.listen()
        talk.say("the agent is here.")
        return _Service(told, machine, talk).run()
    except KeyboardInterrupt:
        console.errors.print(
            "A print that rests at a look stays so, heaters off; one that goes on goes on. "
            f"Started again with --out {shlex.quote(str(told.out))}, the agent goes on with it."
        )
        raise
    finally:
        talk.close()
        machine.close()


def _refuse_early(told: Served) -> None:
    """What no print could be served with, before one has begun."""
    known_scanner(told.said["scanner"])
    read_calibration(told.calibration)
    printer, material, process = told.named
    setup = load_setup(printer or DEFAULT_PRINTER, material or DEFAULT_MATERIAL, process)
    if printer is not None:
        _ = setup.printer.head
        if told.said["scanner"] == PROBE:
            _ = setup.printer.feeler
    suffix = told.template.suffix.lower()
    if told.template.is_file() and suffix not in PARTS:
        raise InputError(
            f"--template {told.template}: a part ends in one of {', '.join(sorted(PARTS))}"
        )


def _machine(address: Address, key: ApiKey) -> tuple[ServedJob[Any], Screens]:
    """The printer of a server, not connected, and its screens."""
    if address.kind == "moonraker":
        klipper = KlipperJob(address, key)
        return klipper, KlipperScreens(klipper.command)
    octoprint = OctoPrintJob(address, key)
    return octoprint, OctoPrintTab(octoprint.show)


@dataclass(frozen=True, slots=True)
class _Asked:
    """Questions go to the printer's screens; the live page shows what they are about."""

    page: NoView | ShownRun
    desk: AtDesk

    def to_print(self, plan: RepairPlan) -> bool:
        self.page.shows(plan)
        return self.desk.to_print(plan)

    def to_go_on(self, decision: Decision) -> bool:
        return self.desk.to_go_on(decision)


class _Service:
    """The prints of one printer."""

    def __init__(self, told: Served, machine: ServedJob[Any], talk: Talk) -> None:
        self._told, self._machine, self._talk = told, machine, talk
        self._held: int | None = None
        self._exit_code = 0

    def run(self) -> int:
        """One print after another; as a loop's, the exit code of the last."""
        served: UnderWay | None = None
        away = False
        while True:
            try:
                job = self._machine.under_way()
                if job is not None and job == served:
                    self._pass_by()
            except LinkError as error:
                if not away:
                    console.errors.print(f"{error} Waiting for it.")
                away, job = True, None
            else:
                away = False
            if job is None or job == served:
                if served is not None and job is None and self._told.once and not away:
                    return self._exit_code
                self._machine.wait(LOOK_S)
                continue
            served = job
            self._print(job)
            self._talk.rest()

    def _pass_by(self) -> None:
        """Let a print that is not looked at (any more) go on at its looks.

        Where looks were ended it rests, heaters off, until somebody has decided.
        """
        rests_at = self._machine.rests_at()
        if rests_at is not None and rests_at != self._held:
            self._talk.end_prompt()
            self._machine.pass_by()

    def _print(self, job: UnderWay) -> None:
        """Serve one print."""
        found, self._held, self._exit_code = None, None, 0
        try:
            found = self._begin(job)
            if found is None:
                self._held = self._machine.rests_at()
                self._exit_code = LoopError.exit_code
                return
            self._run(*found)
        except (AmrepairError, GcodeError) as error:
            self._exit_code = error.exit_code
            if found is None:
                self._talk.say(f"{job.name} is printed without looks: {error}", wrong=True)
            else:
                self._ended(f"{error}", found[0])
        finally:
            if found is not None:
                found[0].tape.close()

    def _begin(self, job: UnderWay) -> tuple[Begun, bool, Stopwatch] | None:
        """A new run, or the one that was begun; None where that was ended."""
        told, watch = self._told, Stopwatch()
        folder = told.out / f"{Path(job.name).stem}-{job.id}"
        data = self._machine.fetch(job.name)
        come_to = self._machine.follow(job.name, data)
        events = read_events(folder)
        if events and events[-1].get("event") == "end":
            return None
        if events:
            begun = gone_on_with(
                folder, None, told.said["scanner"], told.said["approve"], AtDesk(self._talk)
            )
        else:
            kept = folder / Path(job.name).name
            write_bytes(kept, data)
            begun = new_run(
                kept, self._part_of(job.name), folder, told.named, Looks(marked=come_to),
                told.calibration, watch, AtDesk(self._talk), port=self._told.address.spec,
                leave_heaters=True, **told.said,
            )  # fmt: skip
        try:
            self._machine.serve(begun.checked)
            if not events:
                self._machine.forget_steps()
            count = len(begun.stops)
            looks = f"{count} look{'s' if count > 1 else ''}"
            self._talk.say(f"{job.name} is {'gone on with' if events else 'followed'}: {looks}.")
        except BaseException:
            begun.tape.close()  # whoever goes on with it, this process too, is alone at it
            raise
        return begun, bool(events), watch

    def _part_of(self, name: str) -> Path:
        """The template of a job: the one that was named, or the one whose name it begins with."""
        where = self._told.template
        if where.is_file():
            return where
        stem = Path(name).stem
        parts = [
            p for p in where.iterdir() if p.suffix.lower() in PARTS and stem.startswith(p.stem)
        ]
        if not parts:
            raise InputError(f"no part in {where} has a name that {stem!r} begins with")
        return max(parts, key=lambda path: len(path.stem))

    def _run(self, begun: Begun, going_on: bool, watch: Stopwatch) -> None:
        """The loop over one print, and what came of it."""
        page, bars = self._told.page, AtDesk(self._talk)
        with (
            live_view(page, ask=False, title=begun.setting.title) as shown,
            self._machine.showing(shown.address, page.token),
        ):
            report, warmth = print_run(
                begun, self._machine, shown, watch, bars, word=_Asked(shown, bars),
                going_on=going_on, pose=self._told.pose_confirmed,
            )  # fmt: skip
        result = written(begun, report, warmth, watch, bars)
        self._talk.end_prompt()
        self._exit_code = exit_code_of(report)
        if report.stopped:
            self._ended(report.stopped, begun)
        else:
            self._say_how(report, result)

    def _say_how(self, report: LoopReport, result: dict[str, Any]) -> None:
        within = report.within_tolerance
        lines = summary_of_result(result, within_tolerance=within)
        self._talk.say(" ".join(lines), wrong=not within)

    def _ended(self, why: str, begun: Begun) -> None:
        """A run that is over before its print: told where somebody can decide."""
        self._talk.say(f"no more looks at this print: {why}", wrong=True)
        try:
            self._held = self._machine.rests_at()
            if self._held is None:
                return
            on = self._machine
            paused_mm = on.pulled_at_rest_mm() if isinstance(on, PullsAtRest) else 0.0
            state = state_at_rest(begun.job, self._held, paused_mm=paused_mm)
            _, parked = park(begun.setup, state)
            self._machine.leave(way_back(begun.setup, state, parked))
        except LinkError:
            return
        self._talk.prompt(
            [
                f"No more looks at this print: {why}",
                f"It rests. {heaters_word(self._machine.temperatures)}",
            ],
            [
                Button("Heat and go on", {"what": "go on"}, "warning"),
                Button("Cancel the print", {"what": "cancel"}, "error"),
            ],
        )
