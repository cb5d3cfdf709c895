"""The host's side of a serial printer protocol, without I/O, clock or threads.

Bytes and times go in, bytes and events come out; the caller owns port and clock.

    data = link.send("G1 X10", now_s)          # bytes to write, now
    events = link.receive(port.read(), now_s)  # what the printer said
    events = link.tick(now_s)                  # time has passed, nothing was said
    data = link.take_output()                  # bytes the link itself wants written

What it promises: with a firmware that verifies line numbers and checksums, every line given to
`send` is executed exactly once and in order, whatever is lost, garbled or said twice, or the
link ends in `LOST` and names the interval that is uncertain. The ground: a line and its number
belong together for ever, so sending it again is idempotent; and no reply is believed beyond what
that allows. With any other firmware nothing is ever sent twice.

What it does not do: judge G-code, know what a job is, retry by reopening, or sleep.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import reduce
from operator import xor

from gcode.errors import LocalProtocolError
from gcode.protocol.dialects import LINK_DIALECTS, LinkDialect
from gcode.protocol.events import (
    Acknowledged,
    Busy,
    CommandFailed,
    Event,
    Greeted,
    LineError,
    LinkLost,
    Ok,
    PrinterReset,
    Probed,
    Resend,
    ResendRefused,
    ResendRequested,
    SpareOk,
    TemperatureReport,
    UnknownCommand,
    Unrecognised,
    Waiting,
)
from gcode.protocol.replies import parse_reply
from gcode.protocol.transitions import TRANSITIONS, Signal, State

HISTORY_LINES = 512
"""Lines kept for a resend; OctoPrint keeps 50, a window and false acknowledgements want more."""

MAX_REPLY_BYTES = 4096
"""A reply longer than this is noise, dropped up to its newline."""

SLOW_COMMANDS = frozenset(
    (
        *("G4", "G28", "G29", "G30", "G33", "G34", "G76", "G80"),
        *("M0", "M1", "M25", "M48", "M109", "M116", "M125", "M190", "M191", "M226", "M303"),
        *("M400", "M569", "M600", "M601", "M701", "M702", "M860", "M861"),
    )
)
"""Commands that may take minutes without an answer (OctoPrint's longRunningCommands and more)."""


@dataclass(frozen=True, slots=True)
class LinkTiming:
    """How long the link waits, s.

    Attributes
    ----------
    silence_s
        An ordinary line unanswered for this long: send it again (OctoPrint waits 30 s and
        then forces the *next* line, which loses one; a probe loses nothing).
    slow_silence_s
        The same for commands that take long.
    resend_grace_s
        How long after a resend request an `ok` may still belong to it.
    doubt_s
        Silence after something suspicious (a garbled reply, an ignored resend).
    give_up_s
        Unanswered probes for this long: the link is lost.
    slow_give_up_s
        The same while a slow command is under way.
    """

    silence_s: float = 8.0
    slow_silence_s: float = 60.0
    resend_grace_s: float = 0.1
    doubt_s: float = 0.4
    give_up_s: float = 60.0
    slow_give_up_s: float = 1800.0
    max_resends: int = 10
    max_refused: int = 3


def checksum(data: bytes) -> int:
    """Exclusive or over `data`, the checksum of RepRap's protocol."""
    return reduce(xor, data, 0)


class Link:
    """One conversation with one printer.

    Parameters
    ----------
    dialect
        A name of `LINK_DIALECTS` or a dialect of the caller's own.
    window
        Most lines under way at once; 1 unless the printer is known to buffer (ADVANCED_OK).
    """

    def __init__(
        self,
        dialect: str | LinkDialect = "marlin",
        *,
        window: int = 1,
        timing: LinkTiming | None = None,
    ) -> None:
        self.dialect = LINK_DIALECTS[dialect] if isinstance(dialect, str) else dialect
        self.window = window
        self.timing = timing or LinkTiming()
        self.state = State.UNGREETED
        self.resends = 0
        self.probes = 0
        self.spare_oks = 0
        self._history: deque[bytes] = deque(maxlen=HISTORY_LINES)
        self._slow: deque[bool] = deque(maxlen=HISTORY_LINES)
        self._inbox = bytearray()
        self._skipping = False
        self._out = bytearray()
        self._events: list[Event] = []
        self._hello_at_s = 0.0
        self._reset_numbers()

    def _reset_numbers(self) -> None:
        self._history.clear()
        self._slow.clear()
        self._last = 0  # highest number given to a line
        self._acked = 0  # every line up to here is acknowledged
        self._cursor = 1  # the next number to put on the wire
        self._proven = 0  # received for certain: cannot be asked for again
        self._wire_bytes = 0
        self._stale: int | None = None  # a resend request for this number may be an echo
        self._swallow_until_s = -1.0
        self._rewind_until_s = 0.0
        self._rewind_at_once = False
        self._same_resends = 0
        self._last_resend = -1
        self._refused = 0
        self._refused_at = 0
        self._number_faults = 0
        self._heard_s = 0.0
        self._deadline_s = float("inf")
        self._probing_since_s: float | None = None

    # ------------------------------------------------------------------ what the caller asks

    @property
    def last_sent(self) -> int:
        """Number of the last line given to `send`."""
        return self._last

    @property
    def last_acked(self) -> int:
        """Every line up to this number is acknowledged."""
        return self._acked

    @property
    def ready(self) -> bool:
        """Whether `send` may be called now."""
        if self.state is State.IDLE:
            return True
        return (
            self.state is State.WAITING
            and self.window > 1
            and self._cursor == self._last + 1
            and self._last - self._acked < self.window
            and self._wire_bytes < self.dialect.rx_bytes
        )

    @property
    def idle(self) -> bool:
        """Whether every line sent is acknowledged and nothing is in doubt."""
        return self.state is State.IDLE

    @property
    def ended(self) -> bool:
        """Whether the link has ended (`LOST`, `HALTED`) and only `hello` leads on."""
        return self.state is State.LOST or self.state is State.HALTED

    def hello(self, now_s: float, *, number: int = 0) -> bytes:
        """Start numbering afresh: `M110`, the first line of any conversation.

        With `number`, continue a numbering that is proved to have reached it.
        """
        self._go(Signal.HELLO)
        self._reset_numbers()
        self._last = self._acked = self._proven = number
        self._cursor = number + 1
        self._inbox.clear()
        self._out.clear()
        self._probing_since_s = now_s
        self._hello_at_s = now_s
        return self._hello_bytes(now_s)

    def _hello_bytes(self, now_s: float) -> bytes:
        self._deadline_s = now_s + self.timing.doubt_s * 5
        if not self.dialect.numbered:
            return b"\nM105\n"
        # The newline ends whatever half line a dead sender left in the printer's buffer.
        return b"\n" + _numbered(self._last, f"M110 N{self._last}".encode())

    def send(self, command: str, now_s: float) -> bytes:
        """Give the next line its number and return the bytes to write.

        Raises
        ------
        LocalProtocolError
            If the link is not `ready`, or the command cannot be carried by this dialect.
        """
        if not self.ready:
            raise LocalProtocolError(
                f"The link is {self.state.value} with {self._last - self._acked} lines under way "
                f"of {self.window}; wait until it is ready."
            )
        text = wire_text(command)
        number = self._last + 1
        data = _numbered(number, text) if self.dialect.numbered else text + b"\n"
        if len(data) > self.dialect.max_line_bytes:
            if text[:4] in (b"M117", b"M118"):
                spare = len(data) - self.dialect.max_line_bytes
                text = text[:-spare].rstrip()
                data = _numbered(number, text) if self.dialect.numbered else text + b"\n"
            else:
                raise LocalProtocolError(
                    f"The line of {len(data)} bytes exceeds the {self.dialect.max_line_bytes} "
                    f"that {self.dialect.name} takes before cutting it silently; shorten it: "
                    f"{command[:60]!r}."
                )
        slow = text.split(b" ", 1)[0].decode("ascii", "replace") in SLOW_COMMANDS
        self._history.append(data)
        self._slow.append(slow)
        self._last = number
        self._cursor = number + 1
        self._wire_bytes += len(data)
        self._go(Signal.SENT)
        self._listen_anew(now_s, self._silence_s())
        return data

    def take_output(self) -> bytes:
        """Return bytes that the link itself wants written (resends, probes), once."""
        if not self._out:
            return b""
        data = bytes(self._out)
        self._out.clear()
        return data

    def next_deadline_s(self) -> float:
        """When `tick` has something to do; infinity if never."""
        if self.state is State.REWINDING:
            return self._rewind_until_s
        if self.state in (State.WAITING, State.PROBING, State.GREETING):
            return self._deadline_s
        return float("inf")

    def confirm(self) -> None:
        """Take note that the printer proved to have received every line sent so far.

        For a caller who has seen an answer that only the last line can have caused.
        """
        if self.idle:
            self._proven = self._last
            self._refused = self._number_faults = 0
            self._stale = None

    def receive(self, data: bytes, now_s: float) -> list[Event]:
        """Take bytes from the printer and return what they mean; any bytes at all are fine."""
        if (
            data == b"ok\n"
            and self.state is State.WAITING
            and self._swallow_until_s < 0
            and not self._inbox
            and not self._skipping
        ):  # the beaten path
            self._acknowledge(self._acked + 1, now_s)
            events, self._events = self._events, []
            return events
        self._inbox += data
        if b"\n" in data:
            *lines, rest = bytes(self._inbox).split(b"\n")
            self._inbox = bytearray(rest)
            for raw in lines:
                if self._skipping:
                    self._skipping = False
                    continue
                self._reply(raw.rstrip(b"\r"), now_s)
        if len(self._inbox) > MAX_REPLY_BYTES:
            self._events.append(Unrecognised(bytes(self._inbox[:80])))
            self._inbox.clear()
            self._skipping = True
        if self.state is State.REWINDING and self._rewind_at_once:
            self._rewind(now_s)
        events, self._events = self._events, []
        return events

    def tick(self, now_s: float) -> list[Event]:
        """Let time pass; call it no later than `next_deadline_s`."""
        if now_s < self.next_deadline_s():
            return []
        if self.state is State.REWINDING:
            self._rewind(now_s)
        elif self.state is State.GREETING:
            self._greet_again(now_s)
        elif self.state in (State.WAITING, State.PROBING):
            self._silence(now_s)
        events, self._events = self._events, []
        return events

    def give_up(self, why: str) -> list[Event]:
        """End the link for a reason of the caller's (the port is gone, an error was seen)."""
        if self.state not in (State.UNGREETED, State.HALTED, State.LOST):
            self._lose(why)
        events, self._events = self._events, []
        return events

    # ------------------------------------------------------------------ what the printer says

    def _reply(self, raw: bytes, now_s: float) -> None:
        reply = parse_reply(raw)
        if isinstance(reply, Ok):
            self._on_ok(reply, now_s)
        elif isinstance(reply, Resend):
            self._on_resend(reply.number, now_s)
        elif isinstance(reply, Busy):
            self._events.append(reply)
            self._listen_anew(now_s, self._silence_s())
        elif isinstance(reply, Waiting):
            self._events.append(reply)
            # It has nothing to do, yet owes us an ok; one that is under way gets a moment.
            self._doubt(now_s, self.timing.resend_grace_s)
        elif isinstance(reply, LineError):
            self._events.append(reply)
            # Some ask for no resend (OctoPrint#2226); the others' request follows at once.
            self._doubt(now_s, self.timing.resend_grace_s)
        elif isinstance(reply, PrinterReset):
            self._events.append(reply)
            self._on_reset(reply, now_s)
        elif isinstance(reply, CommandFailed):
            self._events.append(reply)
            if reply.fatal and Signal.HALT in TRANSITIONS[self.state]:
                self._go(Signal.HALT)
        elif isinstance(reply, UnknownCommand) and "*" in reply.text:
            # A numbered line whose N was lost: taken for a command without number, checksum
            # and all, and answered with ok. It must be sent again.
            self._events.append(reply)
            if self.state in (State.WAITING, State.PROBING):
                self._on_resend(self._acked + 1, now_s)
        elif isinstance(reply, Unrecognised):
            self._events.append(reply)
            self._doubt(now_s)
        else:
            self._events.append(reply)
            if isinstance(reply, TemperatureReport) and self._slow_under_way():
                self._listen_anew(now_s, self._silence_s())  # the reports of M109 and M190

    def _on_ok(self, ok: Ok, now_s: float) -> None:
        self._events.extend(ok.more)  # type: ignore[arg-type]
        if self.state is State.GREETING:
            self._go(Signal.GREETED)
            self._probing_since_s = None
            self._events.append(Greeted())
            return
        if self.state is State.REWINDING:
            # The ok that most firmwares send with a resend request (not all: Marlin 2.0.x).
            # With one line under way nothing else can come: go on at once.
            if self._cursor - 1 - self._acked <= 1:
                self._rewind_at_once = True
            self._spare("belongs to a resend request")
            return
        if self.state not in (State.WAITING, State.PROBING):
            self._spare("nothing was under way")
            return
        if now_s < self._swallow_until_s:
            self._swallow_until_s = -1.0
            self._spare("belongs to a stale resend request")
            return
        self._swallow_until_s = -1.0
        number = self._acked + 1
        if ok.number is not None and self._number_faults <= self.timing.max_refused:
            if ok.number <= self._acked:
                self._number_faults += 1
                self._spare(f"line {ok.number} was acknowledged before")
                self._doubt(now_s)
                return
            if ok.number < self._cursor:
                number = ok.number
            else:
                self._number_faults += 1  # ADVANCED_OK numbers can be wrong (Marlin#2952)
        self._acknowledge(number, now_s)

    def _acknowledge(self, number: int, now_s: float) -> None:
        if self.state is State.PROBING:
            # The line was sent twice; one copy earned this ok, the other may earn a request
            # for the next line, which must not be served.
            self._stale = self._cursor
        while self._acked < number:
            self._acked += 1
            self._wire_bytes -= len(self._history[self._acked - self._last - 1])
        self._same_resends = 0
        self._probing_since_s = None
        self._events.append(Acknowledged(self._acked))
        if self._acked == self._last:
            self._wire_bytes = 0
            self._go(Signal.DRAINED)
            self._deadline_s = float("inf")
            return
        self._go(Signal.ACKED)
        self._transmit(now_s)
        self._listen_anew(now_s, self._silence_s())

    def _on_resend(self, number: int, now_s: float) -> None:
        if not self.dialect.verifies or self.state not in (
            State.IDLE,
            State.WAITING,
            State.REWINDING,
            State.PROBING,
        ):
            self._events.append(ResendRequested(number, served=False))
            if self.state is State.GREETING:
                self._deadline_s = min(self._deadline_s, now_s + self.timing.resend_grace_s)
            elif not self.dialect.verifies and not self.ended:
                self._lose(f"the printer asked for line {number}, which may be executed already")
            return
        if self.state is not State.REWINDING and number == self._stale and number < self._cursor:
            self._stale = None
            self._swallow_until_s = now_s + self.timing.resend_grace_s
            self._events.append(ResendRequested(number, served=False))
            self._doubt(now_s)
            return
        if (why := self._why_refused(number)) is not None:
            self._refuse(number, why, now_s)
            return
        if number != self._last_resend:
            self._same_resends = 0
        if self.state is not State.REWINDING:  # a burst of requests counts once
            self._same_resends += 1
        self._last_resend = number
        if self._same_resends > self.timing.max_resends:
            self._lose(f"the printer asked for line {number} {self._same_resends} times in a row")
            return
        if number <= self._last:
            self.resends += 1
        self._events.append(ResendRequested(number, served=True))
        if number - 1 > self._acked:
            self._events.append(Acknowledged(number - 1))
        self._acked = number - 1
        self._cursor = max(self._cursor, number)
        self._rewind_until_s = now_s + self.timing.resend_grace_s
        self._rewind_at_once = False
        self._go(Signal.RESEND)

    def _why_refused(self, number: int) -> str | None:
        if number > self._last + 1:
            return f"line {number} was never sent, the last is {self._last}"
        if number <= self._proven:
            return f"line {number} is proved to be received: the printer has lost its place"
        if number <= self._last - len(self._history):
            return f"line {number} is not in the last {len(self._history)} lines any more"
        return None

    def _refuse(self, number: int, why: str, now_s: float) -> None:
        self._events.append(ResendRefused(number, why))
        if self._acked - self._refused_at >= 2:
            self._refused = 0  # it has made progress since: that one was noise
        self._refused_at = self._acked
        self._refused += 1
        if self._refused >= self.timing.max_refused:
            self._lose(why)
        elif self.state is State.IDLE:
            self._swallow_until_s = now_s + self.timing.resend_grace_s
        else:
            # The reply itself may be garbled: ask again before believing it.
            self._swallow_until_s = now_s + self.timing.resend_grace_s
            self._doubt(now_s)

    def _rewind(self, now_s: float) -> None:
        """Send again from the line asked for, now that all older answers are in."""
        self._rewind_at_once = False
        self._cursor = self._acked + 1
        self._swallow_until_s = -1.0
        self._wire_bytes = 0
        if self._cursor > self._last:
            self._stale = None
            self._probing_since_s = None
            self._go(Signal.DRAINED)
            self._deadline_s = float("inf")
            return
        self._go(Signal.REWOUND)
        self._stale = self._cursor + 1
        self._transmit(now_s)
        self._listen_anew(now_s, self._silence_s())

    def _on_reset(self, reset: PrinterReset, now_s: float) -> None:
        if self.state is State.GREETING:
            self._go(Signal.RESET)
            self._deadline_s = min(self._deadline_s, now_s + self.timing.resend_grace_s)
        elif self.state not in (State.UNGREETED, State.LOST):
            self._lose(f"the printer started anew ({reset.banner})", Signal.RESET)

    # ------------------------------------------------------------------ time

    def _silence(self, now_s: float) -> None:
        since_s = self._probing_since_s
        if since_s is None:
            since_s = self._probing_since_s = self._heard_s
        slow = self._slow_under_way()
        limit_s = self.timing.slow_give_up_s if slow else self.timing.give_up_s
        if now_s - since_s >= limit_s:
            self._lose(f"no answer to line {self._acked + 1} for {now_s - since_s:.1f} s")
            return
        if not self.dialect.verifies:
            # Nothing can be sent twice here: wait, and in the end stop.
            self._deadline_s = since_s + limit_s
            return
        number = self._cursor - 1
        self._out += self._line(number)
        self.probes += 1
        self._events.append(Probed(number))
        self._go(Signal.SILENCE)
        self._deadline_s = now_s + min(self._silence_s(), max(limit_s / 8, self.timing.doubt_s))

    def _greet_again(self, now_s: float) -> None:
        if now_s - self._hello_at_s >= self.timing.give_up_s:
            self._lose("the printer does not answer to M110")
        else:
            self._out += self._hello_bytes(now_s)

    def _slow_under_way(self) -> bool:
        offset = self._acked - self._last
        if offset == -1:
            return self._slow[-1]  # one line under way: the beaten path
        return any(self._slow[index] for index in range(offset, 0))

    def _silence_s(self) -> float:
        if self._slow and self._slow_under_way():
            return self.timing.slow_silence_s
        return self.timing.silence_s

    def _listen_anew(self, now_s: float, silence_s: float) -> None:
        self._heard_s = now_s
        self._probing_since_s = None
        self._deadline_s = now_s + silence_s

    def _doubt(self, now_s: float, after_s: float | None = None) -> None:
        """Something is odd: wait only shortly before asking again."""
        if self.state in (State.WAITING, State.PROBING):
            wait_s = self.timing.doubt_s if after_s is None else after_s
            self._deadline_s = min(self._deadline_s, now_s + wait_s)

    # ------------------------------------------------------------------ small parts

    def _transmit(self, now_s: float) -> None:
        """Put lines that wait to be sent (again) on the wire, as far as the window allows."""
        while self._cursor <= self._last and self._cursor - 1 - self._acked < self.window:
            data = self._line(self._cursor)
            self._out += data
            self._wire_bytes += len(data)
            self._cursor += 1

    def _line(self, number: int) -> bytes:
        return self._history[number - self._last - 1]

    def _spare(self, why: str) -> None:
        self.spare_oks += 1
        self._events.append(SpareOk(why))

    def _lose(self, why: str, signal: Signal = Signal.GIVE_UP) -> None:
        self._go(signal)
        self._deadline_s = float("inf")
        self._out.clear()
        self._events.append(LinkLost(why, self._acked, self._last))

    def _go(self, signal: Signal) -> None:
        try:
            self.state = TRANSITIONS[self.state][signal]
        except KeyError:
            raise LocalProtocolError(
                f"{signal.value!r} is not possible while the link is {self.state.value}."
            ) from None


def _numbered(number: int, text: bytes) -> bytes:
    body = b"N%d %b" % (number, text)
    return b"%b*%d\n" % (body, reduce(xor, body))


def wire_text(command: str) -> bytes:
    """Strip a G-code line to what goes on the wire: no comment, no space around, ASCII.

    Raises
    ------
    LocalProtocolError
        If nothing is left, if the command would end the line early, or if it renumbers lines.
    """
    text = command.partition(";")[0].strip()
    if not text:
        raise LocalProtocolError("An empty line or a comment is not sent; leave it out.")
    if "\n" in text or "\r" in text:
        raise LocalProtocolError(f"A command is one line; split it: {command[:60]!r}.")
    if "M110" in text:
        if text[:4] not in ("M117", "M118"):
            raise LocalProtocolError(f"M110 renumbers lines and is the link's own: {text[:60]!r}.")
        text = text.replace("M110", "M 110")  # Marlin finds M110 anywhere in a numbered line
    return text.encode("ascii", "replace")
