"""Which of a printer's claims are believed: requests for a line, numbers in an `ok`.

A claim may be an echo of what is settled, garbled, or out of a firmware's own confusion. What is
believed can only ever send a line again under its own number, or end the link. A claim that makes
no sense is asked again: noise says something else the next time, a printer that has lost its place
says the same.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from gcode.protocol.ledger import Ledger
from gcode.protocol.timing import LinkTiming


class ResendVerdict(Enum):
    """What is to be done about a resend request."""

    SERVE = "serve"
    ECHO = "echo"
    REFUSE = "refuse"
    END = "end the link"


class Judgement(NamedTuple):
    """A verdict and its reason."""

    verdict: ResendVerdict
    why: str = ""


class Belief:
    """What one conversation has shown so far of a printer's word.

    Attributes
    ----------
    proven
        Received for certain: cannot be asked for again.
    stale
        A request for this number may be an echo: of a line that was sent twice.
    told_place
        The line that the printer asked for last when it was asked which.
    """

    __slots__ = (
        "_last",
        "_number_faults",
        "_refused",
        "_refused_at",
        "_refused_number",
        "_refused_same",
        "_same",
        "_timing",
        "proven",
        "stale",
        "told_place",
    )

    def __init__(self, timing: LinkTiming, number: int = 0) -> None:
        self._timing = timing
        self.proven = number
        self.stale: int | None = None
        self.told_place: int | None = None
        self._last = -1
        self._same = self._refused = self._refused_at = self._number_faults = 0
        self._refused_number: int | None = None
        self._refused_same = 0

    def confirm(self, number: int) -> None:
        """Take note of a proof that the printer has received every line up to `number`."""
        self.proven = number
        self._refused = self._refused_same = self._number_faults = 0
        self.stale = self.told_place = None

    def progress(self) -> None:
        """Take note that a line was acknowledged."""
        self._same = 0

    def of_resend(
        self, number: int, ledger: Ledger, *, rewinding: bool, said_last: int | None = None
    ) -> Judgement:
        """Judge a request for line `number`.

        Parameters
        ----------
        rewinding
            One is being served.
        said_last
            The line that the printer has just said it took last.
        """
        if not rewinding and number == self.stale and number < ledger.cursor:
            self.stale = None
            return Judgement(ResendVerdict.ECHO)
        if said_last is not None and said_last + 1 != number:
            return self._refusal(
                f"the printer took line {said_last} last and asks for {number}", None, ledger
            )
        if (why := self._why_impossible(number, ledger)) is not None:
            return self._refusal(why, number, ledger)
        if number != self._last:
            self._same = 0
        if not rewinding:  # a burst of requests counts once
            self._same += 1
        self._last = number
        if self._same > self._timing.max_resends:
            return Judgement(
                ResendVerdict.END,
                f"the printer asked for line {number} {self._same} times in a row",
            )
        return Judgement(ResendVerdict.SERVE)

    def _why_impossible(self, number: int, ledger: Ledger) -> str | None:
        if number > ledger.last + 1:
            return f"line {number} was never sent, the last is {ledger.last}"
        if number <= self.proven:
            return f"line {number} is proved to be received: the printer has lost its place"
        if number <= ledger.last - ledger.kept:
            return f"line {number} is not in the last {ledger.kept} lines any more"
        return None

    def _refusal(self, why: str, number: int | None, ledger: Ledger) -> Judgement:
        if ledger.acked - self._refused_at >= 2:
            self._refused = self._refused_same = 0  # it has made progress since: noise
        same = number is not None and number == self._refused_number
        self._refused_same = self._refused_same + 1 if same else 1
        self._refused_number = number
        self._refused_at = ledger.acked
        self._refused += 1
        ends = (
            self._refused >= self._timing.max_refused
            or self._refused_same >= self._timing.max_refused_same
        )
        return Judgement(ResendVerdict.END if ends else ResendVerdict.REFUSE, why)

    def of_ok(self, number: int | None, ledger: Ledger) -> int | None:
        """The line that an `ok` acknowledges; None if that was acknowledged before.

        Parameters
        ----------
        number
            What the `ok` itself says (ADVANCED_OK): it can be wrong (Marlin#2952), and after a
            few contradictions is not looked at any more.
        """
        if number is not None and self._number_faults <= self._timing.max_refused:
            if number <= ledger.acked:
                self._number_faults += 1
                return None
            if number < ledger.cursor:
                return number
            self._number_faults += 1
        return ledger.acked + 1
