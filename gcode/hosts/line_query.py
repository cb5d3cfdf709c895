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
from gcode.protocol.events import Busy, Resend, TemperatureReport
from gcode.protocol.inbox import Inbox
from gcode.protocol.replies import parse_reply

QUESTION = b"\nN2147483646 M105*0\n"
"""The newline ends the half line that a dead sender may have left. Its true checksum is 28."""
QUERY_TRIES = 6


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
    _listen(fd, timing, clock, note, for_answer=False)  # what a dead sender's lines still cause
    before: int | None = None
    for _ in range(QUERY_TRIES):
        note(b">", QUESTION)
        os.write(fd, QUESTION)
        asked_for = _listen(fd, timing, clock, note, for_answer=True)
        if asked_for is None:
            return None
        if asked_for == before:
            return asked_for - 1
        before = asked_for  # a stale request or a garbled one: it must say the same twice
    return None


def _listen(
    fd: int,
    timing: LinkTiming,
    clock: Callable[[], float],
    note: Callable[[bytes, bytes], None],
    *,
    for_answer: bool,
) -> int | None:
    """Hear the printer out until it has been quiet for a while; the last line it asked for."""
    inbox, asked_for = Inbox(), None
    now_s = clock()
    end_s = now_s + timing.give_up_s
    quiet_s = now_s + (timing.give_up_s if for_answer else timing.doubt_s)
    while (left_s := min(quiet_s, end_s) - clock()) > 0:
        if not select.select([fd], [], [], left_s)[0]:
            continue
        data = os.read(fd, 65536)
        if not data:
            return None
        note(b"<", data)
        for raw, readable in inbox.take(data):
            reply = parse_reply(raw) if readable else None
            if isinstance(reply, Resend):
                asked_for = reply.number
            elif isinstance(reply, Busy | TemperatureReport):  # a long command goes first
                end_s = clock() + timing.slow_give_up_s
        if asked_for is not None or not for_answer:
            quiet_s = clock() + timing.doubt_s / 4
    return asked_for
