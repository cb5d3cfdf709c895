"""One run, step by step: the job, the stops, the looks, the wire.

`run` has the loop over the stops; here is what happens at each. Everything is on the tape before
it is done, and what the tape has is not done again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import manifold3d
import numpy as np

from amrepair.errors import AlignmentError, LoopError, ScannerError
from amrepair.frames import Transform
from amrepair.loop import travel
from amrepair.loop.findings import early_action
from amrepair.loop.kinds import typed
from amrepair.loop.learning import Learning, by_bed, to_json, told
from amrepair.loop.looks import Look, LoopReport, Stop, as_recorded, look_to_json
from amrepair.loop.memory import settled
from amrepair.loop.next_layer import rewritten_layer
from amrepair.loop.objects import Course, Objects, is_laid
from amrepair.loop.options import Approval, LoopOptions, Records
from amrepair.loop.safe_exit import cool, leave_safe
from amrepair.loop.sites import Expected
from amrepair.loop.situation import decide_look
from amrepair.loop.tape import ANEW, LOOK_EVENTS, TapeEndsError
from amrepair.loop.thin_layers import with_covered
from amrepair.loop.wire import Mover, Wire
from amrepair.policy import Action, Decision
from amrepair.repair import RepairPlan, Site, plan_repair
from amrepair.scans import PROBE, Scan, Scanner, ScanRequest
from gcode.check import CheckedProgram
from gcode.errors import GcodeError
from gcode.hosts.port import GoesOnAnew, LeavesOut, MakesSafe, Printer, PrintReport
from gcode.moves import ModalState
from gcode.progress import Progress
from gcode.reader import Job
from gcode.resumption.head import state_at_rest
from gcode.resumption.rest import rest_without
from gcode.resumption.standing import with_solid

ENDED_BY_NO = (Action.PAUSE, Action.GIVE_UP, Action.OFFER)


class Run:
    """One run: what was sent, seen and decided so far."""

    def __init__(
        self,
        job: Job,
        checked: CheckedProgram,
        printer: Printer,
        scanner: Scanner,
        site_at: Callable[[Stop], Site],
        *,
        stops: Sequence[Stop],
        options: LoopOptions,
        approval: Approval,
        records: Records,
        progress: Progress,
    ) -> None:
        self._job, self._checked, self._printer, self._scanner = job, checked, printer, scanner
        self._base = 0  # of the job's lines, the one that the program under way begins with
        self._objects, self._course, self._stops = Objects.of(job), Course(job), tuple(stops)
        self._turns = job.turns
        self._site_at, self._options, self._approval = site_at, options, approval
        self._keep_scan, self._record = records.scan, records.look
        self._tape, self._watch = records.tape, records.watch
        self._wire = Wire(printer, records.tape, records.pick_up)
        self._moves = isinstance(scanner, Mover) and not records.tape.only_read
        if isinstance(scanner, Mover):
            scanner.send_by(self._wire)
        self._progress = progress
        self._learning = Learning(options.calibration)
        self._next_line = 0
        self._looks: list[Look] = []
        self._unsettled: list[Callable[[], Look]] = []  # the last ones, as they are to be kept
        self._job_prints: list[PrintReport] = []
        self._repair_prints: list[PrintReport] = []
        self._stopped = ""
        self._silent = 0
        self._coming: tuple[Stop, Future[Site]] | None = None
        self._passed: list[Stop] = []

    def report(self) -> LoopReport:
        """What became of it so far."""
        return LoopReport(
            tuple(self._looks),
            tuple(self._job_prints),
            tuple(self._repair_prints),
            self._stopped,
            tuple(self._passed),
            self._learning.calibration,
            self._objects.given_up,
        )

    # ------------------------------------------------------------------ the job

    def print_job(self, end: int, coming: Stop | None = None) -> None:
        """Print the job's lines up to `end`, as the run was begun, and wait until the nozzle rests.

        What is to be expected at the `coming` stop is made meanwhile.
        """
        first, lines = self._next_line, self._base + self._checked.program.line_count
        end = self._course.line(end)
        if first >= end:
            return

        with self._watch("print"), ThreadPoolExecutor(1) as beside:
            now = None if coming is None else self._course.stop(coming)
            if coming is not None and now is not None and not self._tape.only_read:
                self._coming = coming, beside.submit(self._site_at, now)
            settling = beside.submit(self.settle)
            told = self._telling("print", first, end, lines)
            kind, base = ("rest" if self._base else "job"), self._base
            try:
                report = self._wire.send(kind, self._checked, first - base, end - base, told)
            except BaseException:
                if isinstance(self._printer, MakesSafe):  # a server has seen to it
                    leave_safe(self._printer)  # before anybody waits for what is made beside it
                raise
        settling.result()
        if report is not None:
            self._job_prints.append(report)
            if not report.ok:
                raise LoopError(
                    f"the job was stopped at line {base + report.next_line + 1} of {lines}; "
                    "heaters are off"
                )
        self._next_line = end

    def _telling(self, what: str, first: int, end: int, lines: int) -> Progress:
        """The link tells of lines [first, end), a server in bytes; people ask for the lines."""

        def told(stage: str, done: float, total: float) -> None:
            share = done / total if total else 1.0
            self._progress(what, first + share * (end - first), float(lines))

        return told

    def end(self) -> None:
        """The last word on the tape."""
        if not self._tape.only_read and not (self._tape.peek() and self._tape.next("end")):
            if self._stopped:
                self._wire.go_live()
                cool(self._printer)
            self._tape.write("end", stopped=self._stopped)

    # ------------------------------------------------------------------ a stop

    def at(self, stop: Stop) -> bool:
        """Look, decide, repair, until there is nothing more to do; whether the job goes on."""
        if self._tape.only_read:
            return self._again(stop)
        now = self._course.stop(stop)
        if now is None or not is_laid(self._job, now):
            return True  # nothing is printed there any more
        pulled_mm, began = self._wire.pulled_at_rest_mm(), self._checked
        state = state_at_rest(self._job, now.line, paused_mm=pulled_mm)
        site = self._expected(stop, now)
        with self._watch("print"):
            program, parked = travel.park(site.setup, state, site.others)
            self._wire.send("park", program)
        while True:
            look = self._try_to_look(stop, site, parked)
            if look is None:
                if self._stopped:
                    return False
                break
            action = look.decision.action
            if look.printed and look.plan.checked is not None:
                with self._watch("repair"):
                    lines = look.plan.checked.program.line_count
                    told = self._telling("repair", 0, lines, lines)
                    report = self._wire.send("repair", look.plan.checked, progress=told)
                    if report is not None:
                        self._repair_prints.append(report)
            elif action is Action.STOP or (look.declined and action in ENDED_BY_NO):
                self._stopped = _why(look.decision)
                return False
            elif action is Action.GIVE_UP:
                if not self._give_up(now, site, look, parked):
                    return False
                site = self._site_at(self._course.stop(stop) or now)
            elif action is not Action.LOOK_AGAIN:
                break
        if self._checked is not began:
            return True  # what is left of the job begins where the nozzle rests
        with self._watch("print"):
            for program in travel.way_back(site.setup, state, parked, site.others):
                self._wire.send("back", program)
            if look is not None:
                self._change_next(stop, site, look)
        return True

    def _give_up(self, now: Stop, site: Site, look: Look, parked: ModalState) -> bool:
        """Print nothing more of the objects that a decision names; whether that can be done."""
        names = [v.finding.object for v in look.decision.verdicts if v.action is Action.GIVE_UP]
        names = sorted(set(names))
        objects = self._objects.giving_up(names)
        if not objects.left:
            self._stopped = f"stop: no object is left: {', '.join(names)} cannot be repaired"
            return False
        try:
            if isinstance(self._printer, LeavesOut):
                if self._tape.next("given_up") is None:
                    self._wire.go_live()
                    for name in names:
                        self._printer.leave_out(name)
                    self._tape.write("given_up", objects=names)
                self._job = objects.expected(now.line, names)
            else:
                self._write_anew(now, site, look, parked, names)
        except GcodeError as error:
            self._stopped = f"stop: {', '.join(names)} cannot be left out: {error}"
            return False
        self._objects = replace(Objects.of(self._job), given_up=objects.given_up)
        if isinstance(self._site_at, Expected):
            self._site_at = self._site_at.of(self._job)
        self._progress(f"given up: {', '.join(names)}", 1.0, 1.0)
        return True

    def _write_anew(
        self, now: Stop, site: Site, look: Look, parked: ModalState, names: Sequence[str]
    ) -> None:
        """The job from here on without some objects, from where the nozzle rests."""
        machine = site.setup.printer
        ends = [layer.end_line for layer in self._job.layers]
        coming = [s.line for s in map(self._course.stop, self._stops) if s is not None]
        rest = rest_without(
            self._job, names, site.setup, first=now.line, parked=parked,
            pulled_mm=parked.pulled_mm,
            standing=with_solid(
                self._job.beads, now.line, machine, look.plan.deficit.excess
            ),
            stops=sorted({*ends, *coming}),
        )  # fmt: skip
        if isinstance(self._printer, GoesOnAnew):
            self._printer.rewrite(rest.checked, self._course.own_lines(rest) - rest.first_line)
        self._course = self._course.anew(rest)
        self._job, self._checked = rest.job, rest.checked
        self._base = self._next_line = rest.first_line

    def _expected(self, stop: Stop, now: Stop) -> Site:
        """What is expected at a stop, made beforehand or now."""
        coming, self._coming = self._coming, None
        if coming is not None and coming[0] == stop:
            return coming[1].result()
        return self._site_at(now)

    def _again(self, stop: Stop) -> bool:
        """Look at the recorded scans of a stop, however it is decided now."""
        if self._tape.live:
            raise TapeEndsError("the record ends here")
        site = self._site_at(stop)
        _, parked = travel.park(site.setup, self._job.state_after(stop.line), site.others)
        while self._tape.next_stop() == stop.label:
            self._try_to_look(stop, site, parked)
        return True

    def _change_next(self, stop: Stop, site: Site, look: Look) -> None:
        """Print the next layer with its flow changed, where that was decided."""
        now = self._course.stop(stop)
        if not look.decision.changes_next or now is None or now.layer_index is None:
            return
        changed = rewritten_layer(
            self._job, site.setup, now.layer_index + 1, look.plan, look.decision.changes_next
        )
        if changed is None:
            return
        report = self._wire.send("next layer", changed.checked)
        if report is not None:
            self._job_prints.append(report)
        self._next_line = changed.end_line

    def _try_to_look(self, stop: Stop, site: Site, parked: ModalState) -> Look | None:
        """A look; None where the scanner is silent, or (with `_stopped`) nothing fits the part."""
        for attempt in (1, 2):
            found = self._one_try(stop, site, parked, last=attempt == 2)
            if isinstance(found, Look):
                self._silent = 0
                return found
            outcome, why = found
            if outcome == "pass by":
                self._silent += 1
                self._passed.append(stop)
                self._progress(f"no look at {stop.label}", 1.0, 1.0)
                return None
        self._stopped = f"stop: twice the scan did not fit the part: {why}"
        return None

    def _one_try(
        self, stop: Stop, site: Site, parked: ModalState, *, last: bool
    ) -> Look | tuple[str, str]:
        """A look; or, where there is none, what follows and why, which is on the tape then."""
        try:
            scan = self._moved_scan(stop)
            if self._tape.peek() != "no_look":
                return self._look(stop, site, parked, scan)
        except ScannerError as error:
            if self._silent >= self._options.silent_stops:
                raise
            outcome, why = "pass by", str(error)
        except AlignmentError as error:
            outcome, why = ("stop" if last else "again"), str(error)
        else:
            taped = self._tape.next("no_look") or {}
            return str(taped["outcome"]), str(taped["why"])
        self._tape.write("no_look", stop=stop.label, outcome=outcome, why=why)
        return outcome, why

    def _moved_scan(self, stop: Stop) -> Scan | None:
        """What a scanner sees that has the printer move: on the tape its moves precede the look."""
        if not self._moves or self._tape.peek() in LOOK_EVENTS:
            return None
        scan = self._scan(stop)
        return scan if self._tape.next_if(ANEW) is None else self._scan(stop)

    def _scan(self, stop: Stop) -> Scan:
        """What the scanner sees, as a file keeps it."""
        with self._watch("scan"):
            self._progress(f"scan {stop.label}", 0.0, 1.0)
            layers = None if stop.number is None else self._turns[stop.number - 1].end_layer
            request = ScanRequest(stop.label, stop.layer_index, stop.z_mm, layers)
            scan = as_recorded(self._scanner.scan(request))
            self._progress(f"scan {stop.label}", 1.0, 1.0)
        return scan

    def _look(self, stop: Stop, site: Site, parked: ModalState, scan: Scan | None) -> Look:
        """Scan, plan, decide; what is to be printed is on the tape when this returns."""
        number, here = len(self._looks) + 1, [k for k in self._looks if k.stop == stop]
        site = replace(self._learning.judged_by(site), policy=self._options.policy)
        taped = self._tape.next("look")
        if taped is not None:
            with self._watch("scan"):
                scan = self._tape.scan(number, str(taped["frame"]))
        else:
            self._wire.go_live(self._progress)
            scan = scan or self._scan(stop)
        with ThreadPoolExecutor(1) as beside:  # the disk need not wait for the plan, nor it for it
            kept = beside.submit(self._keep_scan, number, scan) if taped is None else None
            now = self._course.stop(stop) or stop
            plan, decision = self._plan(number, now, site, parked, scan, here)
        if kept is not None:
            kept.result()
        look = self._outcome(Look(number, stop, scan, plan, decision, printed=False), taped)
        if taped is None:
            self._record(look)
            self._tape.write("look", **look_to_json(look))
        self._learn(look)
        last = stop.layer_index is None
        self._looks.append(look)
        self._unsettled.append(partial(settled, look, site, compared=bool(here) or last))
        return look

    def _learn(self, look: Look) -> None:
        """What the first clean layers tell of the scanner; said and on the tape, once."""
        if look.scan.frame == PROBE:  # it measures its noise itself
            return
        bed, before = by_bed(look.plan), (by_bed(k.plan) for k in self._looks)
        if bed is not None and not any(before) and not self._tape.only_read:
            self._progress(f"{look.stop.label}: {bed.told()}", 1.0, 1.0)
        learned = self._learning.note(look.stop, look.plan, look.decision)
        if learned is None or self._tape.only_read:
            return
        self._progress(f"learned: {told(learned)}", 1.0, 1.0)
        if self._tape.peek() == "learned":
            self._tape.next("learned")
        elif self._tape.live:
            self._tape.write("learned", calibration=to_json(learned))

    def settle(self) -> None:
        """Keep of the last looks what a report shows; while the job prints nothing waits for it."""
        if self._unsettled:
            self._looks[-len(self._unsettled) :] = [keep() for keep in self._unsettled]
            self._unsettled.clear()

    def _plan(
        self,
        number: int,
        stop: Stop,
        site: Site,
        parked: ModalState,
        scan: Scan,
        here: Sequence[Look],
    ) -> tuple[RepairPlan, Decision]:
        """What a scan asks for, and what is decided of it; `here` are the stop's earlier looks."""
        passes = sum(look.printed for look in here)
        again = bool(here) and not here[-1].printed
        plan = plan_repair(
            scan,
            site,
            title=f"repair of {stop.label}, pass {passes + 1}",
            guess=_guess(site, self._scanner),
            interruption=parked,
            strict=False,
            wanted=lambda region: (
                self._objects.owner(np.asarray(region.box_mm)) not in self._objects.given_up
                and early_action(
                    region, self._job, site.setup, stop.layer_index, self._options.policy
                )
                is not Action.FILL_WITH_NEXT
            ),
            rng=np.random.default_rng([self._options.seed, number]),
            watch=self._watch,
            progress=self._progress,
        )
        with self._watch("decide"):
            plan = typed(
                plan,
                self._job,
                site,
                stop.line,
                self._scanner.build_from_scanner,
                repaired=passes > 0,
                mended=self._filled_before(stop),
                options=self._options.kinds,
            )
            plan = with_covered(
                plan, self._job, site.expected, stop, self._looks, self._options.kinds.thin
            )
            decision = decide_look(
                plan,
                self._job,
                site,
                stop,
                here,
                seen_twice=again,
                limits=self._options.limits,
                policy=self._options.policy,
                objects=self._objects,
            )
        return plan, decision

    def _filled_before(self, stop: Stop) -> manifold3d.Manifold | None:
        """What was missing where something was last filled, but for this stop; build frame."""
        filled = [look for look in self._looks if look.printed and look.stop != stop]
        if not filled:
            return None
        first = next(look for look in filled if look.stop == filled[-1].stop)
        return first.plan.deficit.missing

    def _outcome(self, look: Look, taped: dict[str, object] | None) -> Look:
        """Ask whoever is to be asked; a taped look was answered then."""
        if taped is not None:
            return replace(look, printed=bool(taped["printed"]), declined=bool(taped["declined"]))
        action = look.decision.action
        if action is Action.FILL_NOW:
            granted = self._approval.approve(look.plan)
            return replace(look, printed=granted, declined=not granted)
        if action in (Action.GIVE_UP, Action.OFFER) and self._approval.ask is not None:
            return replace(look, declined=not self._approval.ask(look.decision))
        if action is Action.PAUSE:
            if self._approval.ask is None or not self._approval.ask(look.decision):
                return replace(look, declined=True)
            fills = [v for v in look.decision.verdicts if v.action is Action.FILL_NOW]
            situation = look.decision.situation
            barred = situation.refused or situation.other_material
            if fills and not (barred or situation.last_pass or situation.stuck):
                return replace(look, printed=self._approval.approve(look.plan))
        return look


def _why(decision: Decision) -> str:
    """One line on why a run was ended."""
    own = decision.own
    kinds = ", ".join(sorted({v.finding.named for v in own}))
    beyond = "" if decision.situation.laid_nothing else decision.situation.beyond
    reason = own[0].reason if own else beyond or decision.reason
    reason = "; ".join([reason, *(way.told for way in decision.ways if way.layer is not None)])
    return f"{decision.action}: {kinds + ': ' if kinds else ''}{reason}"


def _guess(site: Site, scanner: Scanner) -> Transform:
    """Pose of the scan in the template, as far as calibration knows it."""
    if site.build_from_template is None:
        raise LoopError("the loop needs to know where the part stands on the bed")
    return site.build_from_template.inverse() @ scanner.build_from_scanner
