"""What a stop leaves under layers that were printed since, and the ways to get at it.

Facts for the policy's table: nothing is decided, cut or printed here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from amrepair.loop.looks import Look, Stop
from amrepair.policy import DEFAULT_POLICY, PolicyOptions
from amrepair.policy.remedies import Way
from amrepair.repair import RepairPlan
from amrepair.repair.plan import CoveredLayers
from gcode.estimate import estimate
from gcode.profiles import PrintSetup
from gcode.reader import Job
from gcode.slicing.patch import PatchRegion


def pieces_of(plan: RepairPlan, here: Sequence[Look]) -> tuple[PatchRegion, ...]:
    """Pieces of what is missing at a stop, and how far they are, or were, filled.

    A repair covers what it could not get to, so that no later look sees that: what was printed last
    at this stop tells of it. `here` are its earlier looks. What later layers had covered before is
    as the first look has it: the walls that tell of it stand in as before.
    """
    printed = [look.plan for look in here if look.printed]
    patch = printed[-1].patch if printed else plan.patch
    pieces = () if patch is None else patch.regions
    covered = covered_at(plan, here)
    return pieces if covered is None else (*pieces, covered.piece)


def covered_at(plan: RepairPlan, here: Sequence[Look]) -> CoveredLayers | None:
    """Layers that lack plastic under later ones, as a stop's first look has them."""
    return (here[0].plan if here else plan).covered


def buried(
    pieces: Sequence[PatchRegion],
    stop: Stop,
    layer_mm: float,
    policy: PolicyOptions = DEFAULT_POLICY,
) -> tuple[PatchRegion, ...]:
    """Pieces that begin a layer or more below the one just printed, and are not filled whole."""
    deep_mm = policy.one_layer * layer_mm
    return tuple(
        piece
        for piece in pieces
        if piece.reachable_ratio < 1.0 and stop.z_mm - piece.box_mm[2] >= deep_mm
    )


def buried_mm3(pieces: Sequence[PatchRegion]) -> float:
    """Volume of them that stays open."""
    return float(sum(piece.volume_mm3 * (1.0 - piece.reachable_ratio) for piece in pieces))


def ways(
    pieces: Sequence[PatchRegion],
    job: Job,
    stop: Stop,
    setup: PrintSetup,
    *,
    command: str = "gcode resume-at JOB",
) -> tuple[Way, ...]:
    """Cut down to the layer under the lowest piece and print again from there; or let it be.

    Told with the command that makes the job that is left, to which the layer is added. A piece that
    begins in the first layer is no part to be cut down: then nothing is left but to let it be, or
    to print it anew.
    """
    open_mm3 = buried_mm3(pieces)
    leave = Way("leave", 0.0, open_mm3)
    first = _first_layer(job, stop, min(piece.box_mm[2] for piece in pieces))
    if first is None:
        return (leave,)
    reprint = printed_again(first, job, stop, setup, command=command)
    return (replace(reprint, filled_mm3=open_mm3), leave)


def printed_again(
    first: int, job: Job, stop: Stop, setup: PrintSetup, *, command: str = "gcode resume-at JOB"
) -> Way:
    """Cut down to below a layer, and print all of what was laid from it on again."""
    beads = job.beads
    again = (beads.layer >= first) & (beads.line < stop.line)
    laid_mm3 = beads.subset(again).volume_mm3
    begun_s = _seconds(job, job.layers[first].first_line, setup)
    return Way(
        "reprint", laid_mm3, 0.0,
        print_time_s=_seconds(job, stop.line, setup) - begun_s,
        filament_mm3=laid_mm3,
        layer=first, cut_to_mm=job.layers[first - 1].z_mm,
        command=f"{command} --layer {first}",
    )  # fmt: skip


def _first_layer(job: Job, stop: Stop, low_mm: float) -> int | None:
    """The layer in which something begins; None in the first one."""
    turn = job.turn_at(stop.line)
    layers = job.layers[turn.first_layer : turn.end_layer]
    tops_mm = np.array([layer.z_mm for layer in layers])
    half_mm = np.array([0.5 * layer.height_mm for layer in layers])
    # less of a layer than half is what solids are wrong by
    over = np.flatnonzero(tops_mm - half_mm > low_mm)
    return turn.first_layer + int(over[0]) if len(over) and over[0] > 0 else None


def _seconds(job: Job, line: int, setup: PrintSetup) -> float:
    """Time of the job's moves up to a line."""
    return estimate(job.program.part(0, line), setup.printer).print_time_s
