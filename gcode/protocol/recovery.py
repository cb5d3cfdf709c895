"""What a link does where an answer is missing, odd or unwelcome: ask again, rewind, end.

It holds what one conversation has come to; what is said and what is sent is the business of
`link`. Nothing is ever sent again here but under its own number.
"""

from __future__ import annotations

from gcode.errors import LocalProtocolError
from gcode.protocol.belief import Belief, ResendVerdict
from gcode.protocol.dialects import LINK_DIALECTS, LinkDialect
from gcode.protocol.events import (
    Acknowledged,
    Event,
    LinkLost,
    PositionReport,
    PrinterReset,
    Probed,
    Proved,
    ResendRefused,
    ResendRequested,
    SpareOk,
)
from gcode.protocol.inbox import Inbox
from gcode.protocol.ledger import Ledger
from gcode.protocol.lines import numbered
from gcode.protocol.timing import LinkTiming
from gcode.protocol.transitions import TRANSITIONS, Signal, State

NEVER_S = float("inf")
_BOUNCES_AHEAD = 8
"""So far is the number of a line that must bounce ahead of the next one."""


class Recovery:
    """The state of one conversation, and its ways out of trouble; see `Link`."""

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
        self.ended_by = ""
        self.resends = 0
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
        self._says_busy = False
        self._deadline_s = self._half_line_s = NEVER_S
        self._probing_since_s: float | None = None
        self._said_last: int | None = None
        self._questions = 0
        self._answered = False  # the dialect's question
        self._moved = self._shut_down = self._reset = False
        self._told: PositionReport | None = None

    @property
    def idle(self) -> bool:
        """Whether every line sent is acknowledged and nothing is in doubt."""
        return self.state is State.IDLE

    @property
    def ended(self) -> bool:
        """Whether the link has ended (`LOST`, `HALTED`) and only `hello` leads on."""
        return self.state is State.LOST or self.state is State.HALTED

    @property
    def forgot(self) -> bool:
        """Whether the printer has stopped or started anew: what waited in its buffers is gone."""
        return self._reset or self.state is State.HALTED

    def give_up(self, why: str, *, stopped: bool = False) -> list[Event]:
        """End the link for a reason of the caller's (the port is gone, an error was seen).

        With `stopped` the printer was told to stop at once.
        """
        self._reset = self._reset or stopped
        if self.state not in (State.UNGREETED, State.HALTED, State.LOST):
            self._lose(why)
        events, self._events = self._events, []
        return events

    # ------------------------------------------------------------------ again

    def _hello_bytes(self, now_s: float) -> bytes:
        self._deadline_s = now_s + self.timing.doubt_s * 5
        if not self.dialect.numbered:
            return b"\nM105\n"
        # The newline ends whatever half line a dead sender left in the printer's buffer.
        number = self._ledger.last
        return b"\n" + numbered(number, b"M110 N%d" % number)

    def _refuse_greeting(self, now_s: float) -> None:
        """Take the hello itself for damaged: the `ok` that follows is none of its own."""
        self._swallow_until_s = now_s + self.timing.resend_grace_s
        self._deadline_s = min(self._deadline_s, now_s + self.timing.resend_grace_s)

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

    def _on_place(self, number: int, said_last: int | None, now_s: float) -> None:
        """Take the answer to the question which line the printer is at.

        Only one that says it twice, by the last line and by the next, or the same as the answer
        before, is believed.
        """
        ledger, belief = self._ledger, self._belief
        certain = number == belief.told_place if said_last is None else said_last + 1 == number
        belief.told_place = number
        judgement = belief.of_resend(number, ledger, rewinding=True, said_last=said_last)
        if judgement.verdict is ResendVerdict.SERVE and certain:
            if number == ledger.last + 1:
                belief.confirm(ledger.last)
                self._events.append(Proved(ledger.last))
            self._serve(number, now_s)
        elif judgement.verdict is ResendVerdict.END:
            self._events.append(ResendRefused(number, judgement.why))
            self._lose_place(number, judgement.why)
        else:
            self._events.append(ResendRefused(number, judgement.why or "it said so once only"))
            self._deadline_s = now_s + self.timing.resend_grace_s

    def _ask_place(self, now_s: float) -> None:
        """Put a line on the wire that must bounce; its refusal tells what was taken last.

        Answers that are damaged are counted; one that says nothing is given time, as everywhere.
        """
        silent_s = now_s - self._heard_s
        if self._questions >= self.timing.max_questions or silent_s >= self.timing.give_up_s:
            self._lose("the printer does not say which line it took last")
            return
        self._out += b"\n" + numbered(self._ledger.last + 1 + _BOUNCES_AHEAD, b"M105")
        wait_s = min(max(silent_s, self.timing.doubt_s), self.timing.silence_s)
        self._deadline_s = now_s + wait_s

    def _rewind(self, now_s: float) -> None:
        """Send again from the line asked for, now that all older answers are in."""
        ledger = self._ledger
        self._rewind_at_once = False
        self._swallow_until_s = -1.0
        ledger.rewind()
        if ledger.cursor > ledger.last:
            self._belief.stale = None
            self._probing_since_s = None
            self._go(Signal.DRAINED)
            self._deadline_s = NEVER_S
            return
        self._go(Signal.REWOUND)
        self._belief.stale = ledger.cursor + 1
        self._out += b"\n"  # ends a half line, should the one before have lost its end
        self._transmit()
        self._listen_anew(now_s)

    def _on_reset(self, reset: PrinterReset, now_s: float) -> None:
        if self.state is State.GREETING:
            self._go(Signal.RESET)
            self._deadline_s = min(self._deadline_s, now_s + self.timing.resend_grace_s)
        elif self.state not in (State.UNGREETED, State.LOST):
            self._reset = True
            self._lose(f"the printer started anew ({reset.banner})", Signal.RESET)

    # ------------------------------------------------------------------ time

    def _silence(self, now_s: float) -> None:
        self._half_line_s = NEVER_S
        if self._answered:
            self._acknowledge(self._ledger.last, now_s)
            return
        since_s = self._probing_since_s
        if since_s is None:
            since_s = self._probing_since_s = self._heard_s
        slow = self._ledger.slow_under_way
        limit_s = self.timing.slow_give_up_s if slow else self.timing.give_up_s
        if now_s - since_s >= limit_s:
            self._lose(f"no answer to line {self._ledger.acked + 1} for {now_s - since_s:.1f} s")
            return
        number = self._ledger.cursor - 1
        if self.dialect.verifies:
            self._out += b"\n" + self._ledger.data(number)
        elif self.dialect.question and self.window == 1:
            self._out += 2 * (self.dialect.question + b"\n")
        else:
            # Nothing can be sent twice here, nor proved: wait, and in the end stop.
            self._deadline_s = since_s + limit_s
            return
        self._events.append(Probed(number))
        self._told = None
        self._go(Signal.SILENCE)
        self._deadline_s = now_s + min(self._silence_s(), max(limit_s / 8, self.timing.doubt_s))

    @property
    def _asked_question(self) -> bool:
        """Whether the dialect's question is under way, so that an `ok` may belong to it."""
        return self.state is State.PROBING and not self.dialect.verifies

    def _on_answer(self, report: PositionReport, now_s: float) -> None:
        """Take an answer to the dialect's question.

        A firmware that started anew is at zero: after a move that is no proof of anything. Two
        answers must agree, as none has a checksum.
        """
        before, self._told = self._told, report
        if report != before:
            return
        at_zero = not any((report.x_mm, report.y_mm, report.z_mm, report.e_mm))
        self._answered = self._answered or not (at_zero and self._moved)
        self._hear_out(now_s)

    def _hear_out(self, now_s: float) -> None:
        """Wait until everything is said that was asked for."""
        if self._answered:
            self._deadline_s = now_s + self.timing.resend_grace_s

    def _greet_again(self, now_s: float) -> None:
        if now_s - self._hello_at_s >= self.timing.give_up_s:
            self._lose("the printer does not answer to M110")
        else:
            self._out += self._hello_bytes(now_s)

    def _silence_s(self) -> float:
        slow = self._ledger.slow_under_way
        usual_s = self.timing.slow_silence_s if slow else self.timing.silence_s
        return min(usual_s, self.timing.busy_silence_s) if self._says_busy else usual_s

    def _listen_anew(self, now_s: float) -> None:
        self._heard_s = now_s
        self._probing_since_s = None
        self._deadline_s = now_s + self._silence_s()

    def _acknowledge(self, number: int, now_s: float) -> None:
        ledger, belief = self._ledger, self._belief
        if self.state is State.PROBING and self.dialect.verifies:
            # The line was sent twice; one copy earned this ok, the other may earn a request
            # for the next line, which must not be served.
            belief.stale = ledger.cursor
        ledger.acknowledge(number)
        belief.progress()
        self._probing_since_s = None
        self._answered = False
        self._events.append(Acknowledged(number))
        if number == ledger.last:
            self._go(Signal.DRAINED)
            self._deadline_s = NEVER_S
            return
        self._go(Signal.ACKED)
        self._transmit()
        self._listen_anew(now_s)

    def _doubt(self, now_s: float, after_s: float | None = None) -> None:
        """Something is odd: wait only shortly before asking again."""
        if self.state in (State.WAITING, State.PROBING):
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
        self.ended_by = why
        self._deadline_s = NEVER_S
        self._out.clear()
        self._events.append(LinkLost(why, self._ledger.acked, self._ledger.last))

    def _lose_place(self, number: int, why: str) -> None:
        """End the link over a request for a line.

        Who wants one again that it is proved to have taken has started anew without a word.
        """
        self._reset = self._reset or number <= self._belief.proven
        self._lose(why)

    def _go(self, signal: Signal) -> None:
        try:
            self.state = TRANSITIONS[self.state][signal]
        except KeyError:
            raise LocalProtocolError(
                f"{signal.value!r} is not possible while the link is {self.state.value}."
            ) from None
