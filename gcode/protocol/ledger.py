"""The lines of a conversation by number: given out, on the wire, acknowledged.

It counts and keeps; when to send, and what to believe, is the business of `link` and `belief`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from gcode.protocol.lines import WireLine

HISTORY_LINES = 512
"""Lines kept for a resend; OctoPrint keeps 50, a window and false acknowledgements want more."""


class Ledger:
    """Numbers and lines of one conversation.

    Attributes
    ----------
    last
        Highest number given to a line.
    acked
        Every line up to here is acknowledged.
    cursor
        The next number to put on the wire; `last + 1` unless lines are sent again.
    wire_bytes
        Bytes under way.
    """

    __slots__ = ("_last_slow", "_lines", "acked", "cursor", "last", "wire_bytes")

    def __init__(self, number: int = 0) -> None:
        self.last = self.acked = number
        self.cursor = number + 1
        self.wire_bytes = 0
        self._lines: deque[bytes] = deque(maxlen=HISTORY_LINES)
        self._last_slow = number

    @property
    def kept(self) -> int:
        """How many lines can still be sent again."""
        return len(self._lines)

    @property
    def slow_under_way(self) -> bool:
        """Whether a line that may take minutes is not acknowledged yet."""
        return self._last_slow > self.acked

    def add(self, line: WireLine) -> None:
        """Note the next line, which goes on the wire for the first time."""
        number, _, data, slow = line
        self._lines.append(data)
        self.last = number
        self.cursor = number + 1
        self.wire_bytes += len(data)
        if slow:
            self._last_slow = number

    def add_moves(self, moves: Sequence[bytes], acknowledged: int) -> None:
        """Note quick lines that followed one another, and how many of them are acknowledged.

        Every line before is acknowledged.
        """
        self._lines.extend(moves)
        self.last += len(moves)
        self.cursor = self.last + 1
        self.acked += acknowledged
        self.wire_bytes = sum(map(len, moves[acknowledged:]))

    def acknowledge(self, number: int) -> None:
        """Note that every line up to `number` is acknowledged."""
        if number == self.last:
            self.wire_bytes = 0
        else:
            for earlier in range(self.acked + 1, number + 1):
                self.wire_bytes -= len(self.data(earlier))
        self.acked = number

    def fail(self) -> None:
        """Note that what is under way has failed: its answer follows at once."""
        self._last_slow = self.acked

    def expect_again(self, number: int) -> None:
        """Note that the printer wants line `number` next, whatever was acknowledged."""
        self.acked = number - 1
        self.cursor = max(self.cursor, number)

    def rewind(self) -> None:
        """Take every line after the acknowledged ones for unsent."""
        self.cursor = self.acked + 1
        self.wire_bytes = 0

    def next_again(self) -> bytes:
        """Return the line at the cursor, which goes on the wire once more."""
        data = self.data(self.cursor)
        self.wire_bytes += len(data)
        self.cursor += 1
        return data

    def data(self, number: int) -> bytes:
        """Return the bytes of a line that is still kept."""
        return self._lines[number - self.last - 1]
