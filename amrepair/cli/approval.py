"""Questions to whoever sits at the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from amrepair.errors import InputError
from amrepair.loop import Decision
from amrepair.repair import RepairPlan
from amrepair.report.text import plan_lines
from gcode.cli import console


class Terminal:
    """Asks between the bars.

    Parameters
    ----------
    bars
        Taken away while a question waits.
    """

    def __init__(self, bars: console.Bars) -> None:
        self._bars = bars

    def to_print(self, plan: RepairPlan) -> bool:
        """Show what would be printed, and wait for a word."""
        with self._bars.paused():
            for line in plan_lines(plan):
                console.errors.print(f"  {line}")
            return confirmed("Print this repair?")

    def to_go_on(self, decision: Decision) -> bool:
        """Say why the run rests, and wait for a word."""
        with self._bars.paused():
            for verdict in decision.own:
                one = verdict.finding
                low, high = one.box_mm
                console.errors.print(
                    f"  {one.type}, {one.volume_mm3:.1f} mm³ {one.kind} at X {low[0]:.0f} to "
                    f"{high[0]:.0f}, Y {low[1]:.0f} to {high[1]:.0f} mm: {verdict.reason}."
                )
            if not decision.own:
                console.errors.print(f"  {decision.reason}.")
            for way in decision.ways:
                console.errors.print(f"  {way.told}")
            return confirmed("Go on all the same (no ends the run)?")


@runtime_checkable
class Asker(Protocol):
    """Who is told and asked elsewhere than at the terminal."""

    def progress(self, stage: str, done: float, total: float) -> None:
        """Be told how far it is."""

    def ask(self, question: str, lines: Sequence[str]) -> bool:
        """Answer, whenever that is."""


class AtDesk(console.Bars):
    """Asks and tells its progress elsewhere: somebody else has the terminal, or nobody.

    Parameters
    ----------
    desk
        A supervisor's folder of notes, or the printer's own screens.
    """

    def __init__(self, desk: Asker) -> None:
        super().__init__()
        self._desk = desk

    def __call__(self, stage: str, done: float, total: float) -> None:
        """Report that `done` of `total` of `stage` is finished."""
        self._desk.progress(stage, done, total)

    def to_print(self, plan: RepairPlan) -> bool:
        """Tell what would be printed, and wait for a word."""
        return self._desk.ask("Print this repair?", plan_lines(plan))

    def to_go_on(self, decision: Decision) -> bool:
        """Tell why the run rests, and wait for a word."""
        return self._desk.ask("Go on all the same (no ends the run)?", decision.told)


def confirmed(question: str) -> bool:
    """Ask on standard error, read a word from standard input; anything but y or yes is no.

    Raises
    ------
    InputError
        If standard input is closed: nobody can answer.
    """
    console.errors.print(f"{question} [y/N] ", end="")
    try:
        answer = input()
    except EOFError as error:
        console.errors.print()
        raise InputError(
            "nobody answers: standard input is closed; run it in a terminal, ask in a browser "
            "(--view), or let it decide within the profile's limits (--approve auto)"
        ) from error
    return answer.strip().lower() in {"y", "yes"}
