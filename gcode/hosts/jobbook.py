"""Which program line went out under which number, and the journal that is written before it does.

The order is the promise: `before_line` and `before_own_command` return when the journal holds
what is about to happen, and only then may bytes be written. What is known to be executed is read
from the link's own acknowledgements, which a resend request may take back.
"""

from __future__ import annotations

import contextlib
import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence

from gcode.errors import JournalError
from gcode.hosts.journal import Journal
from gcode.hosts.modes import before_commands
from gcode.hosts.port import PrintableProgram
from gcode.protocol import HISTORY_LINES, Link
from gcode.protocol.events import TemperatureReport

UNCOUNTED_STEP = 16
"""Lines reserved by one commit where the printer counts none: few enough for its place to tell one
from another, many enough for a slow disk not to hold up short moves."""
TEMPERATURE_STEP_C = 2.0
TEMPERATURE_EVERY_S = 10.0
"""How often the journal hears of temperatures; a bed loses about a degree in that time."""


class JobBook:
    """The lines of one `print` call; without a journal nothing is written, all is known.

    Attributes
    ----------
    lines_sent
        Program lines sent; comments and empty lines never are.
    """

    def __init__(self, link: Link, journal: Journal | None, clock: Callable[[], float]) -> None:
        self._link = link
        self._journal = journal
        self._clock = clock
        self._sent: deque[tuple[int, int]] = deque(maxlen=2 * HISTORY_LINES)
        self._failed_after = math.inf  # the wire number before the line that failed
        self._checked: PrintableProgram | None = None
        self._first = self._end = 0
        self._reserved = 0  # end of the journal's open step; 0 if none is open
        self._coming = 0  # what it is being extended to; 0 if it is not
        self._paced = (0.0, 0)  # when it was extended last, and where
        self._noted_s = self._noted_bed_c = -math.inf
        self.lines_sent = 0

    def open(self, checked: PrintableProgram, first: int, end: int) -> None:
        """Turn to a new page: lines [first, end) of a program."""
        self._sent.clear()
        self._failed_after = math.inf
        self._checked = checked
        self._first, self._end = first, end
        self._reserved = self._coming = self.lines_sent = 0

    def begin(self, port: str) -> None:
        """Write the job down."""
        if self._journal is not None and self._checked is not None:
            self._journal.begin(self._checked.program.sha256, port, self._first, self._end)

    # ------------------------------------------------------------------ ahead of the wire

    def before_line(self, index: int) -> None:
        """Write down that program line `index` is sent next."""
        self._have_reserved(index)
        self._sent.append((self._link.last_sent + 1, index))
        self.lines_sent += 1

    def before_moves(self, indices: Sequence[int]) -> int:
        """Write down that program lines are sent next; returns how many of them may be."""
        self._have_reserved(indices[0])
        return (
            len(indices) if indices[-1] < self._reserved else bisect_left(indices, self._reserved)
        )

    def moves_sent(self, indices: Sequence[int]) -> None:
        """Take note of the program lines of moves that the link has just been told of."""
        self._sent.extend(enumerate(indices, self._link.last_sent - len(indices) + 1))
        self.lines_sent += len(indices)

    def _have_reserved(self, index: int) -> None:
        """Return when line `index` may be sent; have the lines after it reserved meanwhile."""
        journal = self._journal
        if journal is None:
            self._reserved = self._end
            return
        if index >= self._reserved and self._coming:
            journal.extended()
            self._reserved, self._coming = self._coming, 0
        counted = self._link.dialect.verifies
        step = journal.step_lines // 2 if counted else UNCOUNTED_STEP
        if index >= self._reserved:
            reserved = min(index + step, self._end)
            journal.reserve(index, self._next_number(), reserved, self.executed_line + 1)
            self._reserved, self._paced = reserved, (self._clock(), index)
        if counted and not self._coming and self._reserved < self._end:
            self._coming = min(self._reserved + max(step, self._pace(index)), self._end)
            journal.extend(self._coming, self.executed_line + 1)

    def _pace(self, index: int) -> int:
        """How many lines go out in half a step's time, as fast as they went since the last."""
        assert self._journal is not None
        now_s, (since_s, first) = self._clock(), self._paced
        self._paced = now_s, index
        rate = (index - first) / max(now_s - since_s, 1e-6)
        return int(rate * self._journal.step_s / 2)

    def _close_step(self) -> None:
        """Reserve anew before the next line."""
        if self._coming and self._journal is not None:
            self._journal.extended()
        self._reserved = self._coming = 0

    def before_own_command(self) -> None:
        """Write down that the next wire number is no program line's."""
        if self._journal is not None and self._reserved:
            self._close_step()
            line = self.last_sent_line + 1
            self._journal.reserve(line, self._next_number(), line, self.executed_line + 1)

    def _next_number(self) -> int | None:
        return self._link.last_sent + 1 if self._link.dialect.verifies else None

    # ------------------------------------------------------------------ what is known

    def failed_after(self, number: int) -> None:
        """Take note that a line after this wire number failed: its `ok` is none of success."""
        self._failed_after = min(self._failed_after, number)

    @property
    def last_sent_line(self) -> int:
        """The last program line sent; the one before the first if none was."""
        return self._sent[-1][1] if self._sent else self._first - 1

    @property
    def acked_line(self) -> int:
        """The last program line whose number is acknowledged, before any that failed."""
        acked = min(self._link.last_acked, self._failed_after)
        return next((index for n, index in reversed(self._sent) if n <= acked), self._first - 1)

    @property
    def executed_line(self) -> int:
        """The last program line that is acknowledged, and not lost in buffers since."""
        line = self.acked_line
        if self._link.forgot and self._checked is not None:
            most = self._link.dialect.buffered_lines
            line = before_commands(self._checked, self._first, line + 1, most) - 1
        return line

    @property
    def lines_acked(self) -> int:
        """How many program lines are acknowledged."""
        acked = self._link.last_acked
        return self.lines_sent - sum(number > acked for number, _ in self._sent)

    # ------------------------------------------------------------------ afterwards

    def proved(self) -> None:
        """Write down that every line sent has been received, proved by an answer."""
        if self._journal is not None:
            self._journal.acknowledged(self.executed_line + 1)

    def finish(self) -> None:
        """Write down that the whole program is done."""
        if self._journal is not None:
            self._journal.finish()

    def lost(self) -> None:
        """Write down what a lost link leaves uncertain; a full disk must not stop a safe exit."""
        if self._journal is not None:
            with contextlib.suppress(JournalError):
                self._journal.lost(
                    self.acked_line + 1, self.last_sent_line + 1, forgot=self._link.forgot
                )

    def note(self, text: str) -> None:
        """Write a remark down, if that is possible."""
        if self._journal is not None:
            with contextlib.suppress(JournalError):
                self._journal.note(text)

    def temperature(self, report: TemperatureReport) -> None:
        """Write temperatures down, some of the many that come while something heats."""
        hotend, bed = report.hotend, report.heaters.get("B")
        if self._journal is None or hotend is None:
            return
        now_s = self._clock()
        bed_c = bed.current_c if bed else None
        change_c = abs((bed_c or 0.0) - self._noted_bed_c)
        if now_s >= self._noted_s + TEMPERATURE_EVERY_S / 2 or change_c >= TEMPERATURE_STEP_C:
            self._noted_s, self._noted_bed_c = now_s, bed_c or 0.0
            self._journal.temperature(hotend.current_c, bed_c)
