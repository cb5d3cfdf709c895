"""Stops, looks and the report of a run: what a loop remembers.

It holds and adds up; what is done at a stop is decided in `decide` and done in `run`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amrepair.errors import InputError
from amrepair.loop.locate import first_layer
from amrepair.policy import Action, Decision
from amrepair.policy.acceptance import volume_mm3
from amrepair.policy.stopping_criteria import may_be_left
from amrepair.regions.error_calibration import Calibration
from amrepair.repair import RepairPlan
from amrepair.scans import Scan
from gcode.hosts.port import PrintReport
from gcode.reader import Job, Turn


@dataclass(frozen=True, slots=True)
class Stop:
    """A moment at which the job rests and is looked at.

    Attributes
    ----------
    layer_index
        The layer just finished; None for the finished part, before the end script.
    line
        The first program line that is not yet sent.
    z_mm
        Height printed so far, build frame; of the object that is under way.
    number
        Of objects that are printed one after another, the one that is finished, counted from 1;
        None where a job prints all at once, and in the midst of an object.
    """

    layer_index: int | None
    line: int
    z_mm: float
    number: int | None = None

    @property
    def label(self) -> str:
        """`layer-044`, `final`, or `final-2`."""
        if self.layer_index is not None:
            return f"layer-{self.layer_index:03d}"
        return "final" if self.number is None else f"final-{self.number}"


@dataclass(frozen=True, slots=True)
class Look:
    """One scan at a stop, what was planned from it, what was decided, and what became of it.

    Attributes
    ----------
    printed
        The plan's program was, or is about to be, printed.
    declined
        Somebody was asked, and said no.
    scanned_points
        How many points the scan had, where only some are kept; 0 where all are.
    """

    number: int
    stop: Stop
    scan: Scan
    plan: RepairPlan
    decision: Decision
    printed: bool
    declined: bool = False
    scanned_points: int = 0


@dataclass(frozen=True, slots=True)
class LoopReport:
    """What became of a run.

    Attributes
    ----------
    looks
        Every scan in order, with its plan.
    job_prints, repair_prints
        What the link says of each part of the job (rewritten layers included) and of each repair.
    stopped
        Why the run was ended before the job was: parked, heaters off; empty if it was not.
    passed
        Stops that were passed by without a look: the scanner did not answer.
    calibration
        What the run learned of its scanner from its first clean layers, or was told of it; None
        where it came to neither.
    given_up
        Objects of the job that could not be repaired: nothing more was printed of them.
    """

    looks: tuple[Look, ...]
    job_prints: tuple[PrintReport, ...]
    repair_prints: tuple[PrintReport, ...]
    stopped: str = ""
    passed: tuple[Stop, ...] = ()
    calibration: Calibration | None = None
    given_up: tuple[str, ...] = ()

    def at_stop(self, stop: Stop) -> tuple[Look, ...]:
        """The looks of one stop."""
        return tuple(look for look in self.looks if look.stop == stop)

    @property
    def by_stop(self) -> dict[Stop, tuple[Look, ...]]:
        """The looks of every stop, stops in order; one walk over the looks."""
        found: dict[Stop, list[Look]] = {}
        for look in self.looks:
            found.setdefault(look.stop, []).append(look)
        return {stop: tuple(looks) for stop, looks in found.items()}

    @property
    def first_looks(self) -> tuple[Look, ...]:
        """The first look of every stop."""
        return tuple(looks[0] for looks in self.by_stop.values())

    @property
    def last_looks(self) -> tuple[Look, ...]:
        """The last look of every stop."""
        return tuple(looks[-1] for looks in self.by_stop.values())

    @property
    def within_tolerance(self) -> bool:
        """Whether every stop was left within tolerance (`left_well`), and each was looked at."""
        found_mm3, well = 0.0, not self.stopped and not self.passed and not self.given_up
        for looks in self.by_stop.values():
            found_mm3 += looks[0].plan.deficit.missing_mm3
            well = well and left_well(looks, found_mm3)
        return well


def left_well(looks: Sequence[Look], found_mm3: float) -> bool:
    """Whether a stop was left within tolerance, by the policy (`may_be_left`).

    Parameters
    ----------
    looks
        Those of the stop.
    found_mm3
        Volume found missing in the job so far: a later look sees earlier repairs, too.
    """
    last, decision = looks[-1].plan, looks[-1].decision
    # what is offered to be printed again lies under what was seen: of it no region tells
    offered_mm3 = decision.situation.buried_mm3 if decision.action is Action.OFFER else 0.0
    return (last.within_tolerance and not offered_mm3) or may_be_left(
        found_mm3,
        missing_mm3=max(volume_mm3(last.to_fill), offered_mm3),
        excess_mm3=volume_mm3(last.too_much),
        excess_before_mm3=volume_mm3(looks[0].plan.too_much),
        options=last.policy,
    )


def plan_stops(job: Job, layers: Sequence[int], *, final: bool = True) -> tuple[Stop, ...]:
    """Stops after the given layers, in the job's order, and one for each finished part.

    Where only the raft is laid there is nothing to look at, and no stop.

    Raises
    ------
    InputError
        If the job has no such layer.
    """
    asked, stops = sorted(set(layers)), []
    wrong = [index for index in asked if not 0 <= index < len(job.layers)]
    if wrong:
        raise InputError(
            f"there is no layer {wrong[0]} to stop after; the job has layers 0 to "
            f"{len(job.layers) - 1}"
        )
    for turn in job.turns:
        first = first_layer(job.of_turn(turn))
        end = turn.end_layer - final
        for layer in (job.layers[index] for index in asked if first <= index < end):
            stops.append(Stop(layer.index, layer.end_line, layer.z_mm))
        if final:
            stops.append(end_stop(job, turn))
    return tuple(stops)


def end_stop(job: Job, turn: Turn, line: int | None = None) -> Stop:
    """The stop at which what one turn prints is finished; at its last bead, or another line."""
    number = turn.index + 1 if len(job.turns) > 1 else None
    z_mm = job.layers[turn.end_layer - 1].z_mm
    return Stop(None, job.end_of(turn) if line is None else line, z_mm, number)


def look_to_json(look: Look) -> dict[str, object]:
    """A look as it stands on the tape."""
    return {
        "look": look.number,
        "stop": look.stop.label,
        "layer": look.stop.layer_index,
        "z_mm": look.stop.z_mm,
        "frame": look.scan.frame,
        "missing_mm3": round(look.plan.deficit.missing_mm3, 6),
        "excess_mm3": round(look.plan.deficit.excess_mm3, 6),
        "decision": look.decision.to_json(),
        "printed": look.printed,
        "declined": look.declined,
    }


def as_recorded(scan: Scan) -> Scan:
    """A scan as its file will hold it: normals in single precision."""
    if scan.normals is None:
        return scan
    return replace(scan, normals=scan.normals.astype(np.float32).astype(np.float64))
