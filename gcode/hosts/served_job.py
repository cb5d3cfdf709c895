"""A job that a server's own printer prints from its file, as a `Printer` that rests at its looks.

The job's lines are the server's to print: asked for them, this port lets it go on and returns when
it rests behind the line of the look. What is printed at a look (parking, a repair) goes to the
resting printer and is counted there: so whoever was away, agent, server or link, learns from the
other side what was carried out, and nothing is printed twice. How a server is asked to rest, to go
on and to count is in `moonraker_job` and `octoprint_job`.
"""

from __future__ import annotations

import hashlib
import math
import threading
from abc import abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, TypeVar
from urllib.parse import quote

from gcode.check.touches import touch_lines
from gcode.errors import LinkError, PortBusyError, PrinterError
from gcode.hosts.job_text import JobText
from gcode.hosts.modes import GO_MM_MIN, LIFT_MM_MIN, Modes, commands_of, modes_after
from gcode.hosts.port import LinkLostError, PrintableProgram, PrintReport, ResumeRefusedError
from gcode.hosts.proof import require_checked
from gcode.hosts.rejoin import require_as_left
from gcode.hosts.rewritten import Rewritten
from gcode.hosts.server import ServerPrinter, Session
from gcode.progress import Progress, silent

AGENT = "amrepair"
Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class UnderWay:
    """A print that the server has begun.

    Attributes
    ----------
    id
        The server's own number for it: another print of the same file has another.
    """

    name: str
    id: str


class ServedJob(ServerPrinter[Session]):
    """A printer whose job a server prints by itself; parameters of `ServerPrinter`.

    `follow` says which job it is; programs that are not that job go to the resting printer.
    """

    _job_text: JobText | None = None
    _rest_anew: Rewritten | None = None
    """What is printed in the place of the job's last lines."""
    _name = _sha256 = ""
    _joining = False
    _heat_at_look: tuple[tuple[float, ...], float] = ((), 0.0)
    """What each head and the bed were set to as the job came to rest; 0 where that is not known."""
    _held_back: threading.Event

    # ------------------------------------------------------------------ of each server

    @abstractmethod
    def under_way(self) -> UnderWay | None:
        """The print that the server has begun and not ended; None where there is none."""

    @abstractmethod
    def require_partner(self) -> None:
        """Refuse a printer that lacks what counts our lines there."""

    @abstractmethod
    def forget_steps(self) -> None:
        """What an earlier run had counted is none of this one's."""

    @abstractmethod
    def pass_by(self) -> None:
        """Go on without a look."""

    @abstractmethod
    def calls(self, wait_s: float) -> list[dict[str, Any]]:
        """What people have asked for at the printer since the last time; waits for some."""

    def showing(self, page: str, token: str | None) -> AbstractContextManager[object]:
        """While a run has a live page at host:port (empty: none), have it shown there."""
        return nullcontext()

    def leave(self, way_back: Sequence[PrintableProgram]) -> None:
        """What leads back to the job, for somebody who lets it go on without us.

        A server whose own pause has its own way back needs none.
        """

    @abstractmethod
    def _refresh(self) -> None:
        """Ask how the server's print stands."""

    @abstractmethod
    def _rest(self) -> tuple[bool, int]:
        """Whether the job rests, and the line that comes next; asked, for news lag."""

    @abstractmethod
    def _how_it_ended(self, end: int) -> bool | None:
        """None while the print is under way; else whether it is complete up to line `end`."""

    @abstractmethod
    def _has_it(self) -> bool:
        """Whether the server still prints this job."""

    @abstractmethod
    def _pending(self) -> bool:
        """Whether somebody waits for us: then nothing is waited for."""

    @abstractmethod
    def _go_on(self, line: int, first: int) -> None:
        """Have the server print on from line `first`, resting behind the look before `line`."""

    @abstractmethod
    def _print_at_rest(self, checked: PrintableProgram, lines: range, progress: Progress) -> None:
        """Have a program printed at the look, each line once."""

    @abstractmethod
    def _reached_at_rest(self, checked: PrintableProgram, lines: range) -> int:
        """The line of a program that was under way when we went, where it is to be gone on with."""

    @abstractmethod
    def _settled(self) -> None:
        """Return when nothing that was sent is under way."""

    @abstractmethod
    def _heat_of_before(self) -> tuple[tuple[float, ...], float]:
        """What heads and bed were set to when they were switched off; 0 where they were not."""

    def _text_of(self, data: bytes) -> JobText:
        return JobText(data)

    # ------------------------------------------------------------------ which job

    def fetch(self, name: str) -> bytes:
        """A job's file as it lies on the server."""
        answer = self._session.web.request("GET", f"{self._downloads}/{quote(name)}")
        if answer.status_code != 200:
            raise LinkError(f"{self.address.name} does not give the file {name!r} out.")
        return bytes(answer.content)

    @property
    def _downloads(self) -> str:
        return self.files

    def follow(self, name: str, data: bytes) -> int:
        """Serve this job from now on; returns the first line that a look can still stand before."""
        self._name, self._job_text, self._sha256 = name, self._text_of(data), ""
        self._joining, self._rest_anew = False, None
        self._session.state.follow(name)
        self._refresh()
        rests, line = self._rest()
        return line + (not rests)

    def serve(self, checked: PrintableProgram) -> None:
        """Which program the job is: its lines are the server's to print.

        Raises
        ------
        LinkError
            If it is another.
        """
        if checked.program.line_count != self._text.lines:
            raise LinkError(f"{self._name} on {self.address.name} is not the file that was read.")
        self._sha256 = checked.program.sha256

    def rests_at(self) -> int | None:
        """The line after the look that the job rests at; None where it does not rest at one."""
        rests, line = self._rest()
        return line if rests and self._text.is_look(line) else None

    def rests_at_look(self) -> bool:
        """Whether the job rests where it asks for a look."""
        return self.rests_at() is not None

    def _is_the_jobs(self, checked: PrintableProgram) -> bool:
        """Whether the server prints it from the job's file."""
        anew = "" if self._rest_anew is None else self._rest_anew.checked.program.sha256
        return checked.program.sha256 in {self._sha256, anew}

    @property
    def _text(self) -> JobText:
        if self._job_text is None:
            raise LinkError("no job is followed; call follow() first.")
        return self._job_text

    # ------------------------------------------------------------------ printing

    def print(
        self,
        checked: PrintableProgram,
        *,
        lines: range | None = None,
        progress: Progress = silent,
    ) -> PrintReport:
        """Have the server print on to a look of the job, or print a program of ours at one."""
        require_checked(checked)
        start_s = self._clock()
        lines = range(checked.program.line_count) if lines is None else lines
        ok, end = True, lines.stop
        anew = self._rest_anew
        if checked.program.sha256 == self._sha256:
            ok = self._print_on(lines.start, lines.stop, progress)
            end = lines.stop if ok else self._rest()[1]
        elif anew is not None and checked.program.sha256 == anew.checked.program.sha256:
            end = self._text.lines if end >= anew.total else anew.theirs(end)
            ok = self._print_on(anew.theirs(lines.start), end, progress)
            end = lines.stop if ok else anew.ours(self._rest()[1])
        else:
            first = lines.start
            if self._joining:
                first = self._reached_at_rest(checked, lines)
            self._joining = False
            self._print_at_rest(checked, range(first, lines.stop), progress)
        size = sum(len(text) + 1 for text in checked.lines(lines.start, end))
        return PrintReport(
            ok=ok, lines_acked=sum(1 for _ in commands_of(checked, lines.start, end)),
            bytes_sent=size, seconds=self._clock() - start_s, next_line=end,
            first_line=lines.start,
            warnings=() if ok else (f"{self.address.name} cancelled the print",),
        )  # fmt: skip

    def _print_on(self, first: int, end: int, progress: Progress) -> bool:
        """Until the job rests behind the look that line `end` follows, or is over."""
        while True:
            self._asked(self._refresh)
            complete = self._how_it_ended(end)
            if complete is not None:
                return complete
            if not self._has_it():
                raise self._gone(first, end, f"it has let go of {self._name}")
            rests, line = self._asked(self._rest)
            progress("printing", float(min(line, end) - first), float(end - first))
            if rests and self._text.is_look(line):
                if line == end:
                    now = self._asked(self.temperatures)
                    self._heat_at_look = (now.hotend_targets_c, now.bed_target_c or 0.0)
                    return True
                if line < end:
                    self._go_on(line, max(first, line))
                    continue
            if line > end:
                raise self._gone(first, end, "the print was resumed at the look by somebody else")
            with self._session.news:
                if not self._pending():
                    self._session.news.wait(self._timing.poll_s)

    def _complete(self, end: int, hint: str) -> bool:
        """Whether a print that is over was to end there; refused where a look was to come."""
        if end < self._text.lines:
            raise LinkError(
                f"the print of {self._name} ended and never rested at the look before line "
                f"{end + 1}; {hint}"
            )
        return True

    # ------------------------------------------------------------------ a run gone on with

    def pick_up(
        self,
        sent: Sequence[tuple[PrintableProgram, int, int, bool]],
        *,
        release_c: float,
        pose_confirmed: bool = False,
    ) -> None:
        """Find a job again that an agent was serving, as (program, first, end, done) were sent.

        Raises
        ------
        ResumeRefusedError
            If the machine is not as it was left.
        """
        self._joining = True
        if not sent or (self._is_the_jobs(sent[-1][0]) and not sent[-1][3]):
            return  # the server has it in hand
        checked, first, end, done = sent[-1]
        self._asked(self._settled)
        anew = not done and bool(touch_lines(checked.program))  # touches lay nothing
        if not done:
            end = first if anew else self._reached_at_rest(checked, range(first, end))
        sent = [*sent[:-1], (checked, first, end, done)]
        modes = Modes()
        for program, start, stop, _ in sent:
            modes = _after(program, start, stop, modes)
        if anew:
            self._joining = False
            self._lift_to(modes)
        elif self._is_the_jobs(checked) or end == first:
            modes.position_mm.clear()  # the server's own pause has parked it somewhere
        self._heat_as_left(sent)

        def refuse(why: str) -> ResumeRefusedError:
            return ResumeRefusedError(
                f"The job on {self.address.name} cannot be gone on with: {why}.", first - 1, end - 1
            )

        require_as_left(
            self, modes, refuse, dialect=checked.program.dialect, release_c=release_c,
            pose_confirmed=pose_confirmed,
        )  # fmt: skip

    def _lift_to(self, modes: Modes) -> None:
        """Straight up from a touch to where the touches began, and there."""
        place = modes.position_mm
        if not set("XYZ") <= set(place) or not self._rest()[0]:
            raise LinkError(
                f"where the nozzle is over {self._name} on {self.address.name} is not known: it "
                "was left in the midst of touches."
            )
        for text in (
            "G90", f"G1 Z{place['Z']:.3f} F{LIFT_MM_MIN}",
            f"G1 X{place['X']:.3f} Y{place['Y']:.3f} F{GO_MM_MIN}", "M400",
        ):  # fmt: skip
            self.command(text)

    def _heat_as_left(self, sent: Sequence[tuple[PrintableProgram, int, int, bool]]) -> None:
        """Heat again what was switched off since; a nozzle that was cooled on purpose stays so."""
        of_job, at_look = Modes(), Modes(hotend_c=math.nan)
        for program, first, end, _ in sent:
            if self._is_the_jobs(program):
                of_job, at_look = _after(program, first, end, of_job), Modes(hotend_c=math.nan)
            else:
                at_look = _after(program, first, end, at_look)
        now, (hotends_c, bed_c) = self.temperatures(), self._heat_of_before()
        each_c = of_job.targets_c(len(now.hotend_targets_c))
        self._heat_at_look = (either_c(hotends_c, each_c), bed_c or of_job.bed_c)
        if bed_c and not now.bed_target_c:
            self.command(f"M140 S{bed_c:g}")
        if at_look.hotend_c != 0:
            for line in heated_again(hotends_c, now.hotend_targets_c):
                self.command(line)

    def _asked(self, ask: Callable[[], Answer]) -> Answer:
        """Ask; a server that went away gets time to come back."""
        until_s = self._clock() + self._timing.lost_s
        while True:
            try:
                return ask()
            except (PrinterError, PortBusyError) as error:
                if isinstance(error, PrinterError) or self._clock() > until_s:
                    raise
            except LinkError as error:
                if self._clock() > until_s:
                    raise self._gone(0, 0, f"{error} It may be printing on by itself") from error
            self.wait(self._timing.poll_s)

    def _gone(self, first: int, end: int, why: str) -> LinkLostError:
        return LinkLostError(
            f"The print of {self._name} on {self.address.name} is not followed any more: {why}.",
            first - 1, end - 1,
        )  # fmt: skip

    def _in_doubt(self, first: int, after: int) -> ResumeRefusedError:
        return ResumeRefusedError(
            f"the printer was cut short in lines {first + 1} to {after} of what was printed at the "
            "look: which of them it has carried out is not known, and none is printed twice.",
            first - 1, after - 1,
        )  # fmt: skip


def either_c(first: Sequence[float], other: Sequence[float]) -> tuple[float, ...]:
    """By head, what one tells of it, or else the other."""
    return tuple(a or b for a, b in zip_longest(first, other, fillvalue=0.0))


def heated_again(was_c: Sequence[float], now_c: Sequence[float]) -> list[str]:
    """Lines that heat each head that was on and is off."""
    off = [
        k
        for k, (was, now) in enumerate(zip_longest(was_c, now_c, fillvalue=0.0))
        if was and not now
    ]
    alone = max(len(was_c), len(now_c)) < 2
    words = [f"S{was_c[k]:g}" if alone else f"T{k} S{was_c[k]:g}" for k in off]
    heats = [] if alone else [f"M104 {word}" for word in words]
    return [*heats, *(f"M109 {word}" for word in words)]


def number_of(checked: PrintableProgram) -> int:
    """What the other side's count calls a program."""
    return int(hashlib.sha256(checked.program.sha256.encode()).hexdigest()[:12], 16)


def _after(program: PrintableProgram, first: int, end: int, modes: Modes) -> Modes:
    return modes_after(program, end, program.program.dialect, first=first, modes=modes)
