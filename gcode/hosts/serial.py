"""A printer on a serial port or pseudo-terminal: prints programs, pauses, goes on.

The port and the questions are `conversation`'s, lock and safe exits `guarded`'s, the fast way over
plain moves is `fast_path`'s; what may be sent and what an answer means is `protocol.Link`'s.
"""

from __future__ import annotations

import contextlib
import math
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from operator import sub
from pathlib import Path

from gcode.check.touches import TOUCH_COMMANDS
from gcode.errors import LinkError, LocalProtocolError, PrinterError
from gcode.hosts.conversation import Line
from gcode.hosts.fast_path import Exchange, waiting
from gcode.hosts.guarded import GuardedConversation
from gcode.hosts.jobbook import TEMPERATURE_EVERY_S
from gcode.hosts.journal import Journal
from gcode.hosts.modes import batches_of, modes_after
from gcode.hosts.port import LinkLostError, NothingMetError, PrintableProgram, PrintReport
from gcode.hosts.proof import require_arcs, require_checked
from gcode.hosts.telemetry import RoundTrips
from gcode.progress import Progress, silent
from gcode.protocol import PLAIN_OK, LinkTiming, WireLine
from gcode.protocol import events as ev

_TOUCHED = re.compile(r"(?://\s*)?amrepair: touched at z=(-?\d+\.\d+)")
"""What the macro AMREPAIR_TOUCH says; Klipper's own answers differ by its version."""
_TOUCHED_NOTHING = re.compile(r"(?://\s*)?amrepair: nothing was touched")
"""What it says once it has put Z right after that."""
HEARD_S = 0.1
"""By then Klipper has carried out what was due when a touch had failed."""
MOTORS_SURE = 0.8
"""Share of the firmware's own time after which its motors are not relied on: clocks differ, and
the pause's last move ended before it was counted."""
BATCH_LINES = 500
"""Lines made ready, and counted, at a time."""

TOUCHES_STOPPED = "The touches were stopped; the nozzle was lifted and the heaters are off."


class SerialPrinter(GuardedConversation):
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
            Line(port, baud, dialect, window, wire_log, journal, timing, clock, supervise, guard)
        )
        self._round_trips = RoundTrips()
        self._pause_asked = threading.Event()
        self._go_on = threading.Event()
        self._attention = threading.Event()  # set with either of the two others
        self._abort_asked = threading.Event()
        self._printing = False
        self._ask_s = -math.inf if journal is not None else math.inf  # temperatures, when next
        self.actions: deque[str] = deque(maxlen=100)
        self.said: deque[str] = deque(maxlen=100)

    def __enter__(self) -> SerialPrinter:
        self.connect()
        return self

    def close(self) -> None:
        """Let go of the printer, and of what somebody wanted of this conversation."""
        self._abort_asked.clear()
        super().close()

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
        require_arcs(checked, self.capabilities)
        total = checked.program.line_count + 1
        first, end = (0, total) if lines is None else (lines.start, lines.stop)
        start_s = self._clock()
        before = (self._link.resends, self._stalls, self._link.spare_oks, self._bytes_sent)
        self._round_trips = RoundTrips()
        self._warnings.clear()
        self._book.open(checked, first, end)
        self._printing = True
        try:
            with self._mutex:
                whole = self._carry_out(checked, first, end, progress)
                if whole and end >= total:
                    self._book.finish()
                elif whole:
                    self.hold_motors()  # nobody knows when the next part comes
        except (LinkError, LocalProtocolError):
            self._book.lost()
            self.make_safe()
            raise
        except KeyboardInterrupt:  # not every caller has a `with` around it
            self.make_safe()
            raise
        finally:
            self._printing = False
            if self._log is not None:
                self._log.flush()
        if not whole:
            self._abort_asked.clear()
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

    def finish_moves(self) -> None:
        """Return when every buffered move has been made."""
        try:
            super().finish_moves()
        except LinkError:
            self._book.lost()  # all are received, and perhaps not made
            raise

    def _note_temperatures(self, now_s: float) -> None:
        self._ask_s = now_s + TEMPERATURE_EVERY_S
        self._ask("M105")

    def _carry_out(
        self, checked: PrintableProgram, first: int, end: int, progress: Progress
    ) -> bool:
        """Stream, and prove that all has arrived; False if the job was aborted."""
        self._book.begin(self.port)
        whole = self._stream(checked, first, end, progress)
        if whole or self._comes_to_rest():
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
        if not self._await_room(next_is_move=True):
            return False
        progress("printing", total, total)
        return True

    def _await_room(self, *, next_is_move: bool) -> bool:
        """Listen until a line may be sent, before moves until nothing is under way.

        False if the job was aborted, which waits for no heater.
        """
        link = self._link
        while not (link.idle or (link.ready and not next_is_move)):
            if self._abort_asked.is_set():
                return False
            self._pump()
        return True

    def _send_batch(
        self, checked: PrintableProgram, indices: list[int], commands: list[str]
    ) -> bool:
        """Send some lines, each when there is room for it; False if the job was aborted."""
        link, at = self._link, 0
        lines, trips_s = link.prepare(commands), list[float]()
        while at < len(indices):
            if self._attention.is_set() and not self._attend(checked, indices[at]):
                return False
            if self._clock() >= self._ask_s:
                self._note_temperatures(self._clock())
            if lines.first + at != link.last_sent + 1:  # a command of our own came between
                indices, commands, at = indices[at:], commands[at:], 0
                lines = link.prepare(commands)
            moves = link.moves(lines, at)
            if moves:
                sent_s = self._send_moves(moves, indices[at : at + len(moves)], trips_s)
                at += len(sent_s)
            else:
                sent_s = [self._send_line(lines[at], indices[at], commands[at])]
                at += 1
            if not moves or not link.idle:
                if not self._await_room(next_is_move=lines.is_move(at)):
                    return False
                trips_s.append(self._clock() - sent_s[-1])
        self._round_trips.add(trips_s)
        return True

    def _send_line(self, line: str | WireLine, index: int, command: str) -> float:
        """Send a line that is no plain move, or comes at a moment that is not; returns when."""
        self._book.before_line(index)
        sent_s = self._clock()
        self._write(self._link.send(line, sent_s))
        if command[:4] in self._asked:
            self._asked[command[:4]] += 1
        return sent_s

    def _send_moves(
        self, moves: Sequence[bytes], indices: Sequence[int], trips_s: list[float]
    ) -> list[float]:
        """Send plain moves while the answers are plain; returns when each was sent."""
        moves = moves[: self._book.before_moves(indices)]
        link = self._link
        exchange = Exchange(
            self._fd,
            clock=self._clock,
            oks=link.oks,
            asked_to_stop=self._attention.is_set,
            window=link.window,
            most_bytes=link.dialect.rx_bytes,
        )
        failure = None
        try:
            with waiting(self._fd):
                exchange.run(moves)
        except OSError as error:
            failure = error
        finally:
            self._account(exchange, moves, indices)
        if failure is not None:
            self._lost(f"the port failed ({failure})")
        trips_s += map(sub, exchange.answered_s, exchange.sent_s)
        if exchange.rest:
            self._write(exchange.rest)
        if exchange.answer is not None:
            self._hear(exchange.answer)
        return exchange.sent_s

    def _account(self, exchange: Exchange, moves: Sequence[bytes], indices: Sequence[int]) -> None:
        """Tell link, journal, log and counters what became of moves."""
        sent_s, answered_s = exchange.sent_s, exchange.answered_s
        if not sent_s:
            return
        written = moves[: len(sent_s)]
        self._link.moves_sent(written, len(answered_s), max([sent_s[-1], *answered_s[-1:]]))
        self._book.moves_sent(indices[: len(sent_s)])
        self._bytes_sent += sum(map(len, written)) - len(exchange.rest)
        if self._log is not None:
            for index, move in enumerate(written):
                self._log.add(sent_s[index], b">", move)
                if index < len(answered_s):
                    self._log.add(answered_s[index], b"<", PLAIN_OK)

    # ------------------------------------------------------------------ touches

    def require_touches(self) -> None:
        """Any firmware will do: one that knows no touches says so when it is to touch."""

    def touch(
        self, checked: PrintableProgram, lines: range, *, progress: Progress = silent
    ) -> float:
        """Carry out lines, the last of them a touch; where it met something, mm in G-code's Z."""
        command = TOUCH_COMMANDS[checked.program.dialect]
        self.said.clear()
        try:
            report = self.print(checked, lines=lines, progress=progress)
        except PrinterError as error:
            self._forget_z()
            raise NothingMetError(f"{error}") from error
        if not report.ok:
            raise PrinterError(TOUCHES_STOPPED)
        if any(command in text for text in report.warnings):
            self.make_safe()
            how = (
                "write its macro by 'gcode touch --klipper-macro FILE', include it in printer.cfg"
                if self.dialect.touches_by_macro
                else "build it with G38_PROBE_TARGET, or set Z by hand, with paper below the nozzle"
            )
            raise PrinterError(
                f"The printer's firmware does not know {command}, so nothing was touched; the "
                f"nozzle was lifted and the heaters are off: {how}."
            )
        if not self.dialect.touches_by_macro:
            return self.place().z_mm
        said = [match for text in self.said if (match := _TOUCHED.fullmatch(text.strip()))]
        if not said:
            self.make_safe()
            raise PrinterError(
                "The printer does not say where the touch ended; is its macro AMREPAIR_TOUCH of "
                "this version? The nozzle was lifted and the heaters are off."
            )
        return float(said[-1].group(1))

    def _forget_z(self) -> None:
        """Z may still be the one that the macro lowered: then it must be homed first."""
        if not self.dialect.touches_by_macro:
            return
        with contextlib.suppress(LinkError, LocalProtocolError):
            self.command(f"G4 P{1000 * HEARD_S:.0f}")
            self.command("M400")
            if not any(_TOUCHED_NOTHING.fullmatch(text.strip()) for text in self.said):
                self.command("SET_KINEMATIC_POSITION CLEAR_HOMED=Z")

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
        """End the job: nothing more is sent, heaters off, nozzle lifted.

        Between two parts of a job the next one ends at once.
        """
        self._abort_asked.set()
        self._attention.set()
        self._go_on.set()
        if not self._printing:
            self.make_safe()

    @property
    def abort_asked(self) -> bool:
        """Whether somebody has ended the job, and no `print` has ended over it yet."""
        return self._abort_asked.is_set()

    def _attend(self, checked: PrintableProgram, line: int) -> bool:
        """Do what was asked for meanwhile; False on abort."""
        self._attention.clear()
        self._digest([])  # an emergency stop
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
        held, since_s = self.hold_motors(), self._clock()
        self._note("paused")
        self._mutex.release()  # others may ask while the job rests
        try:
            while not self._go_on.wait(1.0):
                self._ask("M105")  # keeps firmware time-outs and this end of the link awake
        finally:
            self._mutex.acquire()
        if self._abort_asked.is_set():
            return False
        if not held:
            self._require_motors(self._clock() - since_s)
        for command in modes.restore(place.x_mm, place.y_mm, place.z_mm, place.e_mm):
            self._ask(command)
        self._note("resumed")
        return True

    def _require_motors(self, idle_s: float) -> None:
        """Refuse to go on where the firmware has let go of its motors."""
        dialect = self._link.dialect
        if idle_s >= dialect.motors_off_s * MOTORS_SURE:
            raise PrinterError(
                f"The job rested for {idle_s:.0f} s; this firmware lets go of its motors after "
                f"{dialect.motors_off_s:.0f} s, so the nozzle's place is not certain any more and "
                f"nothing further was sent. The last program line executed is "
                f"{self._book.executed_line + 1}. Home X and Y alone (G28 X Y), never Z onto the "
                f"part, and go on by 'gcode resume-at'."
            )

    def emergency_stop(self) -> None:
        """Send M112, past every queue that the firmware lets it pass."""
        self._attention.set()
        super().emergency_stop()

    # ------------------------------------------------------------------ what is heard

    def _on_other_event(self, event: ev.Event) -> None:
        if isinstance(event, ev.TemperatureReport):
            self._book.temperature(event)
        elif isinstance(event, ev.Echo):
            self.said.append(event.text)
        elif isinstance(event, ev.HostAction):
            self.actions.append(event.action)
            asked = {"pause": self.pause, "resume": self.resume, "cancel": self.abort}
            asked.get(event.action.split()[0], lambda: None)()

    def _fault(self, failed: ev.CommandFailed) -> Exception:
        self._book.failed_after(failed.acked)
        where = ""
        if self._printing:
            where = (
                f"; the last program line known to be executed is {self._book.executed_line + 1}"
                f"{self._forgotten()}"
            )
        return PrinterError(f"The printer reports a fault: {failed.text}{where}.")

    def _forgotten(self) -> str:
        """What may have become of the lines after the last that is known to be executed."""
        if not self._link.forgot:
            return ""
        most = self._link.dialect.buffered_lines
        return f" (up to {most} acknowledged after it may have been lost in its buffers)"

    def _lost_error(self, why: str) -> LinkLostError:
        executed, last_sent = self._book.executed_line, self._book.last_sent_line
        doubt = (
            f"lines {executed + 2} to {last_sent + 1} are uncertain"
            if last_sent > executed
            else "no later line was sent"
        )
        return LinkLostError(
            f"The link to {self.port} is lost: {why}; program lines up to "
            f"{executed + 1} are {'executed' if self._link.forgot else 'acknowledged'}"
            f"{self._forgotten()}, {doubt}; its heaters may be on: find out where the printer is "
            f"before going on.",
            executed,
            last_sent,
            why=why,
        )
