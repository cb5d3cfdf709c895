"""What `amrepair loop` does once its words are read: begin or go on, print, tell."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from amrepair.cli.approval import AtDesk, Terminal
from amrepair.cli.live import NoView, ShownRun, ViewPlace, live_view
from amrepair.cli.scanners import Bed, known_scanner, open_scanner
from amrepair.cli.telling import Begun, tell, to_resume, written
from amrepair.cli.thermal_log import ThermalLog
from amrepair.errors import InputError, ScannerError
from amrepair.fleet.desk import Desk
from amrepair.fleet.shared import SharedDetection
from amrepair.library import template_files
from amrepair.loop import (
    Approval,
    Decision,
    Look,
    LoopReport,
    Records,
    Tape,
    plan_stops,
    run_loop,
)
from amrepair.loop.calibrate import read_calibration
from amrepair.loop.locate import Located, is_upright, locate_plate, stood_plate
from amrepair.loop.marked_stops import marked_stops
from amrepair.loop.options import UNASKED
from amrepair.loop.pace import layers_at, layers_every
from amrepair.loop.pick_up import pick_up
from amrepair.loop.probing import ProbeScanner
from amrepair.loop.run_folder import Setting, forget, keep, open_run
from amrepair.loop.sequential_objects import refuse_own_hits
from amrepair.loop.sites import sites
from amrepair.loop.tape import read_events
from amrepair.regions import detect
from amrepair.repair import Detector, RepairPlan, Stopwatch
from amrepair.report import TemperatureSeries
from amrepair.report.folder import RunFolder
from amrepair.scans import PROBE
from amrepair.template import open_template
from gcode.check import check, policy_of
from gcode.cli import console
from gcode.cli.judging import tell_waits, tell_warnings
from gcode.cli.options import program_text
from gcode.cli.owning import job_setup, told_if_for_another
from gcode.errors import JournalError, LinkError, PortBusyError
from gcode.hosts import connect
from gcode.hosts.journal import Journal, default_path
from gcode.hosts.port import Printer, ResumeRefusedError
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER
from gcode.reader import job_for
from gcode.resumption.settings import require_one_frame

ADAPTIVE_LAYERS = 8  # to the first look, where --every says nothing
PROFILES = "profiles"  # in the run's folder: those of the job's own settings
SILENT_STOPS = 2  # a scanner that says nothing at three stops in a row is gone
WATCH = "watch:"


@dataclass(frozen=True, slots=True)
class Looks:
    """When to look, besides at the end: every so many layers, or adaptively; and where besides.

    `marked`: where the job is marked, from this line on, and nowhere else; None: not by marks.
    """

    every: int = 0
    adaptive: bool = False
    at_layers: tuple[int, ...] = ()
    at_mm: tuple[float, ...] = ()
    marked: int | None = None


def run(
    job_file: Path | None,
    template: Path | None,
    out: Path,
    named: tuple[str | None, str | None, str],
    looks: Looks,
    calibration: Path | None,
    shown: ViewPlace,
    *,
    resume: Path | None,
    pose_confirmed: bool,
    port: str | None,
    scanner: str | None,
    approve: str | None,
    as_json: bool,
    **said: Any,
) -> None:
    """Run the loop from its beginning, or go on with a run.

    `said` is the scan's time limit, the calibration of its errors and the seed.
    """
    watch = Stopwatch()
    desk = None if shown.desk is None else Desk(shown.desk)
    bars = console.Bars() if desk is None else AtDesk(desk)
    if resume is not None:
        if job_file is not None:
            raise InputError("--resume takes the job from the run's folder; leave JOB out")
        begun = gone_on_with(resume, port, scanner, approve, bars)
    else:
        begun = new_run(
            _given(job_file, "JOB"),
            _given(template, "--template"),
            out,
            named,
            looks,
            calibration,
            watch,
            bars,
            port=_given(port, "--port"),
            scanner=_given(scanner, "--scanner"),
            approve=approve or "ask",
            **said,
        )
    ask = begun.setting.approve == "ask"
    if begun.setting.scanner.startswith(WATCH):
        console.errors.print(
            f"At each look a scan is awaited in {begun.setting.scanner.removeprefix(WATCH)}, for "
            f"{begun.setting.scan_timeout_s:g} s."
        )
    with live_view(shown, ask=ask, title=begun.setting.title) as page:
        report, warmth = _printed(
            begun,
            page,
            watch,
            bars,
            view=shown.view,
            going_on=resume is not None,
            pose=pose_confirmed,
            desk=desk,
        )
    result = written(begun, report, warmth, watch, bars)
    tell(begun, report, result, as_json=as_json)


def _printed(
    begun: Begun,
    page: NoView | ShownRun,
    watch: Stopwatch,
    bars: console.Bars,
    *,
    view: bool,
    going_on: bool,
    pose: bool,
    desk: Desk | None,
) -> tuple[LoopReport, tuple[TemperatureSeries, ...]]:
    """Run the loop over the printer that was named; whoever looks is asked there."""
    word = page if view else bars if isinstance(bars, AtDesk) else Terminal(bars)
    machine = _machine(begun)
    try:
        with console.interrupts_as_such():
            return print_run(
                begun,
                machine,
                page,
                watch,
                bars,
                word=word,
                going_on=going_on,
                pose=pose,
                detector=detect if desk is None else SharedDetection(desk.folder, desk.judged),
            )
    except KeyboardInterrupt:
        console.errors.print(
            f"When somebody has looked, go on with: {to_resume(begun.folder.path)}"
        )
        raise
    except (ScannerError, LinkError) as error:
        begun_to_print = read_events(begun.folder.path)  # else the same command begins it
        if begun_to_print and not isinstance(error, (ResumeRefusedError, PortBusyError)):
            console.errors.print(f"When that is mended, go on with: {to_resume(begun.folder.path)}")
        raise
    finally:
        begun.tape.close()
        machine.close()


def _given(value: Any, name: str) -> Any:
    if value is None:
        raise InputError(f"{name} is missing; give it, or --resume RUN to go on with a run")
    return value


def new_run(
    job_file: Path,
    template: Path,
    out: Path,
    named: tuple[str | None, str | None, str],
    looks: Looks,
    calibration: Path | None,
    watch: Stopwatch,
    bars: console.Bars,
    **said: Any,
) -> Begun:
    """Read, check and write down what a run begins with."""
    text = program_text(job_file)
    setup, own = job_setup(text, job_file, *named)
    _ = setup.printer.head  # refused before any work
    pose, unit = read_calibration(calibration)
    known_scanner(said["scanner"])  # refused before any work
    if said["scanner"] == PROBE:
        _ = setup.printer.feeler
    folder = RunFolder(out)
    before = read_events(out)
    if before and before[-1].get("event") != "end":
        raise InputError(
            f"{out} holds a run that was not ended; go on with it ('{to_resume(out)}') or name "
            "another folder with --out"
        )
    job = job_for(text, setup.printer)
    require_one_frame(job)
    refuse_own_hits(job, setup)
    fixed = layers_every(job, looks.every)
    pace = (looks.every or ADAPTIVE_LAYERS) if looks.adaptive else 0
    layers = [*looks.at_layers, *layers_at(job, looks.at_mm), *([] if pace else fixed)]
    stops = (
        plan_stops(job, layers)
        if looks.marked is None
        else marked_stops(job, job_file.name, start=looks.marked)
    )
    with bars.shown():
        with told_if_for_another(text, job_file, setup.printer):
            checked = check(
                job.program, setup, policy=policy_of(job.program),
                leave_heaters=said["leave_heaters"], progress=bars,
            )  # fmt: skip
        with watch("template"):
            files = template_files(template) if template.is_dir() else [template]
            fields = [open_template(path, progress=bars) for path in files]
        with watch("locate"):
            found = locate_plate(
                job, fields, layer_height_mm=setup.process.layer_height_mm, progress=bars
            )
            expected, build_from_template = stood_plate(fields, found)
    tell_warnings(job_file, checked.report)
    if looks.marked is None:  # else the marks may be such lines
        tell_waits(job_file, text)
    used = sorted({one.which for one in found})
    copies = () if any(expected is field for field in fields) else found
    if copies or len(fields) > 1:
        names = [files[one.which].name for one in found] if len(fields) > 1 else []
        console.errors.print(_how_it_stands(found, names, in_turn=len(job.turns) > 1))
    ids = (
        own.keep(out / PROFILES, *named[1:])
        if own is not None
        else (named[0] or DEFAULT_PRINTER, named[1] or DEFAULT_MATERIAL, named[2])
    )
    setting = Setting.of(
        setup, ids, stops=stops, build_from_template=build_from_template, build_from_scanner=pose,
        copies=[one.pose for one in copies], parts=tuple(used.index(one.which) for one in copies),
        by_beads=True,
        scan_unit=unit, adaptive=pace, marked=looks.marked,
        limited=said["approve"] == "auto", title=job_file.name, **said,
    )  # fmt: skip
    tape = Tape(out)
    tape.hold(anew=True)
    with ExitStack() as where_it_fails:
        where_it_fails.callback(tape.close)
        forget(out)
        keep(out, setting, job.program.text, *(fields[which] for which in used))
        where_it_fails.pop_all()
    return Begun(setting, setup, job, expected, stops, folder, checked, tape)


def _how_it_stands(found: Sequence[Located], names: Sequence[str], *, in_turn: bool) -> str:
    """What a person should know of templates that are not as their files have them."""
    turned = not all(is_upright(one.pose) for one in found)
    lying = ", lying in another way than its file has it" if turned else ""
    if len(set(names)) > 1:
        each = [f"{names.count(name)} of {name}" for name in dict.fromkeys(names)]
        every = f"The job prints {', '.join(each[:-1])} and {each[-1]}{lying}"
    else:
        part = names[0] if names else "the part"
        if len(found) == 1:
            return f"The job prints {part}{lying}; it is looked at so."
        every = f"The job prints {len(found)} copies of {part}{lying}"
    if in_turn:
        return f"{every}, one after the other; each is looked at up to its own end."
    return f"{every}; all of them are looked at."


def gone_on_with(
    folder: Path,
    port: str | None,
    scanner: str | None,
    approve: str | None,
    bars: console.Bars,
) -> Begun:
    """Open a run's folder; what is said now counts more than what was said then."""
    with bars.shown(), bars.stage("check"):
        run = open_run(folder)
        checked = run.judged()
    changes: dict[str, Any] = {"port": port, "scanner": scanner, "approve": approve}
    setting = replace(run.setting, **{k: v for k, v in changes.items() if v is not None})
    if not setting.port:
        raise InputError(f"the run in {folder} was simulated; there is no printer to go on with")
    tape = Tape(folder)
    tape.reopen()
    return Begun(
        setting, run.setup, run.job, run.template, run.stops, RunFolder(folder), checked, tape
    )


@runtime_checkable
class Asked(Protocol):
    """Whoever gives a word on what is found."""

    def to_print(self, plan: RepairPlan) -> bool:
        """Whether a repair is printed."""

    def to_go_on(self, decision: Decision) -> bool:
        """Whether the job goes on all the same."""


def _machine(begun: Begun) -> Printer:
    """The run's printer, not connected."""
    return connect(
        begun.setting.port,
        dialect=begun.setup.printer.dialect,
        baud=begun.setup.printer.baud,
        wire_log=begun.folder.file("wire.log"),
        journal=default_path(begun.setting.port),
    )


def print_run(
    begun: Begun,
    machine: Printer,
    page: NoView | ShownRun,
    watch: Stopwatch,
    bars: console.Bars,
    *,
    word: Asked,
    going_on: bool,
    pose: bool,
    detector: Detector = detect,
) -> tuple[LoopReport, tuple[TemperatureSeries, ...]]:
    """Connect and run the loop; what became of it, and how warm it was at its looks."""
    setting, setup, ask = begun.setting, begun.setup, begun.setting.approve == "ask"
    find = None
    if going_on:
        find = pick_up(machine, release_c=setup.material.bed_release_c, pose_confirmed=pose)
    eye = open_scanner(
        setting.scanner,
        Bed(
            setting.scanner_pose, setting.scan_timeout_s, setup, setting.seed,
            printer=machine, job=begun.job, progress=page.watching(bars),
            scan_unit=setting.scan_unit,
        ),
    )  # fmt: skip
    page.show_run(begun.job, setting.placed.solid(begun.template.solid()))
    if not going_on:
        with bars.shown(), bars.stage("connect"):
            machine.connect()
    page.drives(machine.pause, machine.resume)
    expected = sites(
        begun.job,
        begun.template,
        setting.placed,
        setup,
        by_beads=setting.by_beads,
        detector=detector,
    )
    warmth = ThermalLog(machine.temperatures)
    shown = page.recording(begun.folder.record)

    def recorded(look: Look) -> None:
        shown(look)
        warmth.note()

    try:
        with bars.shown():
            report = run_loop(
                begun.job,
                begun.checked,
                machine,
                eye,
                expected,
                stops=begun.stops,
                options=replace(setting.options(setup.process), silent_stops=SILENT_STOPS),
                approval=Approval(word.to_print, word.to_go_on) if ask else UNASKED,
                records=Records(recorded, begun.folder.keep_scan, begun.tape, find, watch),
                progress=page.watching(bars),
            )
        return report, warmth.series(_noted(setting.port))
    finally:
        begun.tape.close()
        if isinstance(eye, ProbeScanner):
            begun.felt.extend(eye.felt)


def _noted(port: str) -> tuple[tuple[float, float, float | None], ...]:
    """Temperatures that the port's journal has; nothing where there is none, or none to read."""
    path = default_path(port)
    if path is None:
        return ()
    try:
        with closing(Journal(path)) as journal:
            return journal.temperatures()
    except JournalError:
        return ()
