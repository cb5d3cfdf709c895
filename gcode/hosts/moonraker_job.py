"""A job that Klipper prints from its own file, as a `Printer` that rests at the job's looks.

The job's lines are Klipper's to print: asked for them, this port lets Klipper go on and returns
when it has paused behind the line of the look. What is printed at a look (parking, a repair) goes
to the paused printer as short scripts. Before each stands a step of the printer's own macro, which
counts it and refuses it where the job goes on or another step is due: so whoever was away, agent,
server or link, learns from the printer what was carried out, and nothing is printed twice.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar
from urllib.parse import quote

from gcode.errors import LinkError, PortBusyError, PrinterError
from gcode.hosts.job_text import JobText
from gcode.hosts.modes import Modes, commands_of, modes_after
from gcode.hosts.moonraker import MoonrakerPrinter
from gcode.hosts.moonraker_session import MoonrakerSession
from gcode.hosts.port import LinkLostError, PrintableProgram, PrintReport, ResumeRefusedError
from gcode.hosts.proof import require_checked
from gcode.hosts.rejoin import require_as_left
from gcode.progress import Progress, silent

AGENT, METHOD = "amrepair", "amrepair_call"
STEP = "_AMREPAIR_STEP"
STEP_LINES = 40
"""Lines a script: some seconds of moves, which Klipper has queued long before they are made."""
WRITTEN_S = 3.0
"""By then a server has long written a new print down; one that it was restarted in it calls
interrupted, and goes on with."""

Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class UnderWay:
    """A print that Klipper has begun.

    Attributes
    ----------
    id
        The server's own number for it: another print of the same file has another.
    """

    name: str
    id: str


class KlipperJob(MoonrakerPrinter):
    """A printer whose job Klipper prints by itself; parameters of `ServerPrinter`.

    `follow` says which job it is; programs that are not that job go to the paused printer.
    """

    _job: JobText | None = None
    _name = _sha256 = ""
    _joining = False
    _unsure_s: float | None = None

    def _new_session(self) -> MoonrakerSession:
        self._hold = threading.Event()
        return MoonrakerSession(
            self.address, self._key, self._timing, self._clock, self._log,
            agent=AGENT, methods=(METHOD,),
        )  # fmt: skip

    def _refuse_unless_ready(self) -> None:
        """It is there to be served while it prints, and when nothing is printed."""
        self._session.listen()

    # ------------------------------------------------------------------ which job

    def under_way(self) -> UnderWay | None:
        """The print that Klipper has begun and not ended; None where there is none.

        Raises
        ------
        LinkError
            If the server cannot be reached, or no Klipper is behind it.
        """
        session, state = self._session, self._session.state
        session.look()
        if not state.busy or not state.print_file:
            return None
        found = session.call("server.history.list", {"limit": 1, "order": "desc"})
        jobs = found.get("jobs") if isinstance(found, dict) else None
        latest = jobs[0] if isinstance(jobs, list) and jobs else {}
        if latest.get("filename") != state.print_file:
            return None  # the server has not written it down yet
        if latest.get("status") == "in_progress":
            self._unsure_s = None
        elif self._unsure_s is None:
            self._unsure_s = self._clock()
        if self._unsure_s is not None and self._clock() - self._unsure_s < WRITTEN_S:
            return None  # an earlier print of this file, or a server that was restarted in this one
        return UnderWay(state.print_file, str(latest.get("job_id")))

    def fetch(self, name: str) -> bytes:
        """A job's file as it lies on the server."""
        answer = self._session.request("GET", f"{self.files}/{quote(name)}")
        if answer.status_code != 200:
            raise LinkError(f"{self.address.name} does not give the file {name!r} out.")
        return answer.content

    def follow(self, name: str, data: bytes) -> int:
        """Serve this job from now on; returns the first line that a look can still stand before."""
        self._name, self._job, self._sha256, self._joining = name, JobText(data), "", False
        self._session.state.follow(name)
        self._session.look()
        rests, byte = self._rest()
        return self._job.line_at(byte) + (not rests)

    def serve(self, checked: PrintableProgram) -> None:
        """Which program the job is: its lines are Klipper's to print.

        Raises
        ------
        LinkError
            If it is another.
        """
        if checked.program.text.count("\n") != self._text.lines:
            raise LinkError(f"{self._name} on {self.address.name} is not the file that was read.")
        self._sha256 = checked.program.sha256

    def rests_at(self) -> int | None:
        """The line after the look that the job rests at; None where it does not rest at one."""
        rests, byte = self._rest()
        line = self._text.line_at(byte)
        return line if rests and self._text.is_look(line) else None

    def rests_at_look(self) -> bool:
        """Whether the job rests where it asks for a look."""
        return self.rests_at() is not None

    def pass_by(self) -> None:
        """Go on without a look."""
        self._session.call("printer.print.resume", limit_s=None)

    def wait(self, wait_s: float) -> None:
        """Until there is news, or so long."""
        with self._session.news:
            self._session.news.wait(wait_s)

    def forget_steps(self) -> None:
        """What an earlier run had counted is none of this one's."""
        self.command("\n".join(f"SET_GCODE_VARIABLE MACRO={STEP} VARIABLE={v} VALUE=0" for v in
                               ("program", "begun", "done", "hotend", "bed")))  # fmt: skip

    # ------------------------------------------------------------------ printing

    def print(
        self,
        checked: PrintableProgram,
        *,
        lines: range | None = None,
        progress: Progress = silent,
    ) -> PrintReport:
        """Have Klipper print on to a look of the job, or print a program of ours while it rests."""
        require_checked(checked)
        start_s = self._clock()
        total = checked.program.text.count("\n")
        lines = range(total) if lines is None else lines
        if checked.program.sha256 == self._sha256:
            ok = self._print_on(lines.start, lines.stop, progress)
        else:
            self._print_at_rest(checked, lines, progress)
            ok = True
        end = lines.stop if ok else self._text.line_at(self._session.state.file_position)
        size = sum(len(text) + 1 for text in checked.lines(lines.start, end))
        return PrintReport(
            ok=ok, lines_acked=sum(1 for _ in commands_of(checked, lines.start, end)), resends=0,
            stalls=0, spare_oks=0, bytes_sent=size, seconds=self._clock() - start_s,
            next_line=end, round_trip_s=(0.0, 0.0, 0.0), first_line=lines.start,
            warnings=() if ok else (f"{self.address.name} cancelled the print",),
        )  # fmt: skip

    @property
    def _text(self) -> JobText:
        if self._job is None:
            raise LinkError("no job is followed; call follow() first.")
        return self._job

    def _rest(self) -> tuple[bool, int]:
        """Whether the job rests, and the byte that Klipper reads next; asked, for news lag."""
        told = self._session.query(
            {"virtual_sdcard": ["is_active", "file_position"], "print_stats": ["state"]}
        )
        card = told.get("virtual_sdcard", {})
        paused = told.get("print_stats", {}).get("state") == "paused"
        return paused and not card.get("is_active", True), int(card.get("file_position") or 0)

    def _print_on(self, first: int, end: int, progress: Progress) -> bool:
        """Until Klipper rests behind the look that line `end` follows, or the job is over."""
        state, text = self._session.state, self._text
        while True:
            self._asked(self._session.look)
            if state.ended:
                return self._ended(end)
            if state.print_file != self._name or not state.busy:
                raise self._gone(first, end, f"Klipper has let go of {self._name}")
            rests, byte = self._asked(self._rest)
            line = text.line_at(byte)
            progress("printing", float(min(line, end) - first), float(end - first))
            if rests and text.is_look(line):
                if line == end:
                    return True
                if line < end:
                    self._go_on(line, max(first, line))
                    continue
            if line > end:
                raise self._gone(first, end, "the print was resumed at the look by somebody else")
            with self._session.news:
                if not state.called:
                    self._session.news.wait(self._timing.poll_s)

    def _go_on(self, line: int, first: int) -> None:
        """Have Klipper print on from line `first`, resting behind the look before `line`."""
        if first != line:  # what lies between was printed by us, and ended elsewhere
            self.command(f"SAVE_GCODE_STATE NAME=PAUSE_STATE\nM26 S{self._text.start(first)}")
        self._session.call("printer.print.resume", limit_s=None)

    def _ended(self, end: int) -> bool:
        state = self._session.state
        if state.outcome == "cancelled":
            return False
        if state.outcome == "complete" and end >= self._text.lines:
            return True
        if state.outcome == "complete":
            raise LinkError(
                f"the print of {self._name} ended and never rested at the look before line "
                f"{end + 1}; is amrepair.cfg included in printer.cfg?"
            )
        why = state.klippy_message if state.stopped else state.message
        raise PrinterError(f"{self.address.name} reports a fault: {' '.join(why.split())[:200]}")

    # ------------------------------------------------------------------ at rest

    def _print_at_rest(self, checked: PrintableProgram, lines: range, progress: Progress) -> None:
        """Send a program to the paused printer, a step at a time, each once."""
        program = _number(checked)
        first = self._reached(checked, lines) if self._joining else lines.start
        self._joining = False
        self._require_rest()
        while first < lines.stop:
            while self._hold.is_set():
                with self._session.news:
                    self._session.news.wait(self._timing.poll_s)
            after = min(first + STEP_LINES, lines.stop)
            start = " START=1" if first == lines.start else ""
            script = [f"{STEP} PROGRAM={program} FROM={first} TO={after}{start}"]
            script += [command for _, command in commands_of(checked, first, after)]
            script.append(f"SET_GCODE_VARIABLE MACRO={STEP} VARIABLE=done VALUE={after}")
            self._carry_out("\n".join(script), program, first, after)
            progress("printing", float(after - lines.start), float(len(lines)))
            first = after

    def _carry_out(self, script: str, program: int, first: int, after: int) -> None:
        """Have a step carried out once, whatever becomes of the link meanwhile."""
        while True:
            try:
                self.command(script)
            except PrinterError:
                raise
            except LinkError:
                self._asked(self._settled)
                told = self._steps()
                if told["program"] == program and told["begun"] == told["done"] == after:
                    return
                if told["program"] == program and told["begun"] == after:
                    raise self._in_doubt(first, after) from None
                self._require_rest()
                continue
            return

    def _settled(self) -> None:
        """Return when nothing that was sent is under way."""
        self._session.look()
        self.command("M400")

    def _reached(self, checked: PrintableProgram, lines: range) -> int:  # type: ignore[override]
        """The line of a program that was under way when we went, where it is to be gone on with."""
        self._asked(self._settled)
        told = self._steps()
        if told["program"] != _number(checked):
            return lines.start
        if told["begun"] != told["done"]:
            raise self._in_doubt(told["done"], told["begun"])
        return max(lines.start, min(told["done"], lines.stop))

    def _steps(self) -> dict[str, int]:
        """What the printer's macro has counted."""
        key = f"gcode_macro {STEP}"
        told = self._session.query({key: None}).get(key)
        if told is None:
            raise LinkError(
                f"the printer behind {self.address.name} has no macro {STEP}; include amrepair.cfg "
                "('amrepair agent --macros') in printer.cfg and restart Klipper."
            )
        return {name: int(told.get(name) or 0) for name in ("program", "begun", "done", "hotend",
                                                            "bed")}  # fmt: skip

    def require_macros(self) -> None:
        """Refuse a printer without our macros."""
        self._steps()

    def _require_rest(self) -> None:
        rests, _ = self._asked(self._rest)
        if not rests:
            raise PrinterError("the print goes on or has ended; nothing is printed at its look.")
        if not self.motors_held():
            raise PrinterError(
                "the motors were let go while the print rested (Klipper's idle_timeout): where "
                "the nozzle is, is not known, and the print cannot be gone on with."
            )

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
        if not sent or (sent[-1][0].program.sha256 == self._sha256 and not sent[-1][3]):
            return  # Klipper has it in hand
        checked, first, end, done = sent[-1]
        self._asked(self._settled)
        end = end if done else self._reached(checked, range(first, end))
        modes = Modes()
        for program, start, stop in (*(row[:3] for row in sent[:-1]), (checked, first, end)):
            modes = modes_after(program, stop, program.program.dialect, first=start, modes=modes)
        if checked.program.sha256 == self._sha256 or end == first:
            modes.position_mm.clear()  # a PAUSE macro has parked it somewhere
        told = self._steps()
        now = self.temperatures()
        if told["bed"] and not now.bed_target_c:
            self.command(f"M140 S{told['bed']}")
        if told["hotend"] and not now.hotend_target_c:
            self.command(f"M109 S{told['hotend']}")

        def refuse(why: str) -> ResumeRefusedError:
            return ResumeRefusedError(
                f"The job on {self.address.name} cannot be gone on with: {why}.", first - 1, end - 1
            )

        require_as_left(self, modes, refuse, release_c=release_c, pose_confirmed=pose_confirmed)

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
            with self._session.news:
                self._session.news.wait(self._timing.poll_s)

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

    # ------------------------------------------------------------------ pause, safety

    def pause(self) -> None:
        """Hold what is printed at a look; have Klipper pause where the job goes on."""
        self._hold.set()
        if not self._rest()[0]:
            super().pause()

    def resume(self) -> None:
        """Go on."""
        self._hold.clear()
        rests, byte = self._rest()
        if rests and not self._text.is_look(self._text.line_at(byte)):
            super().resume()

    def heaters_off(self) -> None:
        """Switch heaters off where our job rests; one that Klipper prints goes on.

        What they were set to stays with the printer, for whoever goes on.
        """
        self._session.look()
        state = self._session.state
        if state.stopped or (state.busy and state.print_file != self._name):
            return  # off already, or somebody else's
        if state.busy:
            if not self._rest()[0]:
                return
            now = self.temperatures()
            for name, value in (("hotend", now.hotend_target_c), ("bed", now.bed_target_c or 0)):
                if value:
                    text = f"SET_GCODE_VARIABLE MACRO={STEP} VARIABLE={name} VALUE={round(value)}"
                    self.command(text)
        super().heaters_off()

    # ------------------------------------------------------------------ macros

    def calls(self, wait_s: float) -> list[dict[str, Any]]:
        """What the printer's macros have asked for since the last time; waits for some."""
        session = self._session
        with session.news:
            session.news.wait_for(lambda: bool(session.state.called), wait_s)
            found = [params for _, params in session.state.called]
            session.state.called.clear()
        return found


def _number(checked: PrintableProgram) -> int:
    """What the printer's macro calls a program."""
    return int(hashlib.sha256(checked.program.sha256.encode()).hexdigest()[:12], 16)
