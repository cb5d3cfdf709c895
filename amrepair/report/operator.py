"""`Operator`: a person's word, waited for by the loop and given by buttons of any kind.

It knows threads and nothing of windows: `live` puts buttons on it, tests call it directly.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from enum import StrEnum


class OperatorAnswer(StrEnum):
    """What an operator says of a repair."""

    APPROVE = "approve"
    SKIP = "skip"


class Operator:
    """One question at a time; pausing holds the answer back until the pause ends.

    Parameters
    ----------
    on_pause, on_resume
        Called from the thread that presses the button: `Printer.pause` and `Printer.resume`.
    changed
        Called after every change, so that whoever draws can draw it.

    Attributes
    ----------
    asked, paused
        Whether a question waits for an answer, and whether the run rests.
    """

    def __init__(
        self,
        *,
        on_pause: Callable[[], None] = lambda: None,
        on_resume: Callable[[], None] = lambda: None,
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self.on_pause, self.on_resume, self.changed = on_pause, on_resume, changed
        self._state = threading.Condition()
        self.asked = False
        self.paused = False
        self._closed = False
        self._verdict: OperatorAnswer | None = None

    def ask(self) -> OperatorAnswer:
        """Wait until somebody decides; a view that is closed means skip."""
        with self._state:
            self.asked, self._verdict = True, None
        self.changed()
        with self._state:
            self._state.wait_for(
                lambda: self._closed or (self._verdict is not None and not self.paused)
            )
            verdict = self._verdict or OperatorAnswer.SKIP
            self.asked, self._verdict = False, None
        self.changed()
        return verdict

    def decide(self, verdict: OperatorAnswer) -> bool:
        """Answer the question that waits; False where none does: a late click decides nothing."""
        with self._state:
            if not self.asked or self._verdict is not None:
                return False
            self._verdict = verdict
            self._state.notify_all()
        return True

    def toggle_pause(self) -> bool:
        """Rest, or go on; returns whether it rests now.

        What the printer says to it is the caller's; the run rests all the same before its next
        part.
        """
        with self._state:
            self.paused = not self.paused
            resting = self.paused
            self._state.notify_all()
        try:
            (self.on_pause if resting else self.on_resume)()
        finally:
            self.changed()
        return resting

    def wait_while_paused(self) -> None:
        """Return at once, or when the pause ends."""
        with self._state:
            self._state.wait_for(lambda: self._closed or not self.paused)

    def close(self) -> None:
        """Nobody will answer any more."""
        with self._state:
            self._closed = True
            self._state.notify_all()
