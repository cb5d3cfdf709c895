"""How a run goes, who is asked in it, and what is kept of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from amrepair.loop.kind_options import DEFAULT_KINDS, KindOptions
from amrepair.loop.looks import Look
from amrepair.loop.pace import Pace
from amrepair.loop.tape import Tape
from amrepair.loop.wire import PickUp
from amrepair.policy import DEFAULT_POLICY, Decision, PolicyOptions
from amrepair.regions.error_calibration import Calibration
from amrepair.repair import RepairPlan, Stopwatch
from amrepair.scans import Scan
from gcode.profiles import ProcessProfile


@dataclass(frozen=True, slots=True)
class LoopOptions:
    """How a run goes.

    Attributes
    ----------
    policy
        What is worth a repair, and how many passes a stop may have.
    kinds
        What tells one type of defect from another.
    pace
        Looks besides the stops: more often after trouble, fewer while all is clean.
    limits
        The process whose limits hold for what is printed without asking; beyond them the decision
        is `pause and ask`.
    silent_stops
        So many stops in a row may be passed by where the scanner does not answer; the next such
        stop ends the run with its `ScannerError`. A scan that does not fit the part is taken once
        more, and then ends the run, parked.
    calibration
        What sound parts look like to this scanner; None: learned from the first clean layers.
    seed
        Of the searches for a pose.
    """

    policy: PolicyOptions = DEFAULT_POLICY
    kinds: KindOptions = DEFAULT_KINDS
    pace: Pace | None = None
    limits: ProcessProfile | None = None
    silent_stops: int = 0
    calibration: Calibration | None = None
    seed: int = 0


LOOP = LoopOptions()
"""What a run goes by where nothing else is said."""


@dataclass(frozen=True, slots=True)
class Approval:
    """Who gives a word in a run.

    Attributes
    ----------
    approve
        Asked before every repair is sent.
    ask
        Asked where a decision is `pause and ask`: whether to go on all the same. Where nobody can
        be asked (None) the run ends there, parked, heaters off.
    """

    approve: Callable[[RepairPlan], bool] = lambda plan: True
    ask: Callable[[Decision], bool] | None = None


UNASKED = Approval()
"""Every repair is printed, and nobody can be asked."""


@dataclass(frozen=True, slots=True)
class Records:
    """What is kept of a run.

    Attributes
    ----------
    look
        Called with every look as soon as its outcome is known, before anything follows from it.
    scan
        Called with a look's number and scan while the look is planned; done before `look`.
    tape
        What was sent, seen and decided, written ahead; what it already holds is not done again.
    pick_up
        How a killed run's printer is found again, before the first thing that the tape lacks.
    watch
        Seconds by stage.
    """

    look: Callable[[Look], None] = lambda look: None
    scan: Callable[[int, Scan], None] = lambda number, scan: None
    tape: Tape = field(default_factory=Tape)
    pick_up: PickUp | None = None
    watch: Stopwatch = field(default_factory=Stopwatch)
