"""Plain moves and plain answers, as fast as a port can take turns: two system calls a line.

The port itself waits for the answer (`waiting`): to ask first whether there is one would be a
third call. It knows neither numbers nor journals: what is written was made ready by the link and
reserved in the journal before, and what became of it is told to both afterwards, whatever ended it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from gcode.protocol import PLAIN_OK

MOST_S = 0.25
"""So long at a time: the wire log lags no further behind, and a printer left alone is noticed."""
READ_BYTES = 65536


@contextlib.contextmanager
def waiting(fd: int) -> Iterator[None]:
    """Let reads wait for bytes, as long as the port was told to (VTIME), then return none.

    Nor does a write return before the port has taken all: for the little that is under way, it has
    room.
    """
    os.set_blocking(fd, True)
    try:
        yield
    finally:
        os.set_blocking(fd, False)


@dataclass(slots=True)
class Exchange:
    """What became of moves, right at every moment, so that any exception may end it.

    Parameters
    ----------
    fd
        A port whose reads wait (`waiting`).
    oks
        How many plain acknowledgements some bytes are, so many having come before; 0 where they
        are anything else.
    window, most_bytes
        Most moves under way at once; a further one may begin below so many bytes.

    Attributes
    ----------
    sent_s, answered_s
        When each was written and when its plain `ok` came, of the first of them.
    rest
        What the port did not take of the last of them.
    answer
        What came instead of a plain `ok`; None where nothing came in time, or the port is closed.
    """

    fd: int
    clock: Callable[[], float]
    oks: Callable[[bytes, int], int]
    asked_to_stop: Callable[[], bool]
    window: int
    most_bytes: int
    sent_s: list[float] = field(default_factory=list)
    answered_s: list[float] = field(default_factory=list)
    rest: bytes = b""
    answer: bytes | None = None

    def run(self, moves: Sequence[bytes]) -> None:
        """Write each move when there is room for it; end with the first odd answer.

        Raises
        ------
        OSError
            If the port fails.
        """
        with contextlib.suppress(BlockingIOError):  # a safe exit, by another thread
            if self.window == 1:
                self._one_by_one(moves)
            else:
                self._by_window(moves)

    def _one_by_one(self, moves: Sequence[bytes]) -> None:
        fd, clock, asked_to_stop = self.fd, self.clock, self.asked_to_stop
        read, noted, answered = os.read, self.sent_s.append, self.answered_s.append
        until_s = clock() + MOST_S
        for move in moves:
            if asked_to_stop():
                return
            noted(clock())
            if not self._write(move):
                return
            answer = read(fd, READ_BYTES)
            if answer != PLAIN_OK and self.oks(answer, len(self.answered_s)) != 1:
                self.answer = answer or None
                return
            now_s = clock()
            answered(now_s)
            if now_s >= until_s:
                return

    def _by_window(self, moves: Sequence[bytes]) -> None:
        sent = answered = under_way = 0
        until_s = self.clock() + MOST_S
        while True:
            now_s, first = self.clock(), sent
            if now_s < until_s and not self.asked_to_stop():
                room = min(len(moves), answered + self.window)
                while sent < room and under_way < self.most_bytes:
                    under_way += len(moves[sent])
                    sent += 1
            if sent > first:
                self.sent_s += [now_s] * (sent - first)
                if not self._write(b"".join(moves[first:sent])):
                    return
            if answered == sent:
                return
            answer = os.read(self.fd, READ_BYTES)
            count = self.oks(answer, answered)
            if not 0 < count <= sent - answered:
                self.answer = answer or None
                return
            under_way -= sum(map(len, moves[answered : answered + count]))
            answered += count
            self.answered_s += [self.clock()] * count

    def _write(self, data: bytes) -> bool:
        """Write all of `data`; else keep the rest, for those who can wait."""
        try:
            taken = os.write(self.fd, data)
        except BlockingIOError:
            taken = 0
        if taken < len(data):
            self.rest = data[taken:]
            return False
        return True
