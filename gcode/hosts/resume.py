"""Goes on with a job that a crash, a power loss or a disconnect ended, where that is provable.

The journal says which wire number every program line got; the printer says which number it has
received last. The two together name one line, and that line's successor is sent next: nothing is
executed twice, nothing left out. Firmware without line numbers is asked for its position instead,
which must fit one single line of those in doubt. Whatever does not add up ends in a refusal that
names the interval: the last line known to be executed, the last that can have been sent.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import NoReturn

from gcode.hosts.guarded import PAUSE_LIFT_MM
from gcode.hosts.journal import FOREIGN_LINES, JobRecord, Journal, Step
from gcode.hosts.modes import Modes, before_commands, commands_of, follow, modes_after
from gcode.hosts.port import LinkLostError, PrintableProgram, PrintReport, ResumeRefusedError
from gcode.hosts.serial import SerialPrinter
from gcode.progress import Progress, silent
from gcode.protocol.events import PositionReport

SAME_PLACE_MM = 0.02
"""M114 tells two or three digits."""
SAME_E_MM = 0.006
MOTORS_HELD_S = 100.0
"""Marlin lets go of the motors after 120 s without a move (DEFAULT_STEPPER_DEACTIVE_TIME)."""
_SHIFT = re.compile(r"G0*92\b.*[XY]", re.IGNORECASE)
"""What homing an axis makes undone."""
MOST_IN_DOUBT = 64
"""Lines whose places are compared where there are no line numbers."""


def for_how_long(passed_s: float) -> str:
    """Say how long a printer was at rest; infinite where a clock was set since."""
    return f"for {passed_s:.0f} s" if math.isfinite(passed_s) else "for a time no clock tells"


def resume(
    printer: SerialPrinter,
    checked: PrintableProgram,
    *,
    release_c: float,
    pose_confirmed: bool = False,
    end: int | None = None,
    before: Sequence[tuple[PrintableProgram, int, int]] = (),
    progress: Progress = silent,
    wall_clock: Callable[[], float] = time.time,
) -> PrintReport:
    """Go on with the journal's last job, or refuse.

    Parameters
    ----------
    printer
        With the journal of the job, not connected yet.
    release_c
        Below this bed temperature the material lets go of the bed.
    pose_confirmed
        A rescan has shown since that the part stands where it stood.
    end
        Where the part of the program that was being printed ends; None is the program's end.
    before
        What was printed before the program's first line, as (program, first, end): a program
        within a job knows its place and modes from there.

    Raises
    ------
    ResumeRefusedError
        Naming the interval; the heaters have been told to switch off.
    """
    return _Resumption(
        printer, checked, release_c, pose_confirmed, wall_clock, end=end, before=before
    ).run(progress)


def back_to_start(
    printer: SerialPrinter,
    checked: PrintableProgram,
    *,
    release_c: float,
    pose_confirmed: bool = False,
    before: Sequence[tuple[PrintableProgram, int, int]],
) -> None:
    """Have the machine where the journal's last job began, which can begin anew; or refuse.

    For a program that lays nothing and begins above all that stands there: the nozzle is lifted
    straight up to that height before it goes anywhere else.

    Parameters
    ----------
    printer, checked, release_c, pose_confirmed
        As for `resume`; the printer is connected afterwards.
    before
        What was printed before it, as for `resume`.

    Raises
    ------
    ResumeRefusedError
        Naming the interval; the heaters have been told to switch off.
    """
    _Resumption(
        printer, checked, release_c, pose_confirmed, time.time, end=None, before=before, anew=True
    ).prepared()


class _Resumption:
    def __init__(
        self,
        printer: SerialPrinter,
        checked: PrintableProgram,
        release_c: float,
        pose_confirmed: bool,
        wall_clock: Callable[[], float],
        *,
        end: int | None,
        before: Sequence[tuple[PrintableProgram, int, int]],
        anew: bool = False,
    ) -> None:
        self._printer, self._checked, self._before = printer, checked, before
        self._anew = anew
        self._release_c, self._pose_confirmed = release_c, pose_confirmed
        self._now_s = wall_clock()
        self._total = checked.program.line_count + 1 if end is None else end
        self._journal, self._job = self._last_job()
        self._silence_s = 0.0
        self._left_alone = False
        self._settled = False  # which line is next, by the printer's own word

    def run(self, progress: Progress) -> PrintReport:
        """Go on."""
        lines = range(self.prepared(), self._total)
        return self._printer.print(self._checked, lines=lines, progress=progress)

    def prepared(self) -> int:
        """The line to send next, with the machine there; a refusal says how it was left."""
        printer = self._printer
        try:
            return self._prepare()
        except ResumeRefusedError as error:
            safe = printer.notes[-1] if printer.notes else "nothing was sent to the printer"
            message = f"{error} Now: {safe}."
            raise ResumeRefusedError(
                message, error.last_executed_line, error.last_sent_line
            ) from error

    def _prepare(self) -> int:
        """Connect, find the line, judge, and bring the machine back to it."""
        printer = self._printer
        try:
            printer.connect(before_hello=self._settle)
            place = printer.place()
            line = self._job.acked if printer.dialect.verifies else self._line_by_place(place)
            modes = self._modes_after(line)
            self._require_place(place, modes, line)
            if self._anew:
                line, modes = 0, self._modes_after(0)
            if not self._pose_confirmed:
                self._require_motors()
                self._require_warm(modes)
            elif self._silence_s > MOTORS_HELD_S:
                self._home_above(place, line)
            self._restore(place, modes)
        except LinkLostError as error:  # it knows nothing of the job's lines: none was sent
            printer.make_safe()
            unsure = printer.forgot or not self._settled
            self._refuse(f"the link was lost again ({error.why})", reset=unsure)
        except ResumeRefusedError:
            printer.make_safe()
            raise
        return line

    # ------------------------------------------------------------------ which line

    def _last_job(self) -> tuple[Journal, JobRecord]:
        journal = self._printer.journal
        job = journal.latest() if journal is not None else None
        if journal is None or job is None:
            raise ResumeRefusedError(
                "There is no journal of a job on this port; name it with --journal, or send the "
                "program anew.",
                -1,
                -1,
            )
        if job.program_sha256 != self._checked.program.sha256:
            raise ResumeRefusedError(
                f"The journal's last job is another program ({job.program_sha256[:12]}, this is "
                f"{self._checked.program.sha256[:12]}); name the file that was being printed.",
                -1,
                -1,
            )
        if job.phase == "finished":
            raise ResumeRefusedError(
                "The journal says that this program was printed to its end; send it anew to "
                "print another.",
                job.end_line - 1,
                job.end_line - 1,
            )
        return journal, job

    def _settle(self, number: int | None) -> None:
        """Find the line from the printer's number, and write it down before the hello."""
        # Before this conversation adds to the journal: how was the printer left?
        self._silence_s = self._journal.longest_silence_s(self._now_s)
        self._left_alone = self._journal.heaters_left_alone()
        if not self._printer.dialect.verifies:
            return
        if number is None:
            self._refuse("the printer does not say which line it has received", reset=True)
        self._settled_at(self._line_after(number))

    def _settled_at(self, line: int) -> None:
        self._journal.settle(self._job.id, line)
        self._settled = True
        job = self._journal.latest()
        assert job is not None
        self._job = job

    def _line_after(self, number: int) -> int:
        """The program line to send next, if the printer has received `number` last."""
        job = self._job
        session = self._journal.session_of(number)
        if session is None or number > session.base + FOREIGN_LINES + self._total:
            self._refuse(
                f"the printer's line number is {number}, which this job never reached: it was "
                f"reset, or somebody else has spoken to it",
                reset=True,
            )
        if session.id != job.session:
            # A session that began no job: it only asked, and had settled the line before.
            if session.resumes == job.id and job.acked == job.reserved:
                return job.acked
            self._refuse(f"the printer's line number {number} is of another conversation")
        step = next((s for s in reversed(self._journal.steps(job.id)) if s.number <= number), None)
        if step is None:
            return job.first_line
        line = _line_in_step(self._checked, step, number)
        if line is None:
            self._refuse(f"the printer's line number {number} is beyond what was sent")
        return line

    def _line_by_place(self, place: PositionReport) -> int:
        """The program line to send next, if the nozzle's place fits one line alone."""
        job = self._job
        if job.phase == "forgotten":
            self._refuse("the printer has stopped or started anew since", reset=True)
        doubtful = [index for index, _ in commands_of(self._checked, job.acked, job.reserved)]
        if len(doubtful) > MOST_IN_DOUBT:
            self._refuse(f"{len(doubtful)} lines are in doubt and the firmware counts none")
        dialect = self._printer.dialect.name
        modes = self._modes_after(job.acked)
        fitting = [job.acked] if _fits(place, modes) else []
        for index in doubtful:
            modes = follow(modes, self._checked.lines(index, index + 1)[0], dialect)
            if _fits(place, modes):
                fitting.append(index + 1)
        at_origin = max(abs(place.x_mm), abs(place.y_mm)) < SAME_PLACE_MM  # as after a reset
        if at_origin or not (fitting if self._anew else len(fitting) == 1):
            self._refuse(
                f"the firmware counts no lines, and the nozzle's place fits {len(fitting)} of the "
                f"{len(doubtful) + 1} places where it may have been",
                reset=at_origin or not fitting,
            )
        self._settled_at(fitting[0])
        return fitting[0]

    def _modes_after(self, line: int) -> Modes:
        """The modes after the program's lines [0, line), and all that was printed before them."""
        dialect, modes = self._printer.dialect.name, Modes()
        for program, first, end in (*self._before, (self._checked, 0, line)):
            modes = modes_after(program, end, dialect, first=first, modes=modes)
        return modes

    # ------------------------------------------------------------------ is it safe

    def _require_place(self, place: PositionReport, modes: Modes, line: int) -> None:
        known = modes.position_mm
        if not {"X", "Y", "Z"} <= known.keys():
            self._refuse(
                f"line {line + 1} is in the start script, before the nozzle's place is known; "
                f"nothing is lost by sending the program anew"
            )
        if not _fits(place, modes, extruder=False):
            self._refuse(
                f"the nozzle is at X{place.x_mm:g} Y{place.y_mm:g} Z{place.z_mm:g}, where line "
                f"{line + 1} begins at X{known['X']:g} Y{known['Y']:g} Z{known['Z']:g}"
            )

    def _require_motors(self) -> None:
        if self._silence_s > MOTORS_HELD_S:
            self._refuse(
                f"the printer was left alone {for_how_long(self._silence_s)} and lets go of its "
                f"motors after {MOTORS_HELD_S:g} s; confirm by a rescan where the part stands, and "
                f"say --pose-confirmed"
            )

    def _require_warm(self, modes: Modes) -> None:
        """Refuse where the part may have come off: the bed was too cold for a moment."""
        if modes.bed_c <= self._release_c:
            return  # this job holds its part without heat
        now = self._printer.temperatures()
        if now.bed_c is None:
            return
        noted_c = self._journal.lowest_bed_c(self._release_c)
        lowest_c = min(now.bed_c, noted_c if noted_c is not None else now.bed_c)
        hint = "confirm by a rescan where the part stands, and say --pose-confirmed"
        if lowest_c < self._release_c:
            self._refuse(
                f"the bed fell to {lowest_c:.1f} °C, below the {self._release_c:g} °C at which "
                f"this material lets go; {hint}"
            )
        if now.bed_target_c and self._left_alone:
            self._refuse(
                f"the bed was switched off and on again, and nobody noted how cold it was; {hint}"
            )

    def _refuse(self, why: str, *, reset: bool = False) -> NoReturn:
        job = self._job
        known = job.acked - 1
        if reset or job.phase == "forgotten":  # what waited in its buffers may be gone
            most = self._printer.dialect.buffered_lines
            known = before_commands(self._checked, job.first_line, job.acked, most) - 1
        sent = max(job.reserved - 1, known)
        raise ResumeRefusedError(
            f"The job cannot be resumed: {why}. Program lines up to {known + 1} are executed, "
            f"none after {sent + 1} was sent; 'gcode resume-at' makes a job from a layer on.",
            known,
            sent,
        )

    # ------------------------------------------------------------------ back to work

    def _home_above(self, place: PositionReport, line: int) -> None:
        """Home X and Y, which may have been pushed, above all that was printed; never Z."""
        modes, dialect, highest_mm = Modes(), self._printer.dialect.name, place.z_mm
        for program, first, end in (*self._before, (self._checked, 0, line)):
            for index, command in commands_of(program, first, end):
                if _SHIFT.match(command):
                    self._refuse(
                        f"the motors may have let go, and homing X and Y would undo line "
                        f"{index + 1}, {command!r}"
                    )
                modes = follow(modes, command, dialect)
                highest_mm = max(highest_mm, modes.position_mm.get("Z", 0.0))
        lift_mm = highest_mm + PAUSE_LIFT_MM - place.z_mm
        for command in ("G21", "G91", f"G1 Z{lift_mm:.2f} F600", "G90", "G28 X Y"):
            self._printer.command(command)

    def _restore(self, place: PositionReport, modes: Modes) -> None:
        """Lift, heat, go back to where the job left off, modes and extruder as it left them."""
        known = modes.position_mm

        def tell(command: str) -> None:
            if self._printer.abort_asked:
                self._refuse("somebody has ended it meanwhile")
            self._printer.command(command)

        tell("G21")
        if place.z_mm < known["Z"] + PAUSE_LIFT_MM / 2:
            lift_mm = max(PAUSE_LIFT_MM, known["Z"] - place.z_mm)
            for command in ("G91", f"G1 Z{lift_mm:.3f} F600", "G90"):
                tell(command)
        if modes.bed_c > 0:
            tell(f"M140 S{modes.bed_c:g}")
            tell(f"M190 S{modes.bed_c:g}")
        for command in modes.heating(self._printer.heads, self._printer.dialect.name):
            tell(command)
        tell(f"M106 S{modes.fan:g}" if modes.fan > 0 else "M107")
        e_mm = known.get("E", place.e_mm) if modes.absolute_e else place.e_mm
        for command in modes.restore(known["X"], known["Y"], known["Z"], e_mm):
            tell(command)


def _line_in_step(checked: PrintableProgram, step: Step, number: int) -> int | None:
    """The line after the one that has `number`; None if the step has no such number."""
    received = number - step.number + 1
    if step.reserved == step.line:  # the host's own commands: all before is executed
        return step.line if received <= FOREIGN_LINES else None
    sent: Iterator[tuple[int, str]] = commands_of(checked, step.line, step.reserved)
    if received == 0:
        return step.line
    last = next(islice(sent, received - 1, received), None)
    return None if last is None else last[0] + 1


def _fits(place: PositionReport, modes: Modes, *, extruder: bool = True) -> bool:
    """Whether the nozzle is where the modes say, or lifted straight up from there."""
    known = modes.position_mm
    if not {"X", "Y", "Z"} <= known.keys():
        return False
    if extruder and "E" in known and abs(place.e_mm - known["E"]) > SAME_E_MM:
        return False
    return (
        abs(place.x_mm - known["X"]) <= SAME_PLACE_MM
        and abs(place.y_mm - known["Y"]) <= SAME_PLACE_MM
        and place.z_mm >= known["Z"] - SAME_PLACE_MM
    )
