"""From a plan to the facts that the table of decisions looks at.

Regions come from the deficit; from the job comes what its next layer lays over them, and whether
the head would run into what stands out. Types and confidence are `kinds`'.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import manifold3d
import numpy as np
from jaxtyping import Float

from amrepair.arrays import Box, PlanePoints, Values
from amrepair.frames import nearest_box
from amrepair.loop.layer_level import LayerLevel
from amrepair.loop.objects import Objects
from amrepair.policy import DEFAULT_POLICY, PolicyOptions
from amrepair.policy.acceptance import Piece, defect_volumes
from amrepair.policy.table import Action, Cover, Finding, judge
from amrepair.regions import Label, Region
from amrepair.repair import RepairPlan
from gcode.check import find_refusals
from gcode.errors import ReadError
from gcode.meshes import box_of_solid
from gcode.moves import ModalState, Program
from gcode.profiles import PrintSetup
from gcode.reader import Job
from gcode.surfaces import HeightField

# Of a region's box, filled by the next layer's beads.
SOLID_SHARE, OPEN_SHARE = 0.6, 0.05
EXCESS_CELL_MM = 0.2
FINDING_MARGIN_MM = 0.5
# What stands out less than this is pressed down by the nozzle's flat.
LEAST_HIT_LAYERS = 1.0
_HITS = "hits what stands there"


def next_layer(job: Job, layer_index: int | None) -> int | None:
    """The layer that covers another; None above the last and for the finished part."""
    if layer_index is None or layer_index + 1 >= len(job.layers):
        return None
    return layer_index + 1


def _line_after(job: Job, layer_index: int | None, line: int) -> int:
    """The line before which the head may next run into what stands out here.

    That of the next layer's end; of an object that is finished, of the end of the next one.
    """
    after = next_layer(job, layer_index)
    if after is not None:
        return job.layers[after].end_line
    turns = job.turns
    return turns[min(job.turn_at(line).index + 1, len(turns) - 1)].end_line if turns[1:] else line


def cover_of(job: Job, layer_index: int | None, box_mm: Box) -> Cover:
    """What the next layer lays over a box."""
    layer = next_layer(job, layer_index)
    if layer is None:
        return Cover.NOTHING
    beads = job.beads
    pick = beads.layer == layer
    start, end = beads.start_mm[pick, :2], beads.end_mm[pick, :2]
    low, high = box_mm[0, :2], box_mm[1, :2]
    volume = float(clipped_mm(start, end, low, high) @ beads.section_mm2[pick])
    room_mm3 = float(np.prod(np.maximum(high - low, 1e-6))) * job.layers[layer].height_mm
    share = volume / max(room_mm3, 1e-9)
    if share >= SOLID_SHARE:
        return Cover.SOLID
    return Cover.OPEN if share >= OPEN_SHARE else Cover.NOTHING


def clipped_mm(
    start: PlanePoints,
    end: PlanePoints,
    low: Float[np.ndarray, " 2"],
    high: Float[np.ndarray, " 2"],
) -> Values:
    """(n,) length of each segment within an XY box, mm."""
    step = end - start
    enter, leave = np.zeros(len(start)), np.ones(len(start))
    for axis in (0, 1):
        still = np.abs(step[:, axis]) < 1e-12
        safe = np.where(still, 1.0, step[:, axis])
        a, b = (low[axis] - start[:, axis]) / safe, (high[axis] - start[:, axis]) / safe
        first, last = np.minimum(a, b), np.maximum(a, b)
        out = still & ((start[:, axis] < low[axis]) | (start[:, axis] > high[axis]))
        enter = np.maximum(enter, np.where(still, np.where(out, 2.0, 0.0), first))
        leave = np.minimum(leave, np.where(still, 1.0, last))
    return np.maximum(leave - enter, 0.0) * np.linalg.norm(step, axis=1)


def hit_mm(
    coming: Program, initial: ModalState, setup: PrintSetup, excess: manifold3d.Manifold
) -> float:
    """How deep the head runs into a solid in what is coming of the job; 0 if it clears it.

    The checker's own sweep judges, tool head and all.
    """
    x0, y0, _, x1, y1, _ = excess.bounding_box()
    box = (
        x0 - FINDING_MARGIN_MM,
        y0 - FINDING_MARGIN_MM,
        x1 + FINDING_MARGIN_MM,
        y1 + FINDING_MARGIN_MM,
    )
    field = HeightField.from_manifold(excess, EXCESS_CELL_MM, box_mm=box)
    refusals = find_refusals(coming, setup, as_built=field, initial=initial)
    deep = [float(r.value.split()[0]) for r in refusals if r.what.endswith(_HITS)]
    return max(deep, default=0.0)


def _coming(job: Job, line: int, end_line: int) -> tuple[Program, ModalState] | None:
    """Lines [line, end_line) of the job and the state before; None where nobody can tell that."""
    try:
        state = job.state_after(line)
    except ReadError:
        return None
    return job.program.part(line, end_line), state


def findings(
    plan: RepairPlan,
    job: Job,
    setup: PrintSetup,
    *,
    layer_index: int | None,
    line: int,
    seen_twice: bool = False,
    objects: Objects | None = None,
) -> tuple[Finding, ...]:
    """The facts about every region of a plan.

    Parameters
    ----------
    layer_index, line
        The layer just finished (None: the finished part), and the job's next line.
    seen_twice
        Whether this stop was looked at before, nothing printed between.
    objects
        The job's, where it is printed on without those that cannot be repaired.
    """
    end_line = _line_after(job, layer_index, line)
    coming = functools.cache(partial(_coming, job, line, end_line))
    pieces = plan.deficit.excess.decompose()
    found = []
    regions = plan.deficit.regions
    z_mm = None if layer_index is None else job.layers[layer_index].z_mm
    owners = _owners(objects, regions, line)
    level = LayerLevel.of(plan, z_mm) if regions and z_mm is not None else None
    for region, whole_mm3, owner in zip(
        regions, _whole_defects(regions, plan.policy), owners, strict=True
    ):
        reach, hit = 1.0, 0.0
        if region.label is Label.MISSING:
            reach = reach_of(plan, region.box_mm)
        elif end_line > line and region.height_mm >= LEAST_HIT_LAYERS * plan.layer_height_mm:
            piece, ahead = matching(pieces, region.box_mm), coming()
            if piece is not None and ahead is not None:
                hit = hit_mm(*ahead, setup, piece)
        found.append(
            replace(
                _alone(region, job, layer_index, plan.layer_height_mm),
                confidence=float(region.confidence),
                defect_mm3=float(whole_mm3),
                reachable_ratio=reach,
                hit_mm=hit,
                seen_twice=seen_twice,
                layer_off=level is not None and level.is_off(region.box_mm),
                object=owner[0],
                lost_ratio=owner[1],
                given_up=owner[2],
            )
        )
    return tuple(found)


def _owners(
    objects: Objects | None, regions: Sequence[Region], line: int
) -> list[tuple[str, float, bool]]:
    """Of each region: the object it lies in, the share of that one that is gone, given up."""
    if objects is None:
        return [("", 0.0, False)] * len(regions)
    names = [objects.owner(np.asarray(region.box_mm)) for region in regions]
    gone_mm3 = dict.fromkeys(names, 0.0)
    for name, region in zip(names, regions, strict=True):
        gone_mm3[name] += float(region.volume_mm3) * (region.label is Label.MISSING)
    share = {n: gone_mm3[n] / max(objects.laid_mm3(n, line), 1e-9) for n in gone_mm3 if n}
    found = []
    for name in names:
        given_up = name in objects.given_up
        own = name if not given_up and len(objects.left) > 1 else ""
        found.append((own, share.get(name, 0.0) if own else 0.0, given_up))
    return found


def _whole_defects(regions: Sequence[Region], policy: PolicyOptions = DEFAULT_POLICY) -> Values:
    """(n,) volume of the defect that each region is a piece of, mm³."""
    whole_mm3 = np.zeros(len(regions))
    for label in Label:
        mine = [k for k, region in enumerate(regions) if region.label is label]
        whole_mm3[mine] = defect_volumes([Piece.of(regions[k]) for k in mine], policy)
    return whole_mm3


def early_action(
    region: Region,
    job: Job,
    setup: PrintSetup,
    layer_index: int | None,
    policy: PolicyOptions = DEFAULT_POLICY,
) -> Action:
    """What the table says of a missing region before anybody knows what can be reached of it."""
    return judge(_alone(region, job, layer_index, setup.process.layer_height_mm), policy).action


def _alone(region: Region, job: Job, layer_index: int | None, layer_mm: float) -> Finding:
    """What a region tells by itself: there for sure, all of its defect, and within reach."""
    return Finding(
        kind="missing" if region.label is Label.MISSING else "excess",
        type=region.type,
        confidence=1.0,
        volume_mm3=float(region.volume_mm3),
        defect_mm3=float(region.volume_mm3),
        thickness_layers=region.thickness_mm / layer_mm,
        height_layers=region.height_mm / layer_mm,
        reachable_ratio=1.0,
        cover=cover_of(job, layer_index, np.asarray(region.box_mm)),
        hit_mm=0.0,
        box_mm=_corners(region.box_mm),
        skipped=region.skipped,
        told=region.told,
    )


def matching(pieces: Sequence[manifold3d.Manifold], box_mm: Box) -> manifold3d.Manifold | None:
    """The piece whose box is nearest to a region's."""
    if not pieces:
        return None
    return pieces[nearest_box([box_of_solid(piece) for piece in pieces], box_mm)]


def reach_of(plan: RepairPlan, box_mm: Box) -> float:
    """Share that the nozzle reaches of the patch's region that overlaps a box most.

    1 where no patch was planned for it.
    """
    if plan.patch is None:
        return 1.0
    best, found = 0.0, 1.0
    low, high = np.asarray(box_mm, dtype=np.float64).reshape(2, 3)
    for part in plan.patch.regions:
        other_low, other_high = np.asarray(part.box_mm, dtype=np.float64).reshape(2, 3)
        shared = float(
            np.prod(np.maximum(np.minimum(high, other_high) - np.maximum(low, other_low), 0.0))
        )
        if shared > best:
            best, found = shared, float(part.reachable_ratio)
    return found


def _corners(box_mm: Box) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    (a, b, c), (d, e, f) = np.asarray(box_mm, dtype=np.float64).tolist()
    return (a, b, c), (d, e, f)
