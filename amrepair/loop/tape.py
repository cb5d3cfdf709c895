"""The tape of a run: what was sent, seen and decided, written ahead of the wire.

One JSON object a line in `run.jsonl`, each on the disk before what it says begins. A run that was
killed is gone on with by running the same loop over its tape: what the tape has is not done again.
A replay is the same, and ends with the tape. A line that a kill cut short was never begun.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from amrepair.errors import InputError, LoopError
from amrepair.scans import Scan, read_scan
from gcode.check import CheckedProgram
from gcode.hosts.port import PrintReport
from gcode.locks import try_lock

TAPE = "run.jsonl"
LOOK_EVENTS = ("look", "no_look")
TOUCH = "touch"
REST = "rest"
"""Kind of what is sent to feel; the tape has where each touch met something."""
FELT = "felt"
"""A scanner that has the printer move has done so: its scan follows from what is on the tape."""
ANEW = "anew"
"""In place of a look that ended a run, where its moves are on the tape: they are made anew."""


class TapeEndsError(LoopError):
    """A replay has come to the end of what was recorded."""


def scan_name(number: int) -> str:
    """Name of the file that a look's scan is kept in."""
    return f"scan-{number}.ply"


@dataclass(frozen=True, slots=True)
class Sent:
    """Lines [first, end) of a program, sent or about to be."""

    kind: str
    checked: CheckedProgram
    first: int
    end: int
    done: bool


class Tape:
    """What a run remembers; without a path it remembers nothing and costs nothing.

    Parameters
    ----------
    path
        The run's folder, where there is one.
    only_read
        Nothing is written, and nothing happens beyond the tape's end (`TapeEndsError`).
    clock
        Wall clock, s since 1970.
    """

    def __init__(
        self,
        path: Path | None = None,
        *,
        only_read: bool = False,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.path = path
        self.only_read = only_read
        self._clock = clock
        self._events = [] if path is None else read_events(path)
        if only_read:  # what was sent follows from what was seen and answered
            self._events = [e for e in self._events if e.get("event") in LOOK_EVENTS]
        self._at = 0
        self._fd: int | None = None

    @property
    def live(self) -> bool:
        """Whether all that was recorded has been gone through."""
        return self._at >= len(self._events)

    def next(self, event: str) -> dict[str, Any] | None:
        """The next thing recorded, which must be of this kind; None at the tape's end.

        Raises
        ------
        LoopError
            If something else was recorded: the tape does not belong to this run.
        TapeEndsError
            At the end of a tape that is only read.
        """
        if self.live:
            if self.only_read:
                raise TapeEndsError("the record ends here")
            return None
        found = self._events[self._at]
        if found.get("event") != event:
            raise LoopError(
                f"the record {self.path} has '{found.get('event')}' where this run comes to "
                f"'{event}'; it is of another job, other stops or another version"
            )
        self._at += 1
        return found

    def next_if(self, event: str) -> dict[str, Any] | None:
        """The next thing recorded if it is of this kind."""
        return self.next(event) if self.peek() == event else None

    def scan(self, number: int, frame: str) -> Scan:
        """The scan of a recorded look."""
        assert self.path is not None
        return read_scan(self.path / scan_name(number), frame=frame)

    def labels(self) -> list[str]:
        """Labels of the stops that were looked at, in order, one for every look."""
        return [str(e["stop"]) for e in self._events if e.get("event") in LOOK_EVENTS]

    def next_stop(self) -> str | None:
        """The label of the stop of the next recorded look."""
        return None if self.live else str(self._events[self._at].get("stop"))

    def peek(self) -> str | None:
        """What kind of event comes next."""
        return None if self.live else str(self._events[self._at].get("event"))

    def reopen(self) -> None:
        """A run that a decision has ended is to go on: its last look is taken anew.

        Raises
        ------
        InputError
            If it was printed to its end, nothing was recorded, or another command is at it.
        """
        if not self._events:
            raise InputError(f"{self.path} has no record of a run; name the folder of one")
        self.hold()
        last = self._events[-1]
        if last.get("event") != "end":
            return
        if not last.get("stopped"):
            self.close()
            raise InputError(
                f"the run in {self.path} was printed to its end; there is nothing left"
            )
        self.write("reopened")
        self._events = _before_the_end(self._events)

    def hold(self, *, anew: bool = False) -> None:
        """Keep the record for this run alone until it is closed; `anew`: what it has is forgotten.

        Raises
        ------
        InputError
            If another command is at this run: two would send what each of them alone remembers.
        LoopError
            If it cannot be written.
        """
        if self.path is None or self.only_read or self._fd is not None:
            return
        with self._told():
            self._fd = self._open(self.path / TAPE)
            if anew:
                os.ftruncate(self._fd, 0)
        self._events = [] if anew else read_events(self.path)

    def write(self, event: str, **said: Any) -> None:
        """Put an event on the disk."""
        if self.path is None or self.only_read:
            return
        line = json.dumps({"event": event, "time_s": round(self._clock(), 3), **said})
        with self._told():
            if self._fd is None:
                self._fd = self._open(self.path / TAPE)
            data = line.encode() + b"\n"
            while data:  # of a disk that is nearly full the first part is taken without a word
                data = data[os.write(self._fd, data) :]
            os.fsync(self._fd)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Within it, what the disk refuses is told; half a line is cut off at the next opening."""
        try:
            yield
        except OSError as error:
            self.close()
            raise LoopError(
                f"the record {self.path}/{TAPE} cannot be written ({error.strerror}); nothing is "
                "sent that is not on the disk"
            ) from error

    def _open(self, path: Path) -> int:
        path.parent.mkdir(parents=True, exist_ok=True)
        as_is = getattr(os, "O_BINARY", 0)  # Windows would end lines its own way
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | as_is, 0o644)
        if not try_lock(fd):
            os.close(fd)
            raise InputError(
                f"another command is at the run in {path.parent}; let it end, or name another "
                "folder"
            )
        kept = path.read_bytes()
        if not kept.endswith(b"\n"):  # cut short by a kill
            os.ftruncate(fd, kept.rfind(b"\n") + 1)
        return fd

    def close(self) -> None:
        """Let go of the file."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None


def read_events(folder: Path) -> list[dict[str, Any]]:
    """The events of a run's folder, oldest first; none where nothing was recorded.

    Raises
    ------
    InputError
        If the file is none of ours.
    """
    path = folder / TAPE
    if not path.is_file():
        return []
    lines = path.read_bytes().split(b"\n")[:-1]  # the last is empty, or was cut short
    try:
        events: list[dict[str, Any]] = []
        for line in lines:
            event = dict(json.loads(line))
            if event.get("event") == "reopened":  # it was ended by a question: look anew
                events = _before_the_end(events)
            else:
                events.append(event)
    except (ValueError, TypeError) as error:
        raise InputError(
            f"{path} is no record of a run ({error}); name the run's folder"
        ) from error
    return events


def _before_the_end(events: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What a run was before the look that ended it."""
    before = events[:-2]
    return [*before, {"event": ANEW}] if before and before[-1].get("event") == FELT else before


def report_from_json(said: dict[str, Any]) -> PrintReport:
    """A link's report as it stands on the tape (`asdict`), read back."""
    known = {field.name for field in fields(PrintReport)}
    values = {key: value for key, value in said.items() if key in known}
    for key in ("round_trip_s", "warnings"):
        values[key] = tuple(values.get(key, ()))
    return PrintReport(**values)
