"""Poses that files tell (Stanford's `.conf`, MeshLab's `.aln`, `poses.json`), and turntables.

What is told is where to begin, not what is believed: the views decide.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from amrepair.arrays import Matrix
from amrepair.errors import AlignmentError, InputError
from amrepair.frames import moved, nearest_rotation, rigid
from amrepair.merge.match import featured, searched
from amrepair.merge.options import MergeOptions
from amrepair.merge.views import Placed, View, joined

POSES_FILE = "poses.json"
TOLD_RIGID = 1e-3  # how far a rotation may be from one: files round to five digits or so
TRIAL_POINTS = 1_000  # of a view, that decide which way round a rotation is written
TABLE_TURN_RAD = 0.06  # 3.5°: how far a pair's own turn may be from the table's


def read_poses(path: Path) -> dict[str, Matrix]:
    """(4, 4) common frame from view, by the view's file name; translations in the files' unit.

    Raises
    ------
    InputError
        If the file cannot be read, or a pose in it is no rigid motion.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
        read = {".conf": _conf, ".aln": _aln, ".json": _json}.get(path.suffix.lower())
        if read is None:
            raise InputError(
                f"{path} ends in '{path.suffix}'; poses are read from .conf, .aln, .json"
            )
        found = read(text)
    except OSError as error:
        raise InputError(f"the poses {path} cannot be read ({error.strerror})") from error
    except (ValueError, IndexError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is no file of poses ({error}); check its format") from error
    if not found:
        raise InputError(f"{path} tells no pose; it should have one for each view")
    for name, pose in found.items():
        turn = pose[:3, :3] if pose.shape == (4, 4) else np.zeros((3, 3))
        off = float(np.abs(turn @ turn.T - np.eye(3)).max())
        if not off < TOLD_RIGID or np.linalg.det(turn) < 0 or not np.isfinite(pose).all():
            raise InputError(
                f"the pose of {name} in {path} is no rigid motion (its rotation is off by "
                f"{off:.2g}, {TOLD_RIGID:g} is allowed); a pose is a (4, 4) common frame from view"
            )
    return found


def _conf(text: str) -> dict[str, Matrix]:
    """`bmesh NAME tx ty tz qx qy qz qw`: the quaternion turns the frame, not the points."""
    found = {}
    for line in text.splitlines():
        words = line.split()
        if len(words) == 9 and words[0] in {"bmesh", "mesh"}:
            turn = Rotation.from_quat([float(w) for w in words[5:]]).inv().as_matrix()
            found[words[1]] = rigid(turn, np.array([float(w) for w in words[2:5]]))
    return found


def _aln(text: str) -> dict[str, Matrix]:
    """A count; then of each view its name, a line `#`, and four rows."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    found = {}
    for k in range(1, len(lines) - 5):
        if lines[k + 1].startswith("#"):
            rows = [[float(w) for w in line.split()] for line in lines[k + 2 : k + 6]]
            found[lines[k]] = np.array(rows)
    return found


def _json(text: str) -> dict[str, Matrix]:
    """`{"NAME": [[…]…]…}`, or the same under `views` or `poses`; rows, or sixteen numbers."""
    told = json.loads(text)
    told = told.get("views", told.get("poses", told))
    return {name: np.array(pose, dtype=float).reshape(4, 4) for name, pose in told.items()}


def of_views(told: Mapping[str, Matrix], views: Sequence[View], unit_mm: float) -> Placed:
    """The poses by the views' numbers, mm; views that the file does not name have none.

    Some files write rotations of some views the other way round (the Stanford bunny's do): the way
    that lays a view nearer to those before it is taken.
    """
    by_stem = {Path(name).stem: pose for name, pose in told.items()}
    placed: Placed = {}
    for k, view in enumerate(views):
        pose = told.get(Path(view.name).name, by_stem.get(Path(view.name).stem))
        if pose is None:
            continue
        ways = [pose.copy(), pose.copy()]
        ways[1][:3, :3] = pose[:3, :3].T
        for way in ways:
            way[:3, :3] = nearest_rotation(way[:3, :3])
            way[:3, 3] *= unit_mm
        if placed:
            known = joined(views, placed, TRIAL_POINTS).tree
            few = view.thin.points_mm[view.thin.some(TRIAL_POINTS)]
            ways.sort(key=lambda way: float(np.median(known.query(moved(few, way))[0])))
        placed[k] = ways[0]
    return placed


def on_turntable(
    views: Sequence[View], degrees: float, size_mm: float, options: MergeOptions
) -> Placed:
    """Poses of views that a turntable took in their order, that many degrees apart.

    The axis is the one about which neighbours turn by that angle onto each other; of several pairs
    the surest tells it.

    Raises
    ------
    AlignmentError
        If no two neighbours turn onto each other by that angle.
    """
    angle = np.deg2rad(degrees)
    best: tuple[float, np.ndarray] | None = None
    for ask in (featured, lambda views, *of: searched(views, {}, *of)):
        for k in range(len(views) - 1):
            for fit in ask(views, k, k + 1, size_mm, options):
                turn = Rotation.from_matrix(fit.pose[:3, :3]).as_rotvec()
                turns = abs(np.linalg.norm(turn) - abs(angle)) < TABLE_TURN_RAD
                better = best is None or fit.score > best[0]
                if turns and better and not fit.why_not(options):
                    best = fit.score, fit.pose
        if best is not None:
            return _about(best[1], angle, len(views))
    raise AlignmentError(
        f"no two neighbouring views turn onto each other by {degrees:g}°; check the angle and the "
        "views' order, or leave --turntable out"
    )


def _about(pose: Matrix, angle: float, count: int) -> Placed:
    """Turns about a pose's axis: the first view's frame from each view."""
    turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    axis = turn / np.linalg.norm(turn)
    # (1 − R) c = t, and what of t runs along the axis is error
    across = pose[:3, 3] - (pose[:3, 3] @ axis) * axis
    centre = np.linalg.lstsq(np.eye(3) - pose[:3, :3], across, rcond=None)[0]
    placed: Placed = {}
    for k in range(count):
        rotation = Rotation.from_rotvec(k * abs(angle) * axis).as_matrix()
        placed[k] = rigid(rotation, centre - rotation @ centre)
    return placed
