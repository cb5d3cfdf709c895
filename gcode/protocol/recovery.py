"""What a link does where an answer is missing, odd or unwelcome: ask again, rewind, end.

It holds what one conversation has come to; what is said and what is sent is the business of
`link`. Nothing is ever sent again here but under its own number.
"""

from __future__ import annotations

from gcode.errors import LocalProtocolError
from gcode.protocol.belief import Belief
from gcode.protocol.dialects import LINK_DIALECTS, LinkDialect
from gcode.protocol.events import (
    Acknowledged,
    Event,
    LinkLost,
    PrinterReset,
    Probed,
    ResendRequested,
    SpareOk,
)
from gcode.protocol.inbox import Inbox
from gcode.protocol.ledger import Ledger
from gcode.protocol.lines import numbered
from gcode.protocol.timing import LinkTiming
from gcode.protocol.transitions import TRANSITIONS, Signal, State

NEVER_S = float("inf")


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

    @property
    def idle(self) -> bool:
        """Whether every line sent is acknowledged and nothing is in doubt."""
        return self.state is State.IDLE

    @property
    def ended(self) -> bool:
        """Whether the link has ended (`LOST`, `HALTED`) and only `hello` leads on."""
        return self.state is State.LOST or self.state is State.HALTED

    def give_up(self, why: str) -> list[Event]:
        """End the link for a reason of the caller's (the port is gone, an error was seen)."""
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
            self._go(Signal.DRAINED)
            self._deadline_s = NEVER_S
            return
        self._go(Signal.REWOUND)
        self._belief.stale = ledger.cursor + 1
        self._transmit()
        self._listen_anew(now_s)

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
