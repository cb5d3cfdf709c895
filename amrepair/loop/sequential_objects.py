"""Objects that a job prints one after another: whose turn it is, and what stands beside it.

What has come to its end stays on the bed, higher than what is printed now. It was judged at its
end; from then on it is what the head must keep off.
"""

from __future__ import annotations

import manifold3d
import numpy as np
import trimesh
from jaxtyping import Float
from scipy import ndimage

from amrepair.arrays import Box, Numbers
from amrepair.errors import AlignmentError, InputError
from amrepair.frames import Transform
from amrepair.loop.locate import BESIDE_THE_PART, of_roles
from amrepair.repair.site import Finished
from amrepair.template import MeshSdf, StoodTemplate
from amrepair.template.port import Template
from gcode.check.sweep import deepest_of_moves
from gcode.meshes import box_of_solid, mesh_of
from gcode.profiles import PrintSetup
from gcode.reader import Job, Turn
from gcode.reader.objects import box_of_beads_mm
from gcode.resumption.standing import standing_field

LEAST_SHARE = 0.5  # of what a copy, a body, or a turn covers of the bed: then the place is one


def finished_at(job: Job, turn: Turn, setup: PrintSetup) -> Finished | None:
    """What has come to its end before a turn; None before the first one."""
    if turn.index == 0:
        return None
    machine, beads = setup.printer, job.beads
    standing = standing_field(beads, turn.first_line, machine)
    parts = ~of_roles(beads, BESIDE_THE_PART) & (beads.layer >= 0)
    theirs, own = (
        standing_field(beads.subset(parts & pick), job.program.line_count, machine).z_mm > 0
        for pick in (beads.layer < turn.first_layer, job.laid_in(turn))
    )
    if (theirs & own).sum() > LEAST_SHARE * own.sum():
        raise InputError(
            f"the job lays layer {turn.first_layer} at {job.layers[turn.first_layer].z_mm:g} mm "
            "where something higher stands already; it prints neither layer by layer nor one "
            "object after another"
        )
    away_mm, off_own_mm = (ndimage.distance_transform_edt(~what) for what in (theirs, own))
    return Finished(standing, np.asarray(away_mm < off_own_mm))


def refuse_own_hits(job: Job, setup: PrintSetup) -> None:
    """Raise where the job's own way leads the head through what it has finished.

    Raises
    ------
    InputError
        Where it does, as the printer's profile has its head, or where there is no room above.
    """
    machine = setup.printer
    for turn in job.turns[1:]:
        standing = standing_field(job.beads, turn.first_line, machine)
        start, end, line = _moves(job, turn)
        deep_mm, part = deepest_of_moves(start, end, machine, standing)
        worst = int(np.argmax(deep_mm))
        if deep_mm[worst] > 0:
            raise InputError(
                f"the job prints its objects one after the other, and in line {line[worst] + 1} "
                f"the {part[worst].part} ({part[worst].z_from_mm:g} mm above the tip) comes "
                f"{deep_mm[worst]:.1f} mm too deep to pass what is finished, as the profile "
                f"'{machine.id}' has the head; set the objects farther apart (the slicer's "
                "extruder clearance), or measure the head and correct its 'envelope'"
            )


def _moves(
    job: Job, turn: Turn
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Numbers]:
    """All moves after the turn before, with their lines: beads, arcs as chords, and the others."""
    beads = job.of_turn(turn).beads
    at = job.block.states[:, :3]
    first = job.end_of(job.turns[turn.index - 1])
    lines = np.arange(first, min(turn.end_line, len(at) - 1))
    lines = lines[~np.isin(lines, beads.line)]
    start, end = at[lines], at[lines + 1]
    goes = (
        np.isfinite(start).all(axis=1) & np.isfinite(end).all(axis=1) & (start != end).any(axis=1)
    )
    return (
        np.concatenate([beads.start_mm, start[goes]]),
        np.concatenate([beads.end_mm, end[goes]]),
        np.concatenate([beads.line, lines[goes]]),
    )


def template_of(
    template: Template, build_from_template: Transform, job: Job, turn: Turn
) -> Template:
    """The part of a template that one turn of a job prints; all of it where there is one turn.

    Raises
    ------
    AlignmentError
        If nothing of it stands where the turn prints.
    """
    if len(job.turns) == 1:
        return template
    beads = job.beads
    x0, y0, x1, y1 = box_of_beads_mm(job, job.laid_in(turn) & ~of_roles(beads, BESIDE_THE_PART))
    laid = np.array([[x0, y0], [x1, y1]])
    if isinstance(template, StoodTemplate):
        own = [k for k, box in enumerate(template.boxes_mm) if _shares(box, laid)]
        if own:
            return template.some(own)
    else:
        of_whole = template.solid().decompose()
        moved = build_from_template.solid(template.solid())
        pick = [_shares(box_of_solid(one), laid) for one in moved.decompose()]
        mine = [body for body, is_own in zip(of_whole, pick, strict=True) if is_own]
        if len(mine) == len(of_whole):
            return template
        if mine:
            vertices, faces = mesh_of(manifold3d.Manifold.compose(mine))
            return MeshSdf.from_mesh(trimesh.Trimesh(vertices, faces, process=False))
    raise AlignmentError(
        f"the job prints its objects one after the other, and where it lays layer "
        f"{turn.first_layer} (X {x0:.0f} to {x1:.0f}, Y {y0:.0f} to {y1:.0f} mm) the template has "
        "none; name the template of all that the job prints"
    )


def _shares(box_mm: Box, laid_mm: Float[np.ndarray, "2 2"]) -> bool:
    """Whether a box, seen from above, lies mostly in what a turn covers."""
    box = np.asarray(box_mm)[:, :2]
    common = np.minimum(box[1], laid_mm[1]) - np.maximum(box[0], laid_mm[0])
    return bool((common > 0).all() and np.prod(common) > LEAST_SHARE * np.prod(box[1] - box[0]))
