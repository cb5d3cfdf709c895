"""What printers behind a print server have in common, whichever server it is.

One session with its push socket and its news; one print: uploaded, started, followed, made safe
where that goes wrong. How a server is asked, and what its news mean, is in `octoprint` and
`moonraker`.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Literal, Protocol, Self, TypeVar, runtime_checkable

from gcode.errors import LinkError, LocalProtocolError, PortBusyError
from gcode.hosts.lock import PortLock
from gcode.hosts.port import (
    LinkLostError,
    PrintableProgram,
    Printer,
    PrintReport,
    PrintsOnError,
)
from gcode.hosts.proof import require_arcs, require_checked
from gcode.hosts.secret import ApiKey
from gcode.hosts.unknown import UnknownCommands
from gcode.hosts.upload import JobFile, part_prefix
from gcode.hosts.web import Address, PushSocket, WebClient, WebLog, WebTiming, heaters_word
from gcode.progress import Progress, silent

_log = logging.getLogger(__name__)
LOOK_EVERY = 5
"""Waits without an end after which the job is asked for, in case that its news did not come."""


@runtime_checkable
class News(Protocol):
    """The state of a server, as its messages tell it."""

    moved: bool
    file_position: int
    unknown: UnknownCommands

    @property
    def ended(self) -> bool:
        """Whether the followed print is over."""

    def follow(self, file: str) -> None:
        """Follow the print of a file from now on."""

    def take(self, message: Any) -> None:
        """Take one message."""


@dataclass(frozen=True, slots=True)
class ServerReach:
    """A server and how it is reached; no log where none is kept."""

    address: Address
    key: ApiKey
    timing: WebTiming
    clock: Callable[[], float]
    log: WebLog | None


State = TypeVar("State", bound=News)
Answer = TypeVar("Answer")


class ServerSession(ABC, Generic[State]):
    """One login to a server and the socket that its news come over.

    Attributes
    ----------
    web
        What HTTP requests go by.
    news
        Notified whenever `state` may have changed; hold it to read several fields at once.
    """

    def __init__(self, reach: ServerReach, state: State) -> None:
        self.address = reach.address
        self.state = state
        self.news = threading.Condition()
        self._key, self._timing = reach.key, reach.timing
        self._clock, self._log = reach.clock, reach.log
        self.web = WebClient(reach.address, reach.key, reach.timing, reach.log)
        self._socket: PushSocket | None = None

    def close(self) -> None:
        """Hang up."""
        self._hang_up()
        self.web.close()

    @property
    def listening(self) -> bool:
        """Whether news can reach us."""
        return self._socket is not None and self._socket.alive

    @property
    def is_told(self) -> bool:
        """Whether what is known of the print is kept up to date by news."""
        return self.listening

    @abstractmethod
    def listen(self) -> None:
        """Open the push socket, anew where there was one."""

    @abstractmethod
    def _logged(self, message: dict[str, Any]) -> str:
        """What the wire log shows of a message."""

    def _open_socket(self, path: str, headers: dict[str, str]) -> PushSocket:
        """A push socket in the place of the last one."""
        self._hang_up()
        self._socket = PushSocket(
            self.address,
            path,
            headers=headers,
            timing=self._timing,
            on_message=self._on_message,
            on_closed=self._on_closed,
        )
        return self._socket

    def _hang_up(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _on_message(self, message: Any) -> None:
        if self._log is not None and isinstance(message, dict):
            self._log.add(b"<", self._logged(message))
        with self.news:
            self.state.take(message)
            self.news.notify_all()

    def _on_closed(self) -> None:
        with self.news:
            self.news.notify_all()


Session = TypeVar("Session", bound=ServerSession[Any])


@dataclass(frozen=True, slots=True)
class Left:
    """What became of a part of a job that nobody followed to its end.

    Attributes
    ----------
    ended_s
        When it ended, s since 1970; None where the server does not say.
    """

    name: str
    state: Literal["waiting", "printing", "done", "failed"]
    ended_s: float | None = None


class ServerPrinter(Printer, ABC, Generic[Session]):
    """A printer that a server drives.

    Parameters
    ----------
    address
        The server.
    key
        API key; none where the server trusts this machine.
    wire_log
        File for requests and news, with times; it never holds the key.
    """

    files: str
    """Path of the uploaded files on the server."""

    def __init__(
        self,
        address: Address,
        key: ApiKey,
        *,
        wire_log: Path | None = None,
        timing: WebTiming | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.address = address
        self._key = key
        self._timing = timing or WebTiming()
        self._clock = clock
        self._wire_log = wire_log
        self._log: WebLog | None = None
        self._lock = PortLock(address.spec)
        self._tried_safety = False
        self._open: Session | None = None
        self._spent = ""  # the last part's file: it tells whoever comes after us how that ended

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if error is not None and not self._tried_safety:
                self._make_safe(error)
        finally:
            self.close()

    # ------------------------------------------------------------------ connection

    def connect(self) -> None:
        """Reach the server, open its push socket, refuse a printer that is not ready."""
        self._reach(self._refuse_unless_ready)

    def _reach(self, ready: Callable[[], None]) -> None:
        if self._open is not None:
            return
        self._lock.acquire()
        try:
            self._log = WebLog(self._wire_log) if self._wire_log else None
            self._open = self._new_session(
                ServerReach(self.address, self._key, self._timing, self._clock, self._log)
            )
            self._greet(ready)
        except BaseException:
            self.close()
            raise

    def rejoin(
        self, checked: PrintableProgram, lines: range, *, progress: Progress = silent
    ) -> tuple[PrintReport | None, float | None]:
        """Connect to a server that was left while it printed these lines, and follow their print.

        Returns
        -------
        The print's report, None where it was never begun; and when it ended, s since 1970, where
        that is known and was not just now.

        Raises
        ------
        PortBusyError
            If something else is being printed.
        """
        require_checked(checked)
        start_s, self._tried_safety = self._clock(), False
        job = JobFile.of(checked, lines)
        self._reach(lambda: None)
        left = self._left(part_prefix(checked, job.first, job.end))
        if left is None or left.state != "printing":
            self._refuse_unless_ready()
        if left is None:
            return None, None
        job = replace(job, name=left.name)
        if left.state == "waiting":
            self._delete(job.name)
            return None, None
        if left.state != "printing":
            self._spent = job.name
            return self._report(checked, job, start_s, ok=left.state == "done"), left.ended_s
        self._session.state.follow(job.name)
        return self._watched(checked, job, start_s, progress, part=True), None

    def close(self) -> None:
        """Let go of the server; a print under way goes on there."""
        if self._open is not None:
            with contextlib.suppress(LinkError):
                self._delete(self._spent)
            self._spent = ""
            self._open.close()
            self._open = None
        self._lock.release()
        if self._log is not None:
            self._log.close()
            self._log = None

    @property
    def _session(self) -> Session:
        if self._open is None:
            raise LocalProtocolError("The printer is not connected; call connect() first.")
        return self._open

    @abstractmethod
    def _new_session(self, reach: ServerReach) -> Session:
        """A session, not yet listening."""

    @abstractmethod
    def _greet(self, ready: Callable[[], None]) -> None:
        """See that it is the right server and its printer is `ready`, and listen."""

    @abstractmethod
    def _left(self, prefix: str) -> Left | None:
        """What became of the part whose file's name begins so; None where there is none."""

    @abstractmethod
    def motors_held(self) -> bool:
        """Whether the nozzle is where the firmware believes it is, as far as the server knows."""

    @abstractmethod
    def command(self, text: str) -> None:
        """Have one command of the host's own carried out."""

    @abstractmethod
    def _refuse_unless_ready(self) -> None:
        """Raise where the printer cannot take a print."""

    # ------------------------------------------------------------------ printing

    def print(
        self,
        checked: PrintableProgram,
        *,
        lines: range | None = None,
        progress: Progress = silent,
    ) -> PrintReport:
        """Upload a program or a part of it, have it printed, return when it is done."""
        require_checked(checked)
        start_s, self._tried_safety = self._clock(), False
        self._refuse_unless_ready()
        require_arcs(checked, self.capabilities)
        job = JobFile.of(checked, lines)
        self._upload(job)
        self._delete(self._spent)
        self._spent = ""
        return self._watched(
            checked, job, start_s, progress, part=lines is not None, begin=self._start
        )

    def _watched(
        self,
        checked: PrintableProgram,
        job: JobFile,
        start_s: float,
        progress: Progress,
        *,
        part: bool,
        begin: Callable[[JobFile], None] = lambda job: None,
    ) -> PrintReport:
        """Begin a print, follow it to its end; a part of a job leaves its file to tell of it."""
        try:
            begin(job)
            ok = self._follow(job, progress)
        except PortBusyError:
            raise  # somebody else was first: nothing of ours is under way
        except BaseException as error:  # an interrupt, too: the server would print on by itself
            self._make_safe(error)
            raise
        if ok:
            progress("printing", 1.0, 1.0)
        if part:
            self._spent = job.name
        else:
            self._delete(job.name)
        return self._report(checked, job, start_s, ok=ok)

    def _delete(self, name: str) -> None:
        """Take a file off the server; refused if it is held: harmless."""
        if name:
            self._session.web.request("DELETE", f"{self.files}/{name}")

    def _report(
        self, checked: PrintableProgram, job: JobFile, start_s: float, *, ok: bool
    ) -> PrintReport:
        next_line, acked, resends = self._reached(checked, job, ok=ok)
        return PrintReport(
            ok=ok,
            lines_acked=acked,
            resends=resends,
            bytes_sent=len(job.data),
            seconds=self._clock() - start_s,
            next_line=next_line,
            first_line=job.first,
            warnings=(
                *self._session.state.unknown.told,
                *(() if ok else (f"{self.address.name} cancelled the print",)),
            ),
        )

    @abstractmethod
    def _upload(self, job: JobFile) -> None:
        """Put the file on the server, and have it compared."""

    @abstractmethod
    def _start(self, job: JobFile) -> None:
        """Have the print begin."""

    def _follow(self, job: JobFile, progress: Progress) -> bool:
        """Wait for the print's end; False if it was cancelled."""
        session, state = self._session, self._session.state
        looked_s = self._clock()
        while True:
            with session.news:
                session.news.wait_for(
                    lambda: (
                        state.ended or state.moved or state.unknown.fault or not session.is_told
                    ),
                    self._timing.poll_s,
                )
                state.moved = False
                ended = state.ended
            progress("printing", float(state.file_position), float(len(job.data)))
            if state.unknown.fault is not None:
                raise state.unknown.fault
            if ended:
                return self._outcome(job)
            if session.is_told and self._clock() - looked_s < LOOK_EVERY * self._timing.poll_s:
                continue
            self._look(job)
            looked_s = self._clock()

    @abstractmethod
    def _outcome(self, job: JobFile) -> bool:
        """How a print ended that is over; False if it was cancelled."""

    @abstractmethod
    def _look(self, job: JobFile) -> None:
        """Ask what became of the print, in case that its news did not reach us."""

    @abstractmethod
    def _reached(
        self, checked: PrintableProgram, job: JobFile, *, ok: bool
    ) -> tuple[int, int, int]:
        """After a print: the next line, lines acknowledged, resends."""

    @abstractmethod
    def _uncertain(self, job: JobFile) -> str:
        """Which lines may have been carried out, in words."""

    def wait(self, wait_s: float) -> None:
        """Until there is news, or so long."""
        with self._session.news:
            self._session.news.wait(wait_s)

    def _patiently(self, job: JobFile, ask: Callable[[], Answer]) -> Answer:
        """Ask what became of the print; a server that went away gets time to come back.

        Raises
        ------
        LinkLostError
            If it does not: its printer may be printing on by itself.
        """
        until_s = self._clock() + self._timing.lost_s
        while True:
            try:
                return ask()
            except LinkError as error:
                if self._clock() > until_s:
                    raise self._lost(job, f"{error} It may be printing on by itself") from error
            self.wait(self._timing.poll_s)

    def _lost(self, job: JobFile, why: str) -> LinkLostError:
        return LinkLostError(
            f"The print on {self.address.name} is lost: {why}; {self._uncertain(job)}.",
            job.first - 1,
            job.end - 1,
        )

    # ------------------------------------------------------------------ safety

    def abort(self) -> None:
        """Cancel our print, heaters off, nozzle lifted; harmless when not connected.

        Raises
        ------
        PortBusyError
            If another's print is under way, which is left alone.
        PrintsOnError
            If ours cannot be cancelled: its heaters are told to switch off all the same.
        """
        if self._open is None:
            return
        uncancelled = None
        try:
            if not self._cancel():
                return
        except PortBusyError:
            raise
        except LinkError as error:
            uncancelled = error
        self.heaters_off()
        if uncancelled is not None:
            raise PrintsOnError(
                f"Heaters were told to switch off, BUT ITS PRINT GOES ON ({uncancelled}) and may "
                "heat them again: stop it there, or switch the printer off."
            ) from uncancelled
        self._lift()

    @abstractmethod
    def _cancel(self) -> bool:
        """Cancel our print and see it at rest; False where everything is off already.

        Raises
        ------
        PortBusyError
            If another's print is under way.
        """

    @abstractmethod
    def _lift(self) -> None:
        """Lift the nozzle, where that can be."""

    @abstractmethod
    def _refuse_anothers(self) -> None:
        """Raise PortBusyError where another's print is under way."""

    def _cools_ours(self) -> None:
        """Refuse to cool another's print; where nobody tells whose it is, it passes for ours."""
        try:
            self._refuse_anothers()
        except PortBusyError:
            raise
        except LinkError:
            pass

    def _anothers(self, file: str) -> PortBusyError:
        return PortBusyError(
            f"{self.address.name} is printing {file!r}, which is not ours: it was neither "
            "cancelled nor cooled."
        )

    def _make_safe(self, error: BaseException) -> None:
        """Make safe what can be reached, and add to the error how that went."""
        try:
            self.abort()
            word = heaters_word(self.temperatures)
        except (PrintsOnError, PortBusyError) as second:
            word = str(second)
        except (LinkError, LocalProtocolError) as second:
            word = f"HEATERS COULD NOT BE REACHED ({second}): switch the printer off."
        self._tried_safety = True
        if isinstance(error, LinkError):
            error.args = (f"{error.args[0]} {word}", *error.args[1:])
        else:
            _log.warning("printer: %s", word)  # an interrupt has no words of its own
