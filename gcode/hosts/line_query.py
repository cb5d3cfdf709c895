"""Asks a printer, before any hello, which line number it has reached.

A line whose number and checksum are both wrong is carried out by no firmware that verifies; it is
answered by a request for the next line, which tells the number of the last one received. Nothing
else may be said before `M110`, which would overwrite that number.
"""

from __future__ import annotations

import os
import select
from collections.abc import Callable

from gcode.protocol import LinkTiming
from gcode.protocol.events import Busy, Echo, Resend, TemperatureReport
from gcode.protocol.inbox import Inbox
from gcode.protocol.replies import parse_reply

QUESTION = b"\nN2147483646 M105*0\n"
"""The newline ends the half line that a dead sender may have left. Its true checksum is 28."""
QUERY_TRIES = 10
"""Answers; at one damaged byte in 200 every third is damaged, nine of ten are one in 2,000."""


def last_number(
    fd: int,
    *,
    timing: LinkTiming,
    clock: Callable[[], float],
    note: Callable[[bytes, bytes], None],
) -> int | None:
    """Return the number of the last line the printer has received; None if it does not say.

    Parameters
    ----------
    fd
        The open port, not blocking.
    note
        Called with direction and bytes, for the wire log.
    """
    ears = _Ears(fd, timing, clock, note)
    ears.hear_out(timing.doubt_s, after_s=timing.doubt_s)  # what a dead sender's lines still cause
    before: int | None = None
    tries, end_s = 0, clock() + timing.give_up_s
    while tries < QUERY_TRIES and clock() < end_s:
        note(b">", QUESTION)
        os.write(fd, QUESTION)
        ears.hear_out(timing.silence_s, after_s=timing.doubt_s / 4)
        if ears.closed:
            return None
        if ears.asked_for is not None and ears.asked_for == before:
            return before - 1
        before = ears.asked_for or before  # a stale request or a garbled one: twice the same
        if ears.spoke:
            tries, end_s = tries + 1, clock() + timing.give_up_s
    return None


class _Ears:
    """What the printer says until it has been quiet for a while.

    Attributes
    ----------
    asked_for
        The last line it asked for; None if for none.
    spoke
        Whether it said anything.
    closed
        Whether the port is.
    """

    def __init__(
        self,
        fd: int,
        timing: LinkTiming,
        clock: Callable[[], float],
        note: Callable[[bytes, bytes], None],
    ) -> None:
        self._fd, self._timing, self._clock, self._note = fd, timing, clock, note
        self._inbox = Inbox()
        self._end_s = clock() + timing.slow_give_up_s
        self.asked_for: int | None = None
        self.spoke = self.closed = False

    def hear_out(self, quiet_s: float, *, after_s: float) -> None:
        """Listen until nothing has come for `quiet_s`; once it has asked, for `after_s`."""
        self._forget()
        until_s = self._clock() + quiet_s
        while (left_s := min(until_s, self._end_s) - self._clock()) > 0:
            if not select.select([self._fd], [], [], left_s)[0]:
                continue
            data = os.read(self._fd, 65536)
            if not data:
                self.closed = True
                return
            self.spoke = True
            self._note(b"<", data)
            wait_s = max((self._wait_s(*line) for line in self._inbox.take(data)), default=0.0)
            if self.asked_for is not None:
                wait_s = after_s
            until_s = self._clock() + min(quiet_s, wait_s or self._timing.doubt_s)

    def _forget(self) -> None:
        self.asked_for, self.spoke = None, False

    def _wait_s(self, raw: bytes, readable: bool) -> float:
        """How long what was said lets the next word wait."""
        reply = parse_reply(raw) if readable else None
        if isinstance(reply, Resend):
            self.asked_for = reply.number
        if isinstance(reply, Busy | TemperatureReport | Echo):  # a long command goes first
            return self._timing.silence_s
        return self._timing.doubt_s
