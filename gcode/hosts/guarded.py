"""A conversation that ends safely: one sender a printer, heaters off whatever becomes of it.

It owns the lock, the supervisor, the journal and the safe exits; what is printed is `serial`'s.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from gcode.errors import JournalError, LinkError, LocalProtocolError
from gcode.hosts.conversation import Line, SerialConversation
from gcode.hosts.jobbook import JobBook
from gcode.hosts.journal import Journal
from gcode.hosts.line_query import last_number
from gcode.hosts.lock import PortLock
from gcode.hosts.safety import SAFE_COMMANDS, Supervisor
from gcode.hosts.supervisor import make_safe

_log = logging.getLogger(__name__)
PAUSE_LIFT_MM = 5.0
REST_S = 2.0
"""Longest wait for the answers under way before a safe exit goes past them."""


class GuardedConversation(SerialConversation):
    """A printer that is left safe."""

    def __init__(self, line: Line) -> None:
        super().__init__(line)
        self._journal = line.journal
        self._supervisor: Supervisor | None = None
        self._lock = PortLock(line.port)
        self._book = JobBook(self._link, line.journal, line.clock)
        self._safe_after = -1  # bytes sent when it was last made safe
        self._half_safe = False  # an interrupt, and one more, came in the midst of that

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None:
            self.make_safe()
        self.close()

    def connect(self, *, before_hello: Callable[[int | None], None] | None = None) -> None:
        """Open the port, agree on line numbers and ask who is there.

        Parameters
        ----------
        before_hello
            Told the number of the last line that the printer has received (None: it does not
            say), before a hello makes it forget that; what it raises ends the attempt. Given by
            who goes on with a job: the printer is left safe where the attempt fails.
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
            if self._line.guard and self._link.dialect.verifies:
                self._test_guard()
                self._went_wrong = False  # what was sent damaged was to be
            self._learn()
            self._prove()  # from here on a silent reset cannot be taken for a resend request
        except BaseException:
            if before_hello is not None:
                self._leave_cold()
            self.close()
            raise
        if self._line.supervise:
            self._supervisor = Supervisor(
                self._fd, self._lock.fd, self._journal_path(), self.heads_off()
            )

    def _leave_cold(self) -> None:
        """Make safe a printer that a job of ours may heat, by whoever cannot go on with it."""
        if self._serial is not None:
            lift = not self._link.ended
            self._told_safe(make_safe(self._fd, lift=lift, heads_off=self.heads_off()))

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
        before_hello(number)

    def close(self) -> None:
        """Let go of the printer; heaters stay as they are (`make_safe` switches them off).

        Where that was begun and not finished, by whoever would not wait, the supervisor does it.
        """
        if self._supervisor is not None:
            if self._half_safe:
                self._told_safe("the safe exit was interrupted; the supervisor goes on with it")
                self._supervisor.take_over()
                self._lock.hand_over()
            else:
                self._supervisor.stand_down()
            self._supervisor, self._half_safe = None, False
        self._close_port()
        self._lock.release()

    # ------------------------------------------------------------------ questions

    @property
    def journal(self) -> Journal | None:
        """Where the job is written down."""
        return self._journal

    def _before_own_command(self) -> None:
        self._book.before_own_command()

    # ------------------------------------------------------------------ safe exits

    def emergency_stop(self) -> None:
        """Send M112, past every queue that the firmware lets it pass."""
        self._write(b"\nM112\n")
        self._ended_by = "an emergency stop was asked for"
        self._link.give_up(self._ended_by, stopped=True)

    def heaters_off(self) -> None:
        """Switch every hotend, bed and fan off, acknowledged."""
        for command in (*SAFE_COMMANDS, *self.heads_off()):
            self._ask(command)

    def make_safe(self) -> None:
        """Heaters off and nozzle lifted, by any means left; says loudly if it cannot.

        An interrupt comes in the middle of a line, and then its answer is waited for. Where none
        comes, and while something heats, unnumbered lines go past it; after a lost link nobody
        knows where the nozzle is, and it stays there. Once is enough until something is sent.
        """
        if self._serial is None or self._safe_after == self._bytes_sent:
            return
        ours = self._mutex.acquire(timeout=REST_S)  # another thread may print
        self._half_safe = True
        try:
            if not (ours and self._comes_to_rest() and self._switched_off()):
                self._go_past()
            self._safe_after = self._bytes_sent
        except KeyboardInterrupt:  # in the midst of this: once more, past everything
            self._go_past()
            self._half_safe = False
            raise
        except (LinkError, LocalProtocolError, OSError) as error:
            self._told_safe(f"HEATERS COULD NOT BE REACHED ({error}): switch the printer off")
        finally:
            if ours:
                self._mutex.release()
        self._half_safe = False

    def _comes_to_rest(self) -> bool:
        """Hear out what is under way, unless that takes minutes; whether nothing is left of it."""
        until_s = self._clock() + REST_S
        self._link.ask_soon(self._clock())  # what was being read when it came is gone
        with contextlib.suppress(LinkError):  # it says what everybody knows: something is wrong
            while not self._link.idle and not self._link.ended and not self._link.slow_under_way:
                left_s = until_s - self._clock()
                if left_s <= 0:
                    break
                self._pump(limit_s=left_s)
        return self._link.idle

    def _go_past(self) -> None:
        """Make safe by unnumbered lines; nothing of the job is sent after them."""
        lift = not self._link.ended
        if lift:
            self._ended_by = "the printer was made safe"
            self._link.give_up(self._ended_by)
        waits = self._link.slow_under_way
        word = make_safe(self._fd, lift=lift, heads_off=self.heads_off())
        if waits and word.endswith("NO ANSWER"):
            word += (
                ": the printer is at a command that takes long, heats on until that is done, and "
                "obeys then; switch it off if that must not be"
            )
        self._told_safe(word)

    def _switched_off(self) -> bool:
        """Heaters off and nozzle lifted; False where the link ended over it."""
        try:
            self.heaters_off()
            self._lift()
            self._told_safe(f"{self._heaters_now()}, nozzle lifted")
        except JournalError:  # numbered lines must be written down first, these need not
            self._told_safe(make_safe(self._fd, heads_off=self.heads_off()))
        except LinkError:
            return False
        return True

    def _heaters_now(self) -> str:
        """What the printer says of its heaters; an `ok` alone confirms nothing."""
        try:
            targets_c = self._targets_c()
        except LinkError:
            if self._link.ended:
                raise
            targets_c = {}
        if targets_c and not any(targets_c.values()):
            return "heaters off (the printer reports targets of 0)"
        return "heaters told to switch off, nothing confirms it"

    @property
    def notes(self) -> tuple[str, ...]:
        """What the host did of its own accord since the last `print` began."""
        return tuple(self._warnings)

    def _told_safe(self, text: str) -> None:
        """Note how a safe exit went, and say it: an interrupt has no words of its own."""
        self._note(text)
        _log.warning("printer: %s", text)

    def _note(self, text: str) -> None:
        self._warnings.append(text)
        if self._log is not None:
            self._log.add(self._clock(), b"#", text.encode("ascii", "replace"))
        self._book.note(text)

    def _lift(self) -> None:
        for command in ("G21", "G91", f"G1 Z{PAUSE_LIFT_MM:g} F600", "G90"):
            self._ask(command)
