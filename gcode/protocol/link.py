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

from collections.abc import Sequence

from gcode.errors import LocalProtocolError
from gcode.protocol.belief import Belief, Verdict
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
from gcode.protocol.inbox import Inbox
from gcode.protocol.ledger import Ledger
from gcode.protocol.lines import WireLine, numbered, wire_line, wire_lines
from gcode.protocol.replies import parse_reply
from gcode.protocol.timing import LinkTiming
from gcode.protocol.transitions import TRANSITIONS, Signal, State

NEVER_S = float("inf")

# Looked up once: Python 3.11 takes 0.1 µs to find a member of an enumeration, ten times a line.
_GREETING, _IDLE, _WAITING = State.GREETING, State.IDLE, State.WAITING
_REWINDING, _PROBING = State.REWINDING, State.PROBING
_SENT, _ACKED, _DRAINED = Signal.SENT, Signal.ACKED, Signal.DRAINED


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
        self._inbox = Inbox()
        self._out = bytearray()
        self._events: list[Event] = []
        self._hello_at_s = 0.0
        self._reset_numbers(0)

    def _reset_numbers(self, number: int) -> None:
        self._ledger = Ledger(number)
        self._belief = Belief(self.timing, number)
        self._swallow_until_s = -1.0
        self._rewind_until_s = 0.0
        self._rewind_at_once = False
        self._heard_s = 0.0
        self._deadline_s = NEVER_S
        self._probing_since_s: float | None = None

    # ------------------------------------------------------------------ what the caller asks

    @property
    def last_sent(self) -> int:
        """Number of the last line given to `send`."""
        return self._ledger.last

    @property
    def last_acked(self) -> int:
        """Every line up to this number is acknowledged."""
        return self._ledger.acked

    @property
    def ready(self) -> bool:
        """Whether `send` may be called now."""
        if self.state is _IDLE:
            return True
        if self.window == 1 or self.state is not _WAITING:
            return False
        ledger = self._ledger
        return (
            ledger.cursor == ledger.last + 1
            and ledger.last - ledger.acked < self.window
            and ledger.wire_bytes < self.dialect.rx_bytes
        )

    @property
    def idle(self) -> bool:
        """Whether every line sent is acknowledged and nothing is in doubt."""
        return self.state is _IDLE

    @property
    def ended(self) -> bool:
        """Whether the link has ended (`LOST`, `HALTED`) and only `hello` leads on."""
        return self.state is State.LOST or self.state is State.HALTED

    def hello(self, now_s: float, *, number: int = 0) -> bytes:
        """Start numbering afresh: `M110`, the first line of any conversation.

        With `number`, continue a numbering that is proved to have reached it.
        """
        self._go(Signal.HELLO)
        self._reset_numbers(number)
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
        number = self._ledger.last
        return b"\n" + numbered(number, b"M110 N%d" % number)

    def prepare(self, commands: Sequence[str]) -> list[str | WireLine]:
        """Make what `send` takes out of the commands that come next, all at once.

        It promises nothing: where another line comes between, `send` numbers anew; what the
        dialect cannot carry is refused when its turn comes.
        """
        return wire_lines(self._ledger.last + 1, commands, self.dialect)

    def send(self, command: str | WireLine, now_s: float) -> bytes:
        """Give the next line its number and return the bytes to write.

        Raises
        ------
        LocalProtocolError
            If the link is not `ready`, or the command cannot be carried by this dialect.
        """
        ledger = self._ledger
        if self.state is not _IDLE and not self.ready:
            raise LocalProtocolError(
                f"The link is {self.state.value} with {ledger.last - ledger.acked} lines under way "
                f"of {self.window}; wait until it is ready."
            )
        number = ledger.last + 1
        if isinstance(command, str):
            line = wire_line(number, command, self.dialect)
        elif command[0] == number:
            line = command
        else:
            line = wire_line(number, command.command, self.dialect)
        ledger.add(line)
        self.state = TRANSITIONS[self.state][_SENT]
        self._listen_anew(now_s)
        return line[2]

    def take_output(self) -> bytes:
        """Return bytes that the link itself wants written (resends, probes), once."""
        if not self._out:
            return b""
        data = bytes(self._out)
        self._out.clear()
        return data

    def next_deadline_s(self) -> float:
        """When `tick` has something to do; infinity if never."""
        state = self.state
        if state is _WAITING or state is _PROBING or state is _GREETING:
            return self._deadline_s
        return self._rewind_until_s if state is _REWINDING else NEVER_S

    def confirm(self) -> None:
        """Take note that the printer proved to have received every line sent so far.

        For a caller who has seen an answer that only the last line can have caused.
        """
        if self.idle:
            self._belief.confirm(self._ledger.last)

    def receive_ok(self, data: bytes) -> bool:
        """Take the answer that nearly every line gets: the beaten path of `receive`.

        True where `data` is an `ok`, one line was under way and nothing is in doubt: the line is
        acknowledged. False where it is anything else: nothing is taken, `receive` is to have it.
        """
        ledger = self._ledger
        if (
            data == b"ok\n"
            and self.state is _WAITING
            and ledger.last - ledger.acked == 1
            and self._swallow_until_s < 0
            and self._inbox.empty
        ):
            ledger.acked = ledger.last
            ledger.wire_bytes = 0
            self._belief.progress()
            self._probing_since_s = None
            self.state = TRANSITIONS[_WAITING][_DRAINED]
            self._deadline_s = NEVER_S
            return True
        return False

    def receive(self, data: bytes, now_s: float) -> list[Event]:
        """Take bytes from the printer and return what they mean; any bytes at all are fine."""
        if self.receive_ok(data):
            return [Acknowledged(self._ledger.acked)]
        for raw, readable in self._inbox.take(data):
            if readable:
                self._reply(raw, now_s)
            else:
                self._events.append(Unrecognised(raw))
                self._doubt(now_s)
        if self.state is _REWINDING and self._rewind_at_once:
            self._rewind(now_s)
        events, self._events = self._events, []
        return events

    def tick(self, now_s: float) -> list[Event]:
        """Let time pass; call it no later than `next_deadline_s`."""
        if now_s < self.next_deadline_s():
            return []
        if self.state is _REWINDING:
            self._rewind(now_s)
        elif self.state is _GREETING:
            self._greet_again(now_s)
        elif self.state in (_WAITING, _PROBING):
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
            self._listen_anew(now_s)
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
            if self.state in (_WAITING, _PROBING):
                self._on_resend(self._ledger.acked + 1, now_s)
        elif isinstance(reply, Unrecognised):
            self._events.append(reply)
            self._doubt(now_s)
        else:
            self._events.append(reply)
            if isinstance(reply, TemperatureReport) and self._ledger.slow_under_way:
                self._listen_anew(now_s)  # the reports of M109 and M190

    def _on_ok(self, ok: Ok, now_s: float) -> None:
        self._events.extend(ok.more)  # type: ignore[arg-type]
        if self.state is _GREETING:
            self._go(Signal.GREETED)
            self._probing_since_s = None
            self._events.append(Greeted())
            return
        if self.state is _REWINDING:
            # The ok that most firmwares send with a resend request (not all: Marlin 2.0.x).
            # With one line under way nothing else can come: go on at once.
            if self._ledger.cursor - 1 - self._ledger.acked <= 1:
                self._rewind_at_once = True
            self._spare("belongs to a resend request")
            return
        if self.state not in (_WAITING, _PROBING):
            self._spare("nothing was under way")
            return
        if now_s < self._swallow_until_s:
            self._swallow_until_s = -1.0
            self._spare("belongs to a stale resend request")
            return
        self._swallow_until_s = -1.0
        number = self._belief.of_ok(ok.number, self._ledger)
        if number is None:
            self._spare(f"line {ok.number} was acknowledged before")
            self._doubt(now_s)
        else:
            self._acknowledge(number, now_s)

    def _acknowledge(self, number: int, now_s: float) -> None:
        ledger, belief = self._ledger, self._belief
        if self.state is _PROBING:
            # The line was sent twice; one copy earned this ok, the other may earn a request
            # for the next line, which must not be served.
            belief.stale = ledger.cursor
        ledger.acknowledge(number)
        belief.progress()
        self._probing_since_s = None
        self._events.append(Acknowledged(number))
        if number == ledger.last:
            self._go(_DRAINED)
            self._deadline_s = NEVER_S
            return
        self._go(_ACKED)
        self._transmit()
        self._listen_anew(now_s)

    def _on_resend(self, number: int, now_s: float) -> None:
        if not self.dialect.verifies or Signal.RESEND not in TRANSITIONS[self.state]:
            self._events.append(ResendRequested(number, served=False))
            if self.state is _GREETING:
                self._deadline_s = min(self._deadline_s, now_s + self.timing.resend_grace_s)
            elif not self.dialect.verifies and not self.ended:
                self._lose(f"the printer asked for line {number}, which may be executed already")
            return
        rewinding = self.state is _REWINDING
        verdict, why = self._belief.of_resend(number, self._ledger, rewinding=rewinding)
        if verdict is Verdict.SERVE:
            self._serve(number, now_s)
        elif verdict is Verdict.ECHO:
            self._events.append(ResendRequested(number, served=False))
        else:
            self._events.append(ResendRefused(number, why))
        if verdict is Verdict.END:
            self._lose(why)
        elif verdict is not Verdict.SERVE:
            # The request itself may be garbled: ask again before believing it.
            self._swallow_until_s = now_s + self.timing.resend_grace_s
            self._doubt(now_s)

    def _serve(self, number: int, now_s: float) -> None:
        """Make ready to send again from line `number`, once older answers are in."""
        ledger = self._ledger
        if number <= ledger.last:
            self.resends += 1
        self._events.append(ResendRequested(number, served=True))
        if number - 1 > ledger.acked:
            self._events.append(Acknowledged(number - 1))
        ledger.expect_again(number)
        self._rewind_until_s = now_s + self.timing.resend_grace_s
        self._rewind_at_once = False
        self._go(Signal.RESEND)

    def _rewind(self, now_s: float) -> None:
        """Send again from the line asked for, now that all older answers are in."""
        ledger = self._ledger
        self._rewind_at_once = False
        self._swallow_until_s = -1.0
        ledger.rewind()
        if ledger.cursor > ledger.last:
            self._belief.stale = None
            self._probing_since_s = None
            self._go(_DRAINED)
            self._deadline_s = NEVER_S
            return
        self._go(Signal.REWOUND)
        self._belief.stale = ledger.cursor + 1
        self._transmit()
        self._listen_anew(now_s)

    def _on_reset(self, reset: PrinterReset, now_s: float) -> None:
        if self.state is _GREETING:
            self._go(Signal.RESET)
            self._deadline_s = min(self._deadline_s, now_s + self.timing.resend_grace_s)
        elif self.state not in (State.UNGREETED, State.LOST):
            self._lose(f"the printer started anew ({reset.banner})", Signal.RESET)

    # ------------------------------------------------------------------ time

    def _silence(self, now_s: float) -> None:
        since_s = self._probing_since_s
        if since_s is None:
            since_s = self._probing_since_s = self._heard_s
        slow = self._ledger.slow_under_way
        limit_s = self.timing.slow_give_up_s if slow else self.timing.give_up_s
        if now_s - since_s >= limit_s:
            self._lose(f"no answer to line {self._ledger.acked + 1} for {now_s - since_s:.1f} s")
            return
        if not self.dialect.verifies:
            # Nothing can be sent twice here: wait, and in the end stop.
            self._deadline_s = since_s + limit_s
            return
        number = self._ledger.cursor - 1
        self._out += self._ledger.data(number)
        self.probes += 1
        self._events.append(Probed(number))
        self._go(Signal.SILENCE)
        self._deadline_s = now_s + min(self._silence_s(), max(limit_s / 8, self.timing.doubt_s))

    def _greet_again(self, now_s: float) -> None:
        if now_s - self._hello_at_s >= self.timing.give_up_s:
            self._lose("the printer does not answer to M110")
        else:
            self._out += self._hello_bytes(now_s)

    def _silence_s(self) -> float:
        slow = self._ledger.slow_under_way
        return self.timing.slow_silence_s if slow else self.timing.silence_s

    def _listen_anew(self, now_s: float) -> None:
        self._heard_s = now_s
        self._probing_since_s = None
        self._deadline_s = now_s + self._silence_s()

    def _doubt(self, now_s: float, after_s: float | None = None) -> None:
        """Something is odd: wait only shortly before asking again."""
        if self.state in (_WAITING, _PROBING):
            wait_s = self.timing.doubt_s if after_s is None else after_s
            self._deadline_s = min(self._deadline_s, now_s + wait_s)

    # ------------------------------------------------------------------ small parts

    def _transmit(self) -> None:
        """Put lines that wait to be sent (again) on the wire, as far as the window allows."""
        ledger = self._ledger
        while ledger.cursor <= ledger.last and ledger.cursor - 1 - ledger.acked < self.window:
            self._out += ledger.next_again()

    def _spare(self, why: str) -> None:
        self.spare_oks += 1
        self._events.append(SpareOk(why))

    def _lose(self, why: str, signal: Signal = Signal.GIVE_UP) -> None:
        self._go(signal)
        self._deadline_s = NEVER_S
        self._out.clear()
        self._events.append(LinkLost(why, self._ledger.acked, self._ledger.last))

    def _go(self, signal: Signal) -> None:
        try:
            self.state = TRANSITIONS[self.state][signal]
        except KeyError:
            raise LocalProtocolError(
                f"{signal.value!r} is not possible while the link is {self.state.value}."
            ) from None
