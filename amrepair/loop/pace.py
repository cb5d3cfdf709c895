"""When a run looks: after fixed layers, or adaptively: more often after trouble, fewer when clean.

It counts layers; what trouble is, is decided by the table of decisions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amrepair.errors import InputError, LoopError
from amrepair.loop.locate import first_layer
from amrepair.loop.looks import Look, Stop, plan_stops
from amrepair.policy.table import Action
from gcode.reader import Job

AFTER_TROUBLE = 4
"""After trouble the next look is due after this share of the usual layers."""
CLEAN_FACTOR, MOST_FACTOR = 2, 4
"""Every clean look makes the way to the next one longer by this factor, up to that one."""


@dataclass(frozen=True, slots=True)
class Pace:
    """How many layers from look to look.

    Attributes
    ----------
    every
        Layers to the first look, and what the others are measured by.

    Raises
    ------
    LoopError
        If it is not at least one layer.
    """

    every: int

    def __post_init__(self) -> None:
        if self.every < 1:
            raise LoopError(f"looks are {self.every} layers apart; it must be at least one")

    def next_gap(self, gap: int, *, trouble: bool) -> int:
        """Layers to the next look, after a look that came `gap` layers after the one before."""
        if trouble:
            return max(1, self.every // AFTER_TROUBLE)
        return min(MOST_FACTOR * self.every, max(gap, 1) * CLEAN_FACTOR)


class Stops:
    """The stops of a run, one after another.

    Parameters
    ----------
    job
        The job.
    fixed
        Stops that are made in any case, rising.
    pace
        Looks besides; None makes none.
    """

    def __init__(self, job: Job, fixed: Sequence[Stop], pace: Pace | None) -> None:
        self._job, self._fixed, self._pace = job, list(fixed), pace
        self._turns = job.turns
        self._gap = self._due = 0
        self._begin(0)

    def _begin(self, turn: int) -> None:
        """The first look at what a turn prints; its end is looked at in any case."""
        every = self._pace.every if self._pace is not None else 0
        self._gap, self._due = every, len(self._job.layers)
        for one in self._turns[turn:]:
            # layers count from 0: the third is number 2
            due = max(one.first_layer + every - 1, first_layer(self._job.of_turn(one)))
            if due < one.end_layer - 1:
                self._due = due
                return

    def next(self) -> Stop | None:
        """The next stop; None where there is none left."""
        fixed = self._fixed[0] if self._fixed else None
        if self._pace is None or self._due >= len(self._job.layers) - 1:
            return self._fixed.pop(0) if self._fixed else None
        (paced,) = plan_stops(self._job, [self._due], final=False)
        if fixed is not None and fixed.line <= paced.line:
            return self._fixed.pop(0)
        return paced

    def seen(self, stop: Stop, *, trouble: bool) -> None:
        """What a stop came to: the next one follows from it."""
        if self._pace is None or stop.layer_index is None:
            return
        if stop.layer_index < self._due and not trouble:
            return  # a fixed stop on the way: nothing new
        self._gap = self._pace.next_gap(self._gap, trouble=trouble)
        self._due = stop.layer_index + self._gap
        turn = self._job.turn_of(stop.layer_index)
        if self._due >= turn.end_layer - 1:
            self._begin(turn.index + 1)


def had_trouble(looks: Sequence[Look]) -> bool:
    """Whether the looks of one stop found anything to be done, or there was none."""
    return not looks or any(look.decision.action is not Action.GO_ON for look in looks)


def layers_every(job: Job, every: int) -> list[int]:
    """Every so many layers of what each turn prints, but for its last one; 0: none."""
    if not every:
        return []
    return [
        layer
        for turn in job.turns
        for layer in range(turn.first_layer + every - 1, turn.end_layer - 1, every)
    ]


def layers_at(job: Job, heights_mm: Sequence[float]) -> list[int]:
    """The layers that reach given heights first; of objects printed one after another, of each.

    Parameters
    ----------
    heights_mm
        Build frame: above the bed.

    Raises
    ------
    InputError
        If a height is not above the bed, or above the job's last layer.
    """
    tops = [layer.z_mm for layer in job.layers]
    high_mm = max(tops[turn.end_layer - 1] for turn in job.turns)
    found = []
    for z_mm in heights_mm:
        if not 0.0 < z_mm <= high_mm + 1e-6:
            raise InputError(
                f"there is no layer at z = {z_mm:g} mm to stop after; the job is {high_mm:g} mm "
                "high"
            )
        for turn in job.turns:
            own = range(turn.first_layer, turn.end_layer)
            found += [k for k in own if tops[k] >= z_mm - 1e-6][:1]
    return found
