"""A printer on a serial port or pseudo-terminal: prints programs, keeps the journal, exits safely.

It owns the lock, the supervisor and the job; the port and the questions are `conversation`'s, what
may be sent and what an answer means is `protocol.Link`'s.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from gcode.errors import JournalError, LinkError, LocalProtocolError, PrinterError
from gcode.hosts.conversation import SerialConversation
from gcode.hosts.jobbook import TEMPERATURE_EVERY_S, JobBook
from gcode.hosts.journal import Journal
from gcode.hosts.lock import PortLock
from gcode.hosts.modes import batches_of, modes_after
from gcode.hosts.port import LinkLostError, PrintableProgram, PrintReport
from gcode.hosts.proof import require_checked
from gcode.hosts.safety import SAFE_COMMANDS, Supervisor
from gcode.hosts.supervisor import make_safe
from gcode.hosts.telemetry import RoundTrips
from gcode.hosts.whereabouts import last_number
from gcode.progress import Progress, silent
from gcode.protocol import LinkTiming
from gcode.protocol import events as ev

PAUSE_LIFT_MM = 5.0
BATCH_LINES = 500
"""Lines made ready, and counted, at a time."""


class SerialPrinter(SerialConversation):
    """A printer behind a serial port.

    Parameters
    ----------
    port
        Device path.
    baud
        Speed of the port; a pseudo-terminal does not mind.
    window
        Lines under way at once; more than 1 only for firmware that buffers them.
    wire_log
        File for every byte either way, with times.
    journal
        Where the job's progress is written ahead of the wire.
    supervise
        Start the process that switches heaters off should this one be killed.
    guard
        Test on connecting that the firmware refuses wrong checksums and numbers, where its
        dialect says so; a firmware that fails is refused (`LinkError`).
    """

    def __init__(
        self,
        port: str,
        *,
        baud: int = 115200,
        dialect: str = "marlin",
        window: int = 1,
        wire_log: Path | None = None,
        journal: Journal | None = None,
        timing: LinkTiming | None = None,
        clock: Callable[[], float] = time.monotonic,
        supervise: bool = True,
        guard: bool = True,
    ) -> None:
        super().__init__(
            port,
            baud=baud,
            dialect=dialect,
            window=window,
            wire_log=wire_log,
            timing=timing,
            clock=clock,
        )
        self._journal = journal
        self._supervise = supervise
        self._guard = guard
        self._supervisor: Supervisor | None = None
        self._lock = PortLock(port)
        self._book = JobBook(self._link, journal, clock)
        self._round_trips = RoundTrips()
        self._pause_asked = threading.Event()
        self._go_on = threading.Event()
        self._attention = threading.Event()  # set with either of the two others
        self._abort_asked = threading.Event()
        self._printing = False
        self._ask_s = -math.inf if journal is not None else math.inf  # temperatures, when next
        self.actions: deque[str] = deque(maxlen=100)

    def __enter__(self) -> SerialPrinter:
        self.connect()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None:
            self.make_safe()
        self.close()

    # ------------------------------------------------------------------ connection

    def connect(self, *, before_hello: Callable[[int | None], None] | None = None) -> None:
        """Open the port, agree on line numbers and ask who is there.

        Parameters
        ----------
        before_hello
            Told the number of the last line that the printer has received (None: it does not
            say), before a hello makes it forget that; what it raises ends the attempt.
        """
        if self._serial is not None:
            return
        self._lock.acquire()
        try:
            self._open_port()
            if before_hello is not None:
                self._ask_number(before_hello)
            counted = self._journal is not None and self._link.dialect.verifies
            self._greet(self._journal.open_session() if self._journal and counted else 0)
            if self._guard and self._link.dialect.verifies:
                self._test_guard()
            self._learn()
            self._prove()  # from here on a silent reset cannot be taken for a resend request
        except BaseException:
            self.close()
            raise
        if self._supervise:
            self._supervisor = Supervisor(self._fd, self._lock.fd, self._journal_path())

    def _journal_path(self) -> Path | None:
        return self._journal.path if self._journal is not None else None

    def _ask_number(self, before_hello: Callable[[int | None], None]) -> None:
        number = None
        if self._link.dialect.verifies:
            try:
                number = last_number(
                    self._fd, timing=self._link.timing, clock=self._clock, note=self._log_wire
                )
            except OSError as error:
                raise LinkError(
                    f"{self.port} failed ({error}) when asked for its line number; check the "
                    f"printer and its cable."
                ) from error
        try:
            before_hello(number)
        except LinkError:
            self._note(make_safe(self._fd))
            raise

    def close(self) -> None:
        """Let go of the printer; heaters stay as they are (`make_safe` switches them off)."""
        if self._supervisor is not None:
            self._supervisor.stand_down()
            self._supervisor = None
        self._close_port()
        self._lock.release()

    # ------------------------------------------------------------------ questions

    @property
    def journal(self) -> Journal | None:
        """Where the job is written down."""
        return self._journal

    def _before_own_command(self) -> None:
        self._book.before_own_command()

    # ------------------------------------------------------------------ printing

    def print(
        self,
        checked: PrintableProgram,
        *,
        lines: range | None = None,
        progress: Progress = silent,
    ) -> PrintReport:
        """Print a checked program, or a part of it; return when all is acknowledged."""
        require_checked(checked)
        if self._serial is None:
            raise LocalProtocolError("The printer is not connected; call connect() first.")
        total = checked.program.text.count("\n") + 1
        first, end = (0, total) if lines is None else (lines.start, lines.stop)
        start_s = self._clock()
        before = (self._link.resends, self._stalls, self._link.spare_oks, self._bytes_sent)
        self._round_trips = RoundTrips()
        self._warnings.clear()
        self._abort_asked.clear()
        self._book.open(first, end)
        self._printing = True
        try:
            with self._mutex:
                whole = self._carry_out(checked, first, end, progress)
                if whole and end >= total:
                    self._book.finish()
        except (LinkError, LocalProtocolError):
            self._book.lost()
            self.make_safe()
            raise
        finally:
            self._printing = False
            if self._log is not None:
                self._log.flush()
        if not whole:
            self.make_safe()
        return PrintReport(
            ok=whole,
            lines_acked=self._book.lines_acked,
            resends=self._link.resends - before[0],
            stalls=self._stalls - before[1],
            spare_oks=self._link.spare_oks - before[2],
            bytes_sent=self._bytes_sent - before[3],
            seconds=self._clock() - start_s,
            next_line=end if whole else self._book.executed_line + 1,
            round_trip_s=self._round_trips.summary_s(),
            warnings=tuple(self._warnings),
            first_line=first,
        )

    def _note_temperatures(self, now_s: float) -> None:
        self._ask_s = now_s + TEMPERATURE_EVERY_S
        self._ask("M105")

    def _carry_out(
        self, checked: PrintableProgram, first: int, end: int, progress: Progress
    ) -> bool:
        """Stream, and prove that all has arrived; False if the job was aborted."""
        self._book.begin(checked, self.port)
        whole = self._stream(checked, first, end, progress)
        self._prove()
        self._book.proved()
        return whole

    def _stream(self, checked: PrintableProgram, first: int, end: int, progress: Progress) -> bool:
        """Send the lines; False if the job was aborted."""
        total = float(end - first)
        for indices, commands in batches_of(checked, first, end, BATCH_LINES):
            if indices:
                progress("printing", float(indices[0] - first), total)
                if not self._send_batch(checked, indices, commands):
                    return False
        while not self._link.idle:
            self._pump()
        progress("printing", total, total)
        return True

    def _send_batch(
        self, checked: PrintableProgram, indices: list[int], commands: list[str]
    ) -> bool:
        """Send some lines, each when there is room for it; False if the job was aborted."""
        link, clock, before_line, asked = (
            self._link,
            self._clock,
            self._book.before_line,
            self._asked,
        )
        trips_s: list[float] = []
        heard_s = clock()
        if heard_s >= self._ask_s:
            self._note_temperatures(heard_s)  # now, for lines made ready lose their numbers by it
        for index, line, command in zip(indices, link.prepare(commands), commands, strict=True):
            if self._attention.is_set() and not self._attend(checked, index):
                return False
            if heard_s >= self._ask_s:
                self._note_temperatures(heard_s)
            before_line(index)
            sent_s = clock()
            self._write(link.send(line, sent_s))
            if command[:4] in asked:
                asked[command[:4]] += 1
            if not link.ready:
                self._pump_ok()
                while not link.ready:
                    self._pump()
            heard_s = clock()
            trips_s.append(heard_s - sent_s)
        self._round_trips.add(trips_s)
        return True

    # ------------------------------------------------------------------ pause, abort, stop

    def pause(self) -> None:
        """Stop after the line under way and lift the nozzle; harmless when paused already."""
        self._go_on.clear()
        self._pause_asked.set()
        self._attention.set()

    def resume(self) -> None:
        """Go on after a pause."""
        self._pause_asked.clear()
        self._go_on.set()

    def abort(self) -> None:
        """End the job: nothing more is sent, heaters off, nozzle lifted."""
        self._abort_asked.set()
        self._attention.set()
        self._go_on.set()
        if not self._printing:
            self.make_safe()

    def _attend(self, checked: PrintableProgram, line: int) -> bool:
        """Do what was asked for meanwhile; False on abort."""
        self._attention.clear()
        if self._pause_asked.is_set() and not self._sit_out_pause(checked, line):
            return False
        return not self._abort_asked.is_set()

    def _sit_out_pause(self, checked: PrintableProgram, line: int) -> bool:
        """Lift, wait, and restore position, modes, feed and extruder exactly; False on abort.

        Whatever is extruded or moved meanwhile is undone by absolute moves and `G92 E`, so that
        a purge during the pause makes no giant move (Printrun#70).
        """
        while not self._link.idle:
            self._pump()
        self._ask("M400")
        place = self._where()
        modes = modes_after(checked, line, self._link.dialect.name)
        self._lift()
        self._note("paused")
        self._mutex.release()  # others may ask while the job rests
        try:
            while not self._go_on.wait(1.0):
                self._ask("M105")  # keeps firmware time-outs and this end of the link awake
        finally:
            self._mutex.acquire()
        if self._abort_asked.is_set():
            return False
        for command in modes.restore(place.x_mm, place.y_mm, place.z_mm, place.e_mm):
            self._ask(command)
        self._note("resumed")
        return True

    def _lift(self) -> None:
        for command in ("G21", "G91", f"G1 Z{PAUSE_LIFT_MM:g} F600", "G90"):
            self._ask(command)

    def emergency_stop(self) -> None:
        """Send M112, past every queue that the firmware lets it pass."""
        self._write(b"\nM112\n")
        self._link.give_up("an emergency stop was asked for")

    def heaters_off(self) -> None:
        """Switch hotend, bed and fan off, acknowledged."""
        for command in SAFE_COMMANDS:
            self._ask(command)

    def make_safe(self) -> None:
        """Heaters off and nozzle lifted, by any means left; says loudly if it cannot."""
        if self._serial is None:
            return
        try:
            if self._link.ended or not self._link.idle:
                data = b"\n" + b"".join(command.encode() + b"\n" for command in SAFE_COMMANDS)
                self._write(data)
                self._note("heaters told to switch off by unnumbered lines; nothing confirms it")
            else:
                self._switch_off()
        except (LinkError, LocalProtocolError, OSError) as error:
            self._note(f"HEATERS COULD NOT BE REACHED ({error}): switch the printer off")

    def _switch_off(self) -> None:
        try:
            self.heaters_off()
            self._lift()
            self._note(f"{self._heaters_now()}, nozzle lifted")
        except JournalError:  # numbered lines must be written down first, these need not
            self._note(make_safe(self._fd))

    def _heaters_now(self) -> str:
        """What the printer says of its heaters; an `ok` alone confirms nothing."""
        for event in self._ask("M105"):
            if isinstance(event, ev.TemperatureReport) and all(
                heater.target_c == 0.0 for heater in event.heaters.values()
            ):
                return "heaters off (the printer reports targets of 0)"
        return "heaters told to switch off, nothing confirms it"

    @property
    def notes(self) -> tuple[str, ...]:
        """What the host did of its own accord since the last `print` began."""
        return tuple(self._warnings)

    def _note(self, text: str) -> None:
        self._warnings.append(text)
        if self._log is not None:
            self._log.add(self._clock(), b"#", text.encode("ascii", "replace"))
        self._book.note(text)

    # ------------------------------------------------------------------ what is heard

    def _on_other_event(self, event: ev.Event) -> None:
        if isinstance(event, ev.TemperatureReport):
            self._book.temperature(event)
        elif isinstance(event, ev.HostAction):
            self.actions.append(event.action)
            if event.action.split()[0] in ("pause", "cancel"):
                (self.pause if event.action.startswith("pause") else self.abort)()

    def _fault(self, text: str) -> Exception:
        return PrinterError(
            f"The printer reports a fault: {text}; the last program line known to be executed is "
            f"{self._book.executed_line + 1}."
        )

    def _lost_error(self, why: str) -> LinkLostError:
        executed, last_sent = self._book.executed_line, self._book.last_sent_line
        doubt = (
            f"lines {executed + 2} to {last_sent + 1} are uncertain"
            if last_sent > executed
            else "no later line was sent"
        )
        return LinkLostError(
            f"The link to {self.port} is lost: {why}; program lines up to "
            f"{executed + 1} are acknowledged, {doubt}; find out where the printer is "
            f"before going on.",
            executed,
            last_sent,
            why=why,
        )
