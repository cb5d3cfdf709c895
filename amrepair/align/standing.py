"""Standing: whether a pose puts a part where a part can stand: on the bed, within the printer.

A scan in the scanner's own frame that is taken for one in the bed's puts the part into the bed or
beside it, or in the air; so does an origin that is not where the user thought. All are refused
before any work.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Box, Mask, Matrix, Points, Vector
from amrepair.errors import AlignmentError
from amrepair.frames import Transform, box_of, motion_about, turn_between, unit_vectors
from amrepair.template.port import Template
from gcode.meshes import mesh_of, middle_of_mass
from gcode.profiles import PrinterProfile

# More than any calibration, raft or warp puts a part off; less than any layer it would be moved by.
SLACK_MM = 1.0
# Thicker than slicers lay rafts (Cura's and PrusaSlicer's usual ones are 0.8 to 2.5 mm).
RAFT_MM = 3.0
# Less is rounding: two faces this far apart are one, 0.05 mm over a part of 250 mm.
ROUNDED_RAD = 2e-4


def box_on_bed(template: Template, placed: Transform) -> Box:
    """Lowest and highest corner of the part's box, build frame, mm."""
    vertices, _ = mesh_of(template.solid())
    return box_of(placed.apply(np.asarray(vertices, dtype=np.float64)))


def stood_up(template: Template, matrix: Matrix, about_mm: Vector, most_rad: float) -> Matrix:
    """A pose without its lean: the part stands on the face of its hull that is nearly down.

    A face stands that has the part's middle above it, so no facet of a fillet beside the foot
    does. Where one could stand on either side of what is down, the foot is round and the part
    rolls: there is no lean to take, and the pose stays.

    Parameters
    ----------
    matrix
        Template from build.
    about_mm
        (3,) what stays in place, template frame.
    most_rad
        What leans by more is another pose, as of a part on a fixture, and stays as it is.
    """
    solid = template.solid()
    vertices, faces = mesh_of(solid.hull())
    corners = np.asarray(vertices, dtype=np.float64)[np.asarray(faces)]  # (n, 3, 3)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = unit_vectors(across)
    down = -matrix[:3, 2]
    near = outward @ down > np.cos(most_rad)
    if not near.any():
        return matrix
    corners, across, outward = corners[near], across[near], outward[near]
    # the triangles of one face have one normal, but for rounding
    _, face = np.unique(np.round(outward, 4), axis=0, return_inverse=True)
    area = np.bincount(face.ravel(), np.linalg.norm(across, axis=1))[face.ravel()]
    standing = _is_under(corners, outward, middle_of_mass(solid))
    if not standing.any():  # it stands since it sticks
        standing = np.ones_like(standing)
    turns = np.cross(down, outward[standing])
    if (turns @ turns.T).min() < -(ROUNDED_RAD**2):
        return matrix
    foot = outward[standing][np.argmax(area[standing])]
    return motion_about(about_mm, turn_between(down, foot), np.zeros(3)) @ matrix


def _is_under(corners_mm: Float[np.ndarray, "n 3 3"], outward: Points, middle_mm: Vector) -> Mask:
    """(n,) whether a middle is over each triangle, along the triangle's own normal."""
    sides = np.roll(corners_mm, -1, axis=1) - corners_mm
    inward = np.cross(outward[:, None], sides)
    return np.asarray(((middle_mm - corners_mm) * inward).sum(axis=2).min(axis=1) >= 0.0)


def refuse_impossible(
    template: Template,
    placed: Transform,
    printer: PrinterProfile,
    *,
    said: bool,
    raised: bool = False,
) -> None:
    """Refuse a pose in which the part would stand in the bed, in the air or beyond the printer.

    Parameters
    ----------
    placed
        Build from template.
    said
        Somebody gave the pose, so what is wrong is the pose; else the scan's frame is.
    raised
        Somebody said that it stands on a fixture, so that its foot is above the bed.

    Raises
    ------
    AlignmentError
        Saying by how much, and what to give instead.
    """
    low, high = box_on_bed(template, placed)
    where = (
        f"X {low[0]:.1f} to {high[0]:.1f}, Y {low[1]:.1f} to {high[1]:.1f}, "
        f"Z {low[2]:.1f} to {high[2]:.1f} mm"
    )
    x0, y0, x1, y1 = printer.bed_box_mm
    foot, room = np.array([x0, y0]), np.array([x1, y1, printer.max_z_mm])
    beyond = bool((low[:2] < foot - SLACK_MM).any() or (high > room + SLACK_MM).any())
    floats = bool(low[2] > RAFT_MM) and not raised
    if low[2] >= -SLACK_MM and not beyond and not floats:
        return
    shift_mm = placed.translation_mm[2] - low[2]
    if floats and not beyond:
        cure = (
            f"a pose places the origin of the part's own file; to stand on the bed it has "
            f"Z = {shift_mm:.3f}"
            if said
            else "if the scan is in the scanner's own frame, say where the part stands: "
            "--scan-frame unknown --part-pose X,Y,Z,RZ"
        )
        raise AlignmentError(
            f"the part would stand at {where}, its foot {low[2]:.1f} mm above the bed; {cure}; "
            "if it does stand on a fixture, say --on-fixture"
        )
    if not said:
        raise AlignmentError(
            f"taken as bed coordinates, the scan puts the part at {where}, where nothing can "
            f"stand on a bed of {room[0]:g} × {room[1]:g} mm; if the scan is in the scanner's own "
            "frame, say where the part stands: --scan-frame unknown --part-pose X,Y,Z,RZ"
        )
    if low[2] < -SLACK_MM and not beyond:
        raise AlignmentError(
            f"this pose puts the part at {where}, {-low[2]:.1f} mm into the bed: a pose places the "
            f"origin of the part's own file; to stand on the bed it has Z = {shift_mm:.3f}"
        )
    raise AlignmentError(
        f"this pose puts the part at {where}, beyond the {room[0]:g} × {room[1]:g} × {room[2]:g} "
        f"mm of printer '{printer.id}'; a pose places the origin of the part's own file"
    )
