"""A printer behind an OctoPrint server: REST for what is asked for, the push socket for news.

OctoPrint holds the wire: it numbers, resends and waits, and it prints on by itself when we are
gone. This adapter uploads a program, has it printed, and tells truthfully how that ended. Parking
in a pause is left to the server's own pause script, which knows where its queue stands.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from gcode.errors import LinkError, LocalProtocolError, PortBusyError, PrinterError
from gcode.hosts.lock import PortLock
from gcode.hosts.octoprint_session import OctoPrintSession
from gcode.hosts.port import (
    Capabilities,
    LinkLostError,
    PrintableProgram,
    PrintReport,
    Temperatures,
)
from gcode.hosts.proof import require_checked
from gcode.hosts.safety import SAFE_COMMANDS
from gcode.hosts.secret import ApiKey
from gcode.hosts.upload import JobFile
from gcode.hosts.web import (
    LIFT_COMMANDS,
    Address,
    WebLog,
    WebTiming,
    heaters_word,
    sentence,
)
from gcode.progress import Progress, silent
from gcode.protocol import events as ev

_FILES = "/api/files/local"
LOOK_EVERY = 5
"""Waits without an end after which the job is asked for, in case that its news did not come."""


class OctoPrintPrinter:
    """A printer that an OctoPrint server drives.

    Parameters
    ----------
    address
        The server.
    key
        API key of a user who may print, control and see the terminal.
    wire_log
        File for requests and news, with times; it never holds the key.
    """

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
        self._open: OctoPrintSession | None = None
        self._capabilities: Capabilities | None = None

    def __enter__(self) -> OctoPrintPrinter:
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
        if self._open is not None:
            return
        self._lock.acquire()
        try:
            self._log = WebLog(self._wire_log) if self._wire_log else None
            self._open = OctoPrintSession(
                self.address, self._key, self._timing, self._clock, self._log
            )
            if "Moonraker" in str(self._open.get("/api/version").get("text")):
                raise LinkError(
                    f"{self.address.base} is a Moonraker that answers as OctoPrint; write "
                    f"moonraker+{self.address.base}."
                )
            self._refuse_unless_ready()
            self._open.listen()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let go of the server; a print under way goes on there."""
        if self._open is not None:
            self._open.close()
            self._open = None
        self._lock.release()
        if self._log is not None:
            self._log.close()
            self._log = None

    @property
    def _session(self) -> OctoPrintSession:
        if self._open is None:
            raise LocalProtocolError("The printer is not connected; call connect() first.")
        return self._open

    # ------------------------------------------------------------------ questions

    def _refuse_unless_ready(self) -> None:
        flags = self._session.status()["state"]["flags"]
        self._session.state.flags = dict(flags)
        if any(flags.get(name) for name in ("printing", "paused", "pausing", "cancelling")):
            name, percent = self._session.printing()
            raise PortBusyError(
                f"{self.address.name} is printing {name!r} already ({percent:.0f} %); wait for it, "
                f"or cancel it there."
            )

    def capabilities(self) -> Capabilities:
        """Return what the firmware says of itself (M115), asked for once."""
        if self._capabilities is None:
            firmware, caps = "", {}
            for reply in self._session.ask("M115"):
                if isinstance(reply, ev.FirmwareInfo):
                    firmware = reply.name
                elif isinstance(reply, ev.Capability):
                    caps[reply.name] = reply.enabled
            self._capabilities = Capabilities(firmware, caps)
        return self._capabilities

    def temperatures(self) -> Temperatures:
        """Return the temperatures that OctoPrint polls; ask (M105) where it has none yet."""
        heaters = self._session.status().get("temperature", {})
        pairs = {
            name: (heater.get("actual"), heater.get("target"))
            for name, heater in heaters.items()
            if isinstance(heater, dict)
        }
        if pairs.get("tool0", (None,))[0] is None:
            for reply in self._session.ask("M105"):
                if isinstance(reply, ev.TemperatureReport):
                    names = {"T": "tool0", "T0": "tool0", "B": "bed"}
                    for name, heater in reply.heaters.items():
                        pairs[names.get(name, name)] = (heater.current_c, heater.target_c)
        hotend_c, hotend_target_c = pairs.get("tool0", (None, None))
        bed_c, bed_target_c = pairs.get("bed", (None, None))
        if hotend_c is None:
            raise LinkError(f"The printer of {self.address.name} reports no hotend temperature.")
        return Temperatures(
            float(hotend_c),
            float(hotend_target_c or 0.0),
            float(bed_c) if bed_c is not None else None,
            float(bed_target_c or 0.0) if bed_c is not None else None,
        )

    def position_mm(self) -> tuple[float, float, float]:
        """Ask for the logical position (M114), read from the server's terminal."""
        for reply in self._session.ask("M114"):
            if isinstance(reply, ev.PositionReport):
                return reply.x_mm, reply.y_mm, reply.z_mm
        raise LinkError(f"The printer of {self.address.name} does not answer M114.")

    def finish_moves(self) -> None:
        """Return when every buffered move has been made (M400)."""
        self._session.ask("M400", wait_s=None)

    def command(self, text: str) -> None:
        """Send one command of the host's own, and wait for its `ok`."""
        self._session.ask(text)

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
        job = JobFile.of(checked, lines)
        self._upload(job)
        resends = self._session.state.resends
        self._start(job)
        try:
            ok = self._follow(job, progress)
        except BaseException as error:  # an interrupt, too: the server would print on by itself
            self._make_safe(error)
            raise
        if ok:
            progress("printing", 1.0, 1.0)
        self._session.request("DELETE", f"{_FILES}/{job.name}")  # 409 where it is held: harmless
        return PrintReport(
            ok=ok,
            lines_acked=job.commands if ok else 0,
            resends=max(0, self._session.state.resends - resends),
            stalls=0,
            spare_oks=0,
            bytes_sent=len(job.data),
            seconds=self._clock() - start_s,
            next_line=job.end if ok else job.first,
            round_trip_s=(0.0, 0.0, 0.0),
            warnings=() if ok else (f"{self.address.name} cancelled the print",),
        )

    def _upload(self, job: JobFile) -> None:
        """Put the file on the server and compare what lies there."""
        answer = self._session.request(
            "POST", _FILES, files={"file": (job.name, job.data)}, timeout_s=self._timing.upload_s
        )
        if answer.status_code != 201:
            raise LinkError(
                f"{self.address.name} does not take the file ({sentence(answer)}); is its disk "
                f"full?"
            )
        there = self._session.get(f"{_FILES}/{job.name}")
        size, digest = there.get("size"), there.get("hash")
        if size != len(job.data) or digest not in {None, job.sha1}:
            raise LinkError(
                f"{self.address.name} holds another file than was sent ({size} bytes of "
                f"{len(job.data)}); a plugin may alter uploads: switch it off."
            )

    def _start(self, job: JobFile) -> None:
        self._session.state.follow(job.name)
        try:
            answer = self._session.request(
                "POST", f"{_FILES}/{job.name}", json={"command": "select", "print": True}
            )
        except LinkError as error:
            raise self._lost(job, f"whether it began is not known: {error}") from error
        if answer.status_code == 409:
            raise PortBusyError(
                f"{self.address.name} does not start the print ({sentence(answer)}); somebody "
                f"else uses it."
            )
        if answer.status_code != 204:
            raise LinkError(f"{self.address.name} does not start the print ({sentence(answer)}).")

    def _follow(self, job: JobFile, progress: Progress) -> bool:
        """Wait for the print's end; False if it was cancelled."""
        session, state, looked_s = self._session, self._session.state, self._clock()
        while True:
            with session.news:
                session.news.wait_for(
                    lambda: state.ended or state.moved or not session.listening,
                    self._timing.poll_s,
                )
                state.moved = False
                ended, outcome = state.ended, state.outcome or "PrintFailed"
            progress("printing", float(state.file_position), float(len(job.data)))
            if ended:
                return self._outcome(job, outcome)
            if session.listening and self._clock() - looked_s < LOOK_EVERY * self._timing.poll_s:
                continue
            self._look(job)
            looked_s = self._clock()

    def _outcome(self, job: JobFile, outcome: str) -> bool:
        if outcome == "PrintFailed":
            state, lines = self._session.state, self._uncertain(job)
            if state.error:
                raise PrinterError(
                    f"{self.address.name} reports a fault of its printer: {state.error}; {lines}."
                )
            raise self._lost(job, f"it lost its printer ({state.trouble})")
        return outcome == "PrintDone"

    def _look(self, job: JobFile) -> None:
        """Ask what became of the print, in case that its news did not reach us.

        A server that went away prints on by itself, or has forgotten: it gets time to come back.
        """
        until_s = self._clock() + self._timing.lost_s
        while True:
            try:
                known = self._session.look()
                break
            except LinkError as error:
                if self._clock() > until_s:
                    raise self._lost(job, f"{error} It may be printing on by itself") from error
            with self._session.news:
                self._session.news.wait(self._timing.poll_s)
        if not known:
            text = self._session.state.text
            raise self._lost(job, f"it no longer prints the file (its state is {text!r})")

    def _uncertain(self, job: JobFile) -> str:
        read = self._session.state.file_position
        return (
            f"lines {job.first + 1} to {job.end} are uncertain (it had read up to line "
            f"{job.line_at(read) + 1})"
        )

    def _lost(self, job: JobFile, why: str) -> LinkLostError:
        return LinkLostError(
            f"The print on {self.address.name} is lost: {why}; {self._uncertain(job)}.",
            job.first - 1,
            job.end - 1,
        )

    # ------------------------------------------------------------------ pause, abort, stop

    def pause(self) -> None:
        """Have OctoPrint pause, which parks the nozzle if its pause script does."""
        self._job({"command": "pause", "action": "pause"}, "pause")

    def resume(self) -> None:
        """Have OctoPrint go on."""
        self._job({"command": "pause", "action": "resume"}, "resume")

    def _job(self, command: dict[str, str], what: str) -> None:
        answer = self._session.request("POST", "/api/job", json=command)
        if answer.status_code != 204:
            raise LinkError(f"{self.address.name} does not {what} ({sentence(answer)}).")

    def abort(self) -> None:
        """Cancel the print, heaters off, nozzle lifted; harmless when not connected."""
        if self._open is None:
            return
        answer = self._session.request("POST", "/api/job", json={"command": "cancel"})
        if answer.status_code == 204:
            self._await_rest()
        self.heaters_off()
        self._session.command(*LIFT_COMMANDS)

    def _await_rest(self) -> None:
        until_s = self._clock() + self._timing.answer_s
        while any(
            self._session.status()["state"]["flags"].get(f) for f in ("printing", "cancelling")
        ):
            if self._clock() > until_s:
                raise LinkError(
                    f"{self.address.name} has not cancelled the print within "
                    f"{self._timing.answer_s:g} s; stop the printer there."
                )
            with self._session.news:
                self._session.news.wait(0.1)

    def emergency_stop(self) -> None:
        """Have M112 sent past the queue; the printer must be reset afterwards."""
        self._session.command("M112")

    def heaters_off(self) -> None:
        """Switch hotend, bed and fan off, acknowledged."""
        self._session.ask(*SAFE_COMMANDS)

    def _make_safe(self, error: BaseException) -> None:
        """Make safe what can be reached, and add to the error how that went."""
        try:
            self.abort()
            word = heaters_word(self.temperatures)
        except (LinkError, LocalProtocolError) as second:
            word = f"HEATERS COULD NOT BE REACHED ({second}): switch the printer off."
        self._tried_safety = True
        if isinstance(error, LinkError):
            error.args = (f"{error.args[0]} {word}", *error.args[1:])
        else:
            error.add_note(word)
