"""Tells and asks at the printer, on whatever screens it has (`screens`)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

from amrepair.agent.screens import Button, Screens
from amrepair.errors import LoopError
from gcode.errors import GcodeError, LinkError

TALK_POLL_S = 0.5
NO_PRINT_YET = "waiting for a print"
_QUIET = frozenset({"print", "printing"})  # the printer's own screens show how far that is


@runtime_checkable
class Host(Protocol):
    """The printer, as far as it is spoken to."""

    def rests_at_look(self) -> bool:
        """Whether its job rests where it asks for a look."""

    def calls(self, wait_s: float) -> list[dict[str, Any]]:
        """What people have asked for there; waits for some."""


class Talk:
    """Progress, messages and questions at the printer.

    Parameters
    ----------
    host
        Connected.
    screens
        Its own.
    note
        Called with every message besides, for whoever reads the agent's own output.
    """

    def __init__(self, host: Host, screens: Screens, note: Callable[[str], None]) -> None:
        self._host, self._screens, self._note = host, screens, note
        self._doing = NO_PRINT_YET
        self._number = 0
        self._answers = threading.Condition()
        self._open, self._answer = False, False
        self._answered = False
        self._ended = threading.Event()
        self._hears = threading.Thread(target=self._hear, daemon=True, name="calls")

    def listen(self) -> None:
        """Answer what people ask for from now on, in a thread."""
        self._hears.start()

    def close(self) -> None:
        """Answer no more."""
        self._ended.set()
        if self._hears.is_alive():
            self._hears.join(timeout=5.0)

    # ------------------------------------------------------------------ telling

    def progress(self, stage: str, done: float, total: float) -> None:
        """Tell of a stage once it begins."""
        new, self._doing = stage != self._doing, stage
        if new and stage not in _QUIET:
            if stage.startswith("scan"):
                self.end_prompt()  # nobody waits any more
            self._told(lambda: self._screens.stage(stage))

    def rest(self) -> None:
        """Nothing is being done."""
        self._doing = NO_PRINT_YET

    def say(self, text: str, *, wrong: bool = False) -> None:
        """One sentence, in the printer's console and on its display."""
        self._note(text)
        self._told(lambda: self._screens.say(text, wrong=wrong))

    def prompt(self, lines: Sequence[str], buttons: Sequence[Button]) -> None:
        """A window on the printer's screens."""
        self._told(lambda: self._screens.prompt(lines, buttons))

    def end_prompt(self) -> None:
        """Take the window away."""
        self._told(self._screens.end_prompt)

    def _told(self, tell: Callable[[], None]) -> None:
        """Told as well as can be: what is not heard changes nothing of what is done."""
        try:
            tell()
        except GcodeError as error:
            self._note(f"(not told at the printer: {error})")

    # ------------------------------------------------------------------ asking

    def ask(self, question: str, lines: Sequence[str]) -> bool:
        """Ask at the printer, and wait for an answer.

        Raises
        ------
        LoopError
            If the print goes on or ends meanwhile: then nothing is left to be asked.
        """
        with self._answers:
            self._number += 1
            self._open, self._answered = True, False
        answer = {"what": "approve", "question": self._number}
        buttons = [
            Button("Yes", {**answer, "answer": "yes"}, "primary"),
            Button("No", {**answer, "answer": "no"}, "warning"),
        ]
        self.say(question)
        self.prompt([question, *lines], buttons)
        try:
            while True:
                with self._answers:
                    if self._answers.wait_for(lambda: self._answered, TALK_POLL_S):
                        return self._answer
                if not self._still_rests():
                    raise LoopError(
                        "the print was resumed or ended while amrepair waited for an answer; it is "
                        "left alone from here on"
                    )
        finally:
            with self._answers:
                self._open = False
            self.end_prompt()

    def _still_rests(self) -> bool:
        try:
            return self._host.rests_at_look()
        except LinkError:
            return True  # a server that is away for a moment; the printer waits as we do

    # ------------------------------------------------------------------ being asked

    def _hear(self) -> None:
        while not self._ended.is_set():
            for call in self._host.calls(TALK_POLL_S):
                what = call.get("what")
                if what == "approve":
                    self._take(call)
                elif what == "status":
                    self.say(f"{self._doing}{': a question waits' if self._open else ''}.")

    def _take(self, call: dict[str, Any]) -> None:
        """An answer; one to an earlier question decides nothing."""
        number = call.get("question") or self._number
        with self._answers:
            if self._open and not self._answered and number == self._number:
                self._answer, self._answered = call.get("answer") == "yes", True
                self._answers.notify_all()
                return
        self.say("no question waits for this answer.", wrong=True)
