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
that allows: an answer that makes no sense is asked for again. With any other firmware no line is
ever sent twice.

What it does not do: judge G-code, know what a job is, retry by reopening, or sleep.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from gcode.errors import LocalProtocolError
from gcode.protocol.belief import ResendVerdict
from gcode.protocol.events import (
    Busy,
    CommandFailed,
    Echo,
    Event,
    Greeted,
    LineError,
    Ok,
    PositionReport,
    PrinterReset,
    Resend,
    ResendRefused,
    ResendRequested,
    ShutDown,
    TemperatureReport,
    UnknownCommand,
    Unrecognised,
    Waiting,
)
from gcode.protocol.lines import WireLine, WireLines, wire_line
from gcode.protocol.recovery import NEVER_S, Recovery
from gcode.protocol.replies import parse_reply, repeats
from gcode.protocol.transitions import TRANSITIONS, Signal, State

PLAIN_OK = b"ok\n"
"""The answer that nearly every line gets."""
_OKS = re.compile(rb"(?:ok N\d{1,10} P\d+ B\d+\n)+")
_OK_NUMBER = re.compile(rb"N(\d+)")

_MOVES = frozenset(("G0 ", "G1 ", "G2 ", "G3 "))

# Looked up once: Python 3.11 takes 0.1 µs to find a member of an enumeration, ten times a line.
_GREETING, _IDLE_STATE, _WAITING = State.GREETING, State.IDLE, State.WAITING
_REWINDING, _PROBING_STATE, _ASKING = State.REWINDING, State.PROBING, State.ASKING
_SENT_SIGNAL = Signal.SENT


class Link(Recovery):
    """One conversation with one printer.

    Parameters
    ----------
    dialect
        A name of `LINK_DIALECTS` or a dialect of the caller's own.
    window
        Most lines under way at once; 1 unless the printer is known to buffer (ADVANCED_OK).
    """

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
        if self.state is _IDLE_STATE:
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
    def slow_under_way(self) -> bool:
        """Whether a line that may take minutes is not acknowledged yet."""
        return self._ledger.slow_under_way

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

    def prepare(self, commands: Sequence[str]) -> WireLines:
        """Make what `send` and `moves` take out of the commands that come next, all at once.

        It promises nothing: where another line comes between, `send` numbers anew; what the
        dialect cannot carry is refused when its turn comes.
        """
        return WireLines(self._ledger.last + 1, commands, self.dialect)

    def moves(self, lines: WireLines, index: int) -> list[bytes]:
        """Return what may be written of the plain moves that follow, one after another.

        The fast path, which costs nothing between two lines: as long as the answers are `oks`
        and nothing else, as many may be under way as the window allows. Whatever happens,
        `moves_sent` has to be told before anything else is asked of the link. Empty where `send`
        must have its turn: lines under way, something in doubt, a command that is no plain move.
        """
        if (
            self.state is not _IDLE_STATE
            or lines.first + index != self._ledger.last + 1
            or self._swallow_until_s >= 0
            or not self._inbox.empty
        ):
            return []
        return lines.moves_from(index)

    def oks(self, data: bytes, answered: int) -> int:
        """How many acknowledgements `data` is, after `answered` of moves; 0 where it is not only.

        Those with numbers (ADVANCED_OK) must name the lines that are next.
        """
        count = data.count(b"\n")
        if data == PLAIN_OK * count:
            return count
        if not _OKS.fullmatch(data):
            return 0
        first = self._ledger.last + 1 + answered
        numbers = [int(number) for number in _OK_NUMBER.findall(data)]
        return count if numbers == list(range(first, first + count)) else 0

    def moves_sent(self, written: Sequence[bytes], answered: int, now_s: float) -> None:
        """Take note of moves written, and of how many were acknowledged.

        Parameters
        ----------
        written
            The first of what `moves` returned; a line that may have been written counts.
        now_s
            When the last was written or acknowledged, whatever came last.
        """
        self._ledger.add_moves(written, answered)
        self._moved = True
        if answered:
            self._belief.progress()
            self._probing_since_s = None
        if answered < len(written) and self.state is _IDLE_STATE:
            self.state = TRANSITIONS[_IDLE_STATE][_SENT_SIGNAL]
            self._listen_anew(now_s)

    def send(self, command: str | WireLine, now_s: float) -> bytes:
        """Give the next line its number and return the bytes to write.

        Raises
        ------
        LocalProtocolError
            If the link is not `ready`, or the command cannot be carried by this dialect.
        """
        ledger = self._ledger
        if self.state is not _IDLE_STATE and not self.ready:
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
        self._moved = self._moved or line.command[:3] in _MOVES
        self.state = TRANSITIONS[self.state][_SENT_SIGNAL]
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
        if state is _WAITING or state is _PROBING_STATE:
            return min(self._deadline_s, self._half_line_s)
        if state is _GREETING or state is _ASKING:
            return self._deadline_s
        return self._rewind_until_s if state is _REWINDING else NEVER_S

    def confirm(self) -> None:
        """Take note that the printer proved to have received every line sent so far.

        For a caller who has seen an answer that only the last line can have caused.
        """
        if self.idle:
            self._belief.confirm(self._ledger.last)

    def ask_place(self, now_s: float) -> bytes:
        """Ask the printer which line it took last: a line that must bounce, which changes nothing.

        Until the answer makes sense it is asked again. `Proved` tells that every line was
        received; lines that were not are sent again, and then it may be asked anew.

        Raises
        ------
        LocalProtocolError
            If lines are under way, or the firmware verifies no numbers.
        """
        if not self.dialect.verifies:
            raise LocalProtocolError(f"{self.dialect.name} verifies no line numbers.")
        self._go(Signal.ASK)
        self._questions, self._heard_s = 0, now_s
        self._said_last = self._belief.told_place = None
        self._ask_place(now_s)
        return self.take_output()

    def ask_soon(self, now_s: float) -> None:
        """Ask again in a moment: the caller may have lost an answer itself (an interrupt)."""
        self._doubt(now_s)

    def receive(self, data: bytes, now_s: float) -> list[Event]:
        """Take bytes from the printer and return what they mean; any bytes at all are fine."""
        if self.state is _ASKING:
            self._questions, self._heard_s = self._questions + 1, now_s
        for raw, readable in self._inbox.take(data):
            if readable:
                self._reply(raw, now_s)
            else:
                self._events.append(Unrecognised(raw))
                self._doubt(now_s)
        if self._inbox.empty:
            self._half_line_s = NEVER_S
        elif self._half_line_s == NEVER_S:  # an ok that lost its end is followed by nothing
            self._half_line_s = now_s + self.timing.doubt_s
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
        elif self.state is _ASKING:
            self._ask_place(now_s)
        elif self.state in (_WAITING, _PROBING_STATE):
            self._silence(now_s)
        events, self._events = self._events, []
        return events

    # ------------------------------------------------------------------ what the printer says

    def _reply(self, raw: bytes, now_s: float) -> None:
        reply = parse_reply(raw)
        if isinstance(reply, Unrecognised | Echo) and self._is_refusal(raw):
            reply = CommandFailed(raw.decode("latin-1").strip(), fatal=False)
        if isinstance(reply, Ok):
            self._on_ok(reply, now_s)
        elif isinstance(reply, Resend):
            self._on_resend(reply.number, now_s)
        elif isinstance(reply, Busy):
            self._events.append(reply)
            self._says_busy = True
            self._listen_anew(now_s)
        elif isinstance(reply, Waiting):
            self._events.append(reply)
            # It has nothing to do, yet owes us an ok; one that is under way gets a moment.
            self._doubt(now_s, self.timing.resend_grace_s)
        elif isinstance(reply, LineError):
            self._events.append(reply)
            self._said_last = reply.last
            if self.state is _GREETING:
                self._refuse_greeting(now_s)
            elif self.dialect.verifies:  # the request that follows may be garbled, its `ok` not
                self._swallow_until_s = now_s + self.timing.resend_grace_s
            # Some ask for no resend (OctoPrint#2226); the others' request follows at once.
            self._doubt(now_s, self.timing.resend_grace_s)
        elif isinstance(reply, PrinterReset):
            self._events.append(reply)
            self._on_reset(reply, now_s)
        elif isinstance(reply, ShutDown):
            self._events.append(reply)
            if self.state not in (State.UNGREETED, _GREETING) and not self.ended:
                self._shut_down = True
                self._out += b"\n"  # answered with the cause, as anything is from now on
        elif isinstance(reply, CommandFailed):
            why = f"Klipper has shut down: {reply.text}" if self._shut_down else reply.text
            fatal = reply.fatal or self._shut_down
            self._events.append(CommandFailed(why, fatal, self._ledger.acked))
            self._ledger.fail()
            if fatal and Signal.HALT in TRANSITIONS[self.state]:
                self._go(Signal.HALT)
        elif isinstance(reply, UnknownCommand) and "*" in reply.text:
            # A numbered line whose N was lost: taken for a command without number, checksum
            # and all, and answered with ok. It must be sent again.
            self._events.append(reply)
            if self.state in (_WAITING, _PROBING_STATE):
                self._on_resend(self._ledger.acked + 1, now_s)
        elif isinstance(reply, Unrecognised):
            self._events.append(reply)
            self._doubt(now_s)
        else:
            self._events.append(reply)
            if isinstance(reply, PositionReport) and self._asked_question:
                self._on_answer(reply, now_s)
            elif isinstance(reply, TemperatureReport) and self._ledger.slow_under_way:
                self._listen_anew(now_s)  # the reports of M109 and M190

    def _is_refusal(self, raw: bytes) -> bool:
        """Whether a damaged text repeats the line under way, where no number would tell.

        RepRapFirmware says so of what it cannot read, and `ok` after it.
        """
        if self.dialect.verifies or not self.dialect.numbered or self.state is not _WAITING:
            return False
        return repeats(raw, self._ledger.data(self._ledger.acked + 1))

    def _on_ok(self, ok: Ok, now_s: float) -> None:
        self._events.extend(ok.more)  # type: ignore[arg-type]
        self._said_last = None
        if self.state is _GREETING and now_s < self._swallow_until_s:
            self._swallow_until_s = -1.0
            self._spare("belongs to a greeting that was refused")
            return
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
        if self.state not in (_WAITING, _PROBING_STATE):
            self._spare("nothing was under way")
            return
        if self._asked_question:
            self._spare("the answer to a question tells more")
            self._hear_out(now_s)
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

    def _on_resend(self, number: int, now_s: float) -> None:
        said_last, self._said_last = self._said_last, None
        if not self.dialect.verifies or Signal.RESEND not in TRANSITIONS[self.state]:
            self._events.append(ResendRequested(number, served=False))
            if self.state is _GREETING:
                self._refuse_greeting(now_s)
            elif not self.dialect.verifies and not self.ended:
                self._lose(f"the printer asked for line {number}, which may be executed already")
            return
        if self.state is _ASKING:
            self._on_place(number, said_last, now_s)
            return
        rewinding = self.state is _REWINDING
        verdict, why = self._belief.of_resend(
            number, self._ledger, rewinding=rewinding, said_last=said_last
        )
        if verdict is ResendVerdict.SERVE:
            self._serve(number, now_s)
        elif verdict is ResendVerdict.ECHO:
            self._events.append(ResendRequested(number, served=False))
        else:
            self._events.append(ResendRefused(number, why))
        if verdict is ResendVerdict.END:
            self._lose_place(number, why)
        elif verdict is not ResendVerdict.SERVE:
            # The request itself may be garbled: ask again before believing it.
            self._swallow_until_s = now_s + self.timing.resend_grace_s
            self._doubt(now_s)
