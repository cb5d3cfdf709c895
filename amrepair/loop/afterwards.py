"""What the repair of a finished part leaves open inside, and the ways to get at it with its job.

Facts for whoever reads the result: nothing is decided, cut or printed here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amrepair.errors import AlignmentError
from amrepair.frames import Transform
from amrepair.loop.buried_defects import buried, buried_mm3, pieces_of, printed_again, ways
from amrepair.loop.kinds import shifted
from amrepair.loop.locate import locate_parts
from amrepair.loop.looks import plan_stops
from amrepair.loop.thin_layers import with_covered
from amrepair.policy.remedies import Way
from amrepair.repair import RepairPlan
from amrepair.template.port import Template
from gcode.profiles import PrintSetup
from gcode.reader import Job

# A bead laid beside its wall by more than this share of its width has nothing under it.
ON_ITS_WALL_RATIO = 0.5
SURFACE_STEP_MM = 1.0  # between places at which two poses of a part are compared


@dataclass(frozen=True, slots=True)
class Afterwards:
    """What stays open under the last layer, and what can be done about it.

    Attributes
    ----------
    buried_mm3
        Of what begins a layer or more below the part's top: the volume that the repair leaves.
    ways
        None where that is too little to ask about (`PolicyOptions.buried_mm3`).
    not_again
        Why the job cannot be printed again from a layer on; empty where it can, or where it prints
        the part and nobody asks.
    covered
        Which layers lack plastic under later ones, in words; empty where none are told.
    """

    buried_mm3: float
    ways: tuple[Way, ...] = ()
    not_again: str = ""
    covered: str = ""

    @property
    def told(self) -> tuple[str, ...]:
        """A sentence for what is covered, for each way, and for why one of them is none."""
        lines = [self.covered] if self.covered else []
        lines += [way.told for way in self.ways]
        if self.not_again:
            lines.append(f"the job cannot be printed again from a layer on: {self.not_again}")
        return tuple(lines)


def afterwards(
    plan: RepairPlan,
    job: Job,
    template: Template,
    setup: PrintSetup,
    *,
    command: str,
    printed_at: Transform | None = None,
) -> Afterwards:
    """The ways to get at what a repair leaves open inside a part whose job is at hand.

    Parameters
    ----------
    template
        The part, in the frame that the plan's scan was aligned to.
    command
        That makes the job that is left, without the layer.
    printed_at
        Build from template, where it is known already; a plate of parts is no single one of them.
    """
    *_, end = plan_stops(job, ())
    placed = plan.build_from_template
    copies: tuple[Transform, ...]
    if printed_at is not None:
        copies, other = (printed_at,), ""
    else:
        copies, other = _copies(job, template, setup)
    aside = shifted(plan, job, template)
    # held against the job's beads: only where the part stands at their place
    stands = aside and not (other or _why_not_again(job, template, copies, placed, setup))
    if aside is not None and aside.layer is not None and stands:
        again = printed_again(aside.layer, job, end, setup, command=command)
        return Afterwards(0.0, (again,), "", f"{aside.told}; no patch mends that")
    if not other:  # walls and beads of another part say nothing of this one's
        plan = with_covered(plan, job, template, end)
    left = buried(pieces_of(plan, ()), end, plan.layer_height_mm, plan.policy)
    open_mm3 = buried_mm3(left)
    if open_mm3 < plan.policy.buried_mm3:
        return Afterwards(open_mm3, not_again=other)
    offered = ways(left, job, end, setup, command=command)
    not_again = "it begins in the first layer, and nothing would stand there"
    if other or len(offered) > 1:
        not_again = other or _why_not_again(job, template, copies, placed, setup)
    if not_again:
        offered = tuple(way for way in offered if way.layer is None)
    covered = "" if plan.covered is None else plan.covered.told
    return Afterwards(open_mm3, offered, not_again, covered)


def _copies(job: Job, template: Template, setup: PrintSetup) -> tuple[tuple[Transform, ...], str]:
    """Where a job prints the part, build from template; and why it is a job of another, if so."""
    try:
        found = locate_parts(job, template, layer_height_mm=setup.process.layer_height_mm)
    except AlignmentError as error:
        return (), f"{error}; of this job only the heights of its layers were taken"
    return found, ""


def _why_not_again(
    job: Job,
    template: Template,
    copies: tuple[Transform, ...],
    placed: Transform,
    setup: PrintSetup,
) -> str:
    """Why a job's later layers would not fall onto a part that stands there; empty if they do."""
    if len(job.turns) > 1:
        return "it prints its objects one after the other"
    if len(copies) > 1:
        return f"it prints {len(copies)} of the part, and the others with it"
    surface_mm, _ = template.surface_points(SURFACE_STEP_MM)
    printed_mm = placed.inverse().apply(copies[0].apply(surface_mm))
    # the part may fit itself in several poses: by its surface, not by the pose
    off_mm = float(np.abs(template.distance(printed_mm)).max())
    limit_mm = ON_ITS_WALL_RATIO * setup.printer.nozzle_diameter_mm
    if off_mm <= limit_mm:
        return ""
    return (
        f"the part stands up to {off_mm:.2f} mm from where it prints it (limit {limit_mm:.2f} mm); "
        "put it back there and scan it again"
    )
