"""The supervisor: starts a process a printer, restarts what died, carries questions and answers.

A process that ended by itself has said why: it is not started again. One that was killed or broke
down is, with `--resume`, so that its journal decides what may still be printed; so many times and
no more. A port has one owner by the lock that the process takes on it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from amrepair.errors import InputError
from amrepair.fleet.config import FleetConfig, FleetOptions, PrinterSpec
from amrepair.fleet.desk import JUDGES, STATUS, answer, read_note, write_note
from amrepair.fleet.judges import Judges
from amrepair.loop.tape import read_events
from gcode.locks import try_lock
from gcode.process import one_thread

BACK_OFF_S = 2.0
# How long a process may take to lift the nozzle, switch heaters off and end.
END_S = 90.0
DESK, LOG = "desk", "loop.log"
LOG_TAIL_BYTES = 1 << 14  # its last words
INTERRUPTED = 130
OWN_ENDS = (0, 2, 3, 4, INTERRUPTED)


class RunState(StrEnum):
    """What a printer's row says."""

    RUNS = "runs"
    ASKS = "asks"
    ORPHAN = "runs without a supervisor"
    WAITS = "is started again"
    DONE = "done"
    BEYOND = "done, not within tolerance"
    STOPPED = "stopped"
    FAILED = "needs somebody"


OVER = (RunState.DONE, RunState.BEYOND, RunState.STOPPED, RunState.FAILED)
Command = Callable[[PrinterSpec, Path, bool], list[str]]


def loop_command(spec: PrinterSpec, folder: Path, going_on: bool) -> list[str]:
    """What is typed for a printer."""
    start = [sys.executable, "-m", "amrepair", "loop"]
    tail = ["--json", "--desk", str(folder / DESK)]
    if going_on:
        return [*start, "--resume", str(folder), "--port", spec.port, *tail]
    words = [str(spec.job), "--template", str(spec.template), "--port", spec.port,
             "--scanner", spec.scanner, "--printer", spec.printer, "--material", spec.material,
             "--process", spec.process, "--approve", spec.approve, "--every", str(spec.every),
             "--scan-timeout-s", f"{spec.scan_timeout_s:g}", "--out", str(folder)]  # fmt: skip
    for layer in spec.at_layer:
        words += ["--at-layer", str(layer)]
    return [*start, *words, *tail]


@dataclass(slots=True)
class Seat:
    """One printer's process and what is known of it.

    Attributes
    ----------
    restarts, restarted
        When it was started again of late, and how often in all.
    answered
        Number of the last question that somebody answered.
    orphan
        Process of an earlier supervisor's that still prints; 0 where there is none.
    log_bytes
        Where its log begins that is of the process.
    """

    spec: PrinterSpec
    folder: Path
    options: FleetOptions
    command: Command
    state: RunState = RunState.WAITS
    sentence: str = ""
    status: dict[str, Any] = field(default_factory=dict)
    process: subprocess.Popen[bytes] | None = None
    orphan: int = 0
    restarts: deque[float] = field(default_factory=deque)
    restarted: int = 0
    start_at_s: float = 0.0
    stopping: bool = False
    killed_at_s: float = 0.0
    answered: int = 0
    log_bytes: int = 0

    def begin(self, now_s: float) -> None:
        """Find out what its folder holds: nothing, a run to go on with, or a run that is over."""
        pid = int((read_note(self.folder / DESK / STATUS) or {}).get("pid", 0))
        if _is_ours(pid, self.folder):
            self.orphan, self.state = pid, RunState.ORPHAN
            return
        events = read_events(self.folder)
        if events and events[-1].get("event") == "end":
            over = events[-1].get("stopped")
            self.state = RunState.STOPPED if over else RunState.DONE
            self.sentence = str(over) if over else "printed before; empty its folder to print again"
            return
        self.start_at_s, self.state = now_s, RunState.WAITS

    def step(self, now_s: float) -> None:
        """Look at the process, and do what is due."""
        self.status = read_note(self.folder / DESK / STATUS) or {}
        if self.orphan:
            if not _is_ours(self.orphan, self.folder):
                self.orphan = 0
                self.begin(now_s)
            return
        if self.process is not None:
            code = self.process.poll()
            if code is None:
                self._watch(now_s)
            else:
                self.process = None
                self._ended(code, now_s)
        elif self.state is RunState.WAITS and now_s >= self.start_at_s:
            self._start()

    def _start(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / DESK / STATUS).unlink(missing_ok=True)
        command = self.command(self.spec, self.folder, bool(read_events(self.folder)))
        with (
            (self.folder / "loop.out").open("wb") as out,
            (self.folder / LOG).open("ab") as log,
        ):
            self.log_bytes = log.tell()
            # a session of its own: an interrupt at the terminal is the supervisor's to pass on
            self.process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=out, stderr=log, start_new_session=True,
                env={**os.environ, **one_thread()},  # as the shared judges: many on a few cores
            )  # fmt: skip
        self.state, self.sentence, self.status = RunState.RUNS, "", {}

    def _watch(self, now_s: float) -> None:
        question = self.status.get("question")
        self.state = RunState.ASKS if question else RunState.RUNS
        if self.stopping:
            self.state = RunState.RUNS
            if now_s >= self.killed_at_s + END_S:  # it does not end: its own supervisor makes safe
                assert self.process is not None
                self.process.kill()
        elif question and now_s - question["since_s"] > self.options.answer_within_s:
            self.sentence = (
                f"nobody answered for {self.options.answer_within_s:.0f} s; the run was ended"
            )
            self.stop(now_s)

    def _ended(self, code: int, now_s: float) -> None:
        said = read_note(self.folder / "loop.out") or {}
        why = str(said.get("error") or said.get("stopped") or "").removeprefix("amrepair: ")
        if self.stopping or code == INTERRUPTED:
            self.stopping = False
            self.state = RunState.STOPPED
            self.sentence = f"{self.sentence or 'stopped'}; {self._said_of_heaters()}"
        elif code in OWN_ENDS:
            self.state = {0: RunState.DONE, 3: RunState.BEYOND}.get(code, RunState.FAILED)
            self.sentence = why
        else:
            self._died(code, now_s)

    def _died(self, code: int, now_s: float) -> None:
        how = f"by signal {-code}" if code < 0 else f"with code {code}, see loop.log"
        while self.restarts and now_s - self.restarts[0] > self.options.within_s:
            self.restarts.popleft()
        if len(self.restarts) >= self.options.restarts:
            self.state = RunState.FAILED
            self.sentence = (
                f"its process ended {how}, after {len(self.restarts)} restarts in "
                f"{self.options.within_s:.0f} s; {self._said_of_heaters()}"
            )
            return
        self.restarts.append(now_s)
        self.restarted += 1
        self.state, self.start_at_s = RunState.WAITS, now_s + BACK_OFF_S
        self.sentence = f"its process ended {how}; it is gone on with"

    def _said_of_heaters(self) -> str:
        """The last that the process told of its printer, since it was started."""
        with (self.folder / LOG).open("rb") as log:
            log.seek(max(self.log_bytes, log.seek(0, os.SEEK_END) - LOG_TAIL_BYTES))
            lines = log.read().decode("utf-8", "replace").splitlines()
        told = [
            line for line in lines if line.startswith("printer: ") and "heaters" in line.lower()
        ]
        if not told:
            return "nothing was said of its heaters: see that they are off"
        return told[-1].removeprefix("printer: ")

    def answer(self, number: int, *, yes: bool) -> bool:
        """Answer a question; False where it is not asked any more."""
        question = self.status.get("question")
        if self.state is not RunState.ASKS or not question or question["number"] != number:
            return False
        if number == self.answered:  # the first word counts
            return False
        self.answered = number
        answer(self.folder / DESK, number, yes=yes)
        return True

    def stop(self, now_s: float) -> bool:
        """End its run: nozzle lifted, heaters off; False where nothing runs."""
        if self.orphan:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.orphan, signal.SIGTERM)
            return True
        if self.process is None:
            if self.state is RunState.WAITS:
                self.state, self.sentence = RunState.STOPPED, "stopped before it was started again"
                return True
            return False
        if not self.stopping:
            self.stopping, self.killed_at_s = True, now_s
            self.process.send_signal(signal.SIGTERM)
        return True

    def go_on(self, now_s: float) -> bool:
        """Go on with a run that was stopped or failed; False where there is none."""
        if self.state not in (RunState.STOPPED, RunState.FAILED):
            return False
        self.restarts.clear()
        self.state, self.sentence, self.start_at_s = RunState.WAITS, "", now_s
        return True


def _is_ours(pid: int, folder: Path) -> bool:
    """Whether a process is a loop that works in the folder."""
    if pid <= 0 or pid == os.getpid():
        return False
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        gone = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return False
    return not gone and str(folder / DESK).encode() in words


class Fleet:
    """All printers; one thread steps, others may ask, answer and stop.

    Parameters
    ----------
    command
        What is started for a printer; `loop_command` unless told otherwise.
    """

    def __init__(
        self,
        config: FleetConfig,
        *,
        command: Command = loop_command,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.options = config.options
        self.notes: list[str] = []  # for whoever started it
        self._clock = clock
        self._judges: Judges | None = None
        self._mutex = threading.RLock()
        out = config.options.out.absolute()
        self.seats = {
            spec.name: Seat(spec, out / spec.name, config.options, command)
            for spec in config.printers
        }
        for seat in self.seats.values():
            seat.begin(clock())

    @contextmanager
    def alone(self) -> Iterator[None]:
        """One supervisor a folder; its printers may ask its judges as long as it is there."""
        self.options.out.mkdir(parents=True, exist_ok=True)
        with (self.options.out / ".lock").open("w") as stream:
            if not try_lock(stream.fileno()):
                raise InputError(
                    f"another fleet works in {self.options.out}; end it or name another out"
                )
            self._judges = self._hired()
            try:
                yield
            finally:
                self._let_go()

    @property
    def over(self) -> bool:
        """Whether nothing runs, or will by itself."""
        return all(seat.state in OVER for seat in self.seats.values())

    def step(self) -> None:
        """Look at every printer once."""
        with self._mutex:
            for seat in self.seats.values():
                seat.step(self._clock())
            if self._judges is not None and (why := self._judges.step(self._clock())):
                self.notes.append(why)
                self._let_go()

    def _hired(self) -> Judges | None:
        """The shared processes that detect, and a note on every desk that says where they are."""
        if self.options.judges == 0:
            return None
        judges = Judges(
            self.options.judges,
            asking=len(self.seats),
            within_s=self.options.judged_within_s,
            restarts=self.options.restarts,
            restarts_within_s=self.options.within_s,
        )
        for seat in self.seats.values():
            (seat.folder / DESK).mkdir(parents=True, exist_ok=True)
            write_note(seat.folder / DESK / JUDGES, judges.note)
        return judges

    def _let_go(self) -> None:
        for seat in self.seats.values():
            (seat.folder / DESK / JUDGES).unlink(missing_ok=True)
        if self._judges is not None:
            self._judges.close()
            self._judges = None

    def told(self) -> list[dict[str, Any]]:
        """What the page shows."""
        with self._mutex:
            return [_row(seat) for seat in self.seats.values()]

    def do(self, name: str, what: str, number: int = 0) -> bool:
        """Carry out what somebody pressed: approve, skip, stop or resume."""
        with self._mutex:
            seat = self.seats.get(name)
            if seat is None:
                return False
            if what in ("approve", "skip"):
                return seat.answer(number, yes=what == "approve")
            if what == "stop":
                return seat.stop(self._clock())
            return what == "resume" and seat.go_on(self._clock())

    def end(self, sleep: Callable[[float], None] = time.sleep) -> None:
        """Stop every run, and return when all processes have ended."""
        for seat in self.seats.values():
            with self._mutex:
                if seat.state not in OVER and not seat.orphan:
                    seat.stop(self._clock())
        while any(seat.process is not None for seat in self.seats.values()):
            self.step()
            sleep(0.1)


def _row(seat: Seat) -> dict[str, Any]:
    status = seat.status
    total = float(status.get("total") or 0.0)
    return {
        "name": seat.spec.name,
        "port": seat.spec.port,
        "part": seat.spec.part or seat.spec.job.stem,
        "state": str(seat.state),
        "sentence": seat.sentence,
        "stage": status.get("stage", ""),
        "share": float(status.get("done") or 0.0) / total if total > 0 else 0.0,
        "question": status.get("question") if seat.state is RunState.ASKS else None,
        "restarts": seat.restarted,
        "judged": status.get("judged") or {"shared": 0, "itself": 0, "why": ""},
        "pid": seat.process.pid if seat.process is not None else seat.orphan,
        "folder": str(seat.folder),
    }
