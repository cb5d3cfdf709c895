"""The screens of a printer: Klipper's, which every frontend draws; the tab of our OctoPrint plugin.

Klipper's prompts are `action:prompt_…`, which Mainsail, Fluidd and KlipperScreen draw themselves;
a button is a line of G-code there, and answers come by macros.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

END_PROMPT = 'RESPOND TYPE=command MSG="action:prompt_end"'
# A line of G-code ends at a comment; a quote ends its text, a bar a prompt's.
_UNSAID = re.compile(r"[\x00-\x1f;#\"|*\\]+")
_ANSWER_MACROS = {
    "approve": "AMREPAIR_APPROVE ANSWER={answer} QUESTION={question}",
    "go on": "AMREPAIR_RESUME",
    "cancel": "CANCEL_PRINT",
}


class Button(NamedTuple):
    """One answer that can be given.

    Attributes
    ----------
    call
        What it asks for: `what` is approve (with `answer` and `question`), go on or cancel.
    colour
        primary, warning or error.
    """

    label: str
    call: Mapping[str, Any]
    colour: str


@runtime_checkable
class Screens(Protocol):
    """Where people at the printer look."""

    def stage(self, text: str) -> None:
        """What is being done now."""

    def say(self, text: str, *, wrong: bool) -> None:
        """One sentence that stays."""

    def prompt(self, lines: Sequence[str], buttons: Sequence[Button]) -> None:
        """A window with buttons, in the place of the last one."""

    def end_prompt(self) -> None:
        """Take it away."""


class KlipperScreens:
    """Console, display and prompts of Klipper.

    Parameters
    ----------
    command
        Has a script carried out.
    """

    def __init__(self, command: Callable[[str], None]) -> None:
        self._command = command

    def stage(self, text: str) -> None:
        """On the display."""
        self._command(f"M117 amrepair: {plain(text)}")

    def say(self, text: str, *, wrong: bool) -> None:
        """In the console and on the display."""
        said = plain(text)
        line = f'TYPE=error MSG="amrepair: {said}"' if wrong else f'PREFIX="amrepair:" MSG="{said}"'
        self._command(f"RESPOND {line}\nM117 amrepair: {said}")

    def prompt(self, lines: Sequence[str], buttons: Sequence[Button]) -> None:
        """On every frontend."""
        rows = ["prompt_end", "prompt_begin amrepair"]
        rows += [f"prompt_text {plain(line)}" for line in lines]
        for label, call, colour in buttons:
            macro = _ANSWER_MACROS[call["what"]].format(**call)
            rows.append(f"prompt_footer_button {label}|{macro}|{colour}")
        self._command("\n".join(f'RESPOND TYPE=command MSG="action:{row}"' for row in
                                [*rows, "prompt_show"]))  # fmt: skip

    def end_prompt(self) -> None:
        """On every frontend."""
        self._command(END_PROMPT)


class OctoPrintTab:
    """The tab of our plugin.

    Parameters
    ----------
    show
        Tells the plugin what to show: `show("say", text=…, wrong=…)`.
    """

    def __init__(self, show: Callable[..., None]) -> None:
        self._show = show

    def stage(self, text: str) -> None:
        """At the tab's head."""
        self._show("doing", text=text)

    def say(self, text: str, *, wrong: bool) -> None:
        """In the tab's list."""
        self._show("say", text=text, wrong=wrong)

    def prompt(self, lines: Sequence[str], buttons: Sequence[Button]) -> None:
        """In the tab, and as a notice on all others."""
        rows = [{"label": b.label, "call": dict(b.call), "colour": b.colour} for b in buttons]
        self._show("prompt", lines=list(lines), buttons=rows)

    def end_prompt(self) -> None:
        """Out of the tab."""
        self._show("end_prompt")


def plain(text: str) -> str:
    """A text that may stand in a line of G-code."""
    return " ".join(_UNSAID.sub(" ", text.replace(";", ",")).split())
