"""Scans onto each other, without a template: `propose` places each, point to plane disposes.

Each scan is placed on what is placed already; then all poses are refined together. What cannot be
placed is left out and named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from amrepair.align.thinning import thin_out
from amrepair.consensus.assemble import Poses, assemble, contradicted
from amrepair.consensus.propose import propose
from amrepair.consensus.together import Piece, Slack, slacks, together
from amrepair.consensus.views import VagueError, View, towards_sensors, views_of
from amrepair.errors import AlignmentError
from amrepair.frames import moved
from gcode.progress import Progress, silent

COARSE_POINTS = 15_000
GOOD_OVERLAP, LEAST_OVERLAP = 0.6, 0.25


@dataclass(frozen=True, slots=True)
class Placed:
    """Scans in the frame of the first of them that could be placed.

    Attributes
    ----------
    which
        Numbers of the scans that were placed.
    poses
        (4, 4) common frame from each of those scans.
    rmse_mm
        Point-to-plane, over what overlaps.
    left_out
        Numbers of the scans that fit nowhere.
    reasons
        By number of a scan that was left out, why; where more is known than that.
    views
        By number: what is known of where a scan's sensors stood.
    slacks
        How surely each of the placed scans is held, in their order.
    """

    which: tuple[int, ...]
    poses: tuple[Float[np.ndarray, "4 4"], ...]
    rmse_mm: float
    left_out: tuple[int, ...]
    reasons: Mapping[int, str] = field(default_factory=dict)
    views: Mapping[int, View] = field(default_factory=dict)
    slacks: tuple[Slack, ...] = ()


def place_all(
    pieces: Sequence[Piece], rng: np.random.Generator, progress: Progress = silent
) -> Placed:
    """Bring scans of one part into one frame.

    Raises
    ------
    AlignmentError
        If most of them do not fit each other.
    """
    sighted = _by_sight(pieces, rng, progress)
    if sighted is not None:
        return sighted
    thin = [thin_out(piece.points_mm, COARSE_POINTS, rng) for piece in pieces]
    diagonal_mm = max(float(np.linalg.norm(np.ptp(cloud, axis=0))) for cloud in thin)
    root = int(np.argmax([_coverage(cloud, diagonal_mm / 100) for cloud in thin]))
    poses: dict[int, np.ndarray] = {root: np.eye(4)}
    waiting = [k for k in range(len(pieces)) if k != root]
    proposed: dict[tuple[int, int], tuple[float, np.ndarray]] = {}
    bar = GOOD_OVERLAP
    while waiting:
        model = np.concatenate([moved(thin[k], poses[k]) for k in poses])
        size, found = len(poses), []
        for k in waiting:
            progress("align", float(len(poses)), float(len(pieces)))
            if (k, size) not in proposed:
                proposed[k, size] = propose(thin[k], model, diagonal_mm)
            if proposed[k, size][0] >= bar:
                found.append(k)
        if bar < GOOD_OVERLAP:  # the best of the doubtful; then the model has grown: look again
            found = sorted(found, key=lambda k: -proposed[k, size][0])[:1]
        for k in found:
            poses[k] = proposed[k, size][1]
            waiting.remove(k)
        if not found and bar == LEAST_OVERLAP:
            break
        bar = GOOD_OVERLAP if found else LEAST_OVERLAP
    if 2 * len(waiting) >= len(pieces):
        names = ", ".join(pieces[k].name for k in waiting)
        raise AlignmentError(
            f"{len(waiting)} of {len(pieces)} scans overlap the others by less than "
            f"{LEAST_OVERLAP:.0%}, or contradict them, in every pose that was tried ({names}); "
            "check that they show the same part in the same unit, scan with more overlap, give one "
            "view a file and where its sensor stood (--sensor-at), or the part's mesh beside them"
        )
    which = sorted(poses)
    chosen = [pieces[k] for k in which]
    refined, rmse_mm = together(chosen, [poses[k] for k in which], rng)
    home = np.linalg.inv(refined[0])
    placed = tuple(home @ pose for pose in refined)
    return Placed(
        tuple(which), placed, rmse_mm, tuple(sorted(waiting)),
        slacks=tuple(slacks(chosen, placed, rng)),
    )  # fmt: skip


def _by_sight(
    pieces: Sequence[Piece], rng: np.random.Generator, progress: Progress
) -> Placed | None:
    """Views by what their sensors saw through; None where a scan is no view of told sensors or one.

    Raises
    ------
    AlignmentError
        If most of the poses are not sure.
    """
    diagonal_mm = max(float(np.linalg.norm(np.ptp(p.points_mm, axis=0))) for p in pieces)
    views: list[View] = []
    reasons: dict[int, str] = {}
    for k, p in enumerate(pieces):
        try:
            own = views_of(
                k, p.points_mm, p.sensors_mm, p.sensor_index, diagonal_mm, p.sigma_mm, rng
            )
        except VagueError as error:
            reasons[k] = str(error)
            continue
        if not own:
            return None
        views += own
    found = assemble(views, diagonal_mm, progress)
    reasons |= found.reasons
    poses, rmse_mm = _refined(pieces, found.views, found.poses, rng)
    for k, reason in contradicted(found.views, poses).items():
        reasons[k] = reason
        del poses[k]
    if 2 * len(poses) <= len(pieces):
        same: dict[str, list[str]] = {}
        for k, reason in sorted(reasons.items()):
            same.setdefault(reason, []).append(pieces[k].name)
        said = "; ".join(f"{', '.join(names)}: {reason}" for reason, names in same.items())
        raise AlignmentError(
            f"{len(pieces) - len(poses)} of {len(pieces)} views cannot be placed ({said}); scan "
            "with more overlap, tell where the sensors stood (--sensor-at, or in the files), "
            "export the views in one frame, or give the part's mesh beside them"
        )
    which = sorted(poses)
    home = np.linalg.inv(poses[which[0]])
    placed = tuple(home @ poses[k] for k in which)
    return Placed(
        tuple(which),
        placed,
        rmse_mm,
        tuple(sorted(set(range(len(pieces))) - set(which))),
        reasons,
        {k: found.views[k] for k in which},
        tuple(slacks([_facing(pieces[k], found.views[k]) for k in which], placed, rng)),
    )


def _refined(
    pieces: Sequence[Piece], views: Mapping[int, View], poses: Poses, rng: np.random.Generator
) -> tuple[Poses, float]:
    which = sorted(poses)
    if not which:
        return {}, 0.0
    facing = [_facing(pieces[k], views[k]) for k in which]
    refined, rmse_mm = together(facing, [poses[k] for k in which], rng)
    return dict(zip(which, refined, strict=True)), rmse_mm


def _facing(piece: Piece, view: View) -> Piece:
    """With normals to the side from which it was seen: both sides of a wall are no pair."""
    normals = towards_sensors(piece.points_mm, piece.normals, view.looks).normals
    return replace(piece, normals=normals, faces=True)


def _coverage(points_mm: Float[np.ndarray, "n 3"], voxel_mm: float) -> int:
    return len(np.unique(np.floor(points_mm / voxel_mm).astype(np.int64), axis=0))
