"""Where the scanner hangs over the bed: found once, written to a file, read by every run.

The bed gives height and tilt, what was printed on it the rest: a target that looks like itself
from one side alone, or the first layers of any job. Every turn about the vertical is tried.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import manifold3d
import numpy as np
from jaxtyping import Float

from amrepair.align.poses import off_mm
from amrepair.align.refine import refine
from amrepair.align.thinning import thin_out
from amrepair.arrays import Points, Values, Vector
from amrepair.errors import AlignmentError, InputError
from amrepair.frames import Transform, rotation_from_vector, turned_rad
from amrepair.scans import Scan
from amrepair.scans.ply import mm_per
from amrepair.template.port import Template
from gcode.profiles import PrinterProfile
from gcode.surfaces.sizes import in_words
from gcode.whole import put_in_place

SENSOR_RIGID = 1e-4
"""A rotation's rows are orthonormal to this."""
TARGET_MM = 1.0


@dataclass(frozen=True, slots=True)
class CalibrateOptions:
    """How the scanner's pose is found.

    Attributes
    ----------
    max_residual_mm
        Beyond it the refinement of every scan may start from the wrong place.
    turns, tried_points, finest
        Turns about the vertical that are tried, with how many points, and how many of the best
        are refined.
    fit_points, first_scale_mm
        Points of a refinement, and its loss's first scale: some degrees at the target's end.
    bed_tries, plane_mm, least_bed
        Planes that are tried for the bed, how near to it its points lie, and their least share.
    cap_mm
        A point farther off says no more.
    same_fit
        Another turn that fits within this factor may as well be the true one.
    least_apart_deg
        Poses that differ by less are one.
    """

    max_residual_mm: float = 0.15
    turns: int = 90
    tried_points: int = 1_000
    finest: int = 12
    fit_points: int = 10_000
    first_scale_mm: float = 2.0
    bed_tries: int = 200
    plane_mm: float = 0.15
    least_bed: float = 0.2
    cap_mm: float = 3.0
    same_fit: float = 1.25
    least_apart_deg: float = 20.0


USUAL_POSE = CalibrateOptions()
"""What `calibrate` goes by."""


@dataclass(frozen=True, slots=True)
class PoseCalibration:
    """A scanner's pose, and how well it is known.

    Attributes
    ----------
    residual_mm
        Root mean square distance of the target's points from where they should be.
    bed_mm
        The same of the bed's points from a plane: noise, and how flat the bed is.
    runner_up
        How many times worse the next best turn fits.
    """

    build_from_scanner: Transform
    residual_mm: float
    bed_mm: float
    runner_up: float
    points: int

    def to_json(self) -> dict[str, Any]:
        """As it stands in the file."""
        return {
            "build_from_scanner": self.build_from_scanner.matrix.tolist(),
            "residual_mm": round(self.residual_mm, 5),
            "bed_mm": round(self.bed_mm, 5),
            "runner_up": round(self.runner_up, 3),
            "points": self.points,
        }


def target_solid(printer: PrinterProfile) -> manifold3d.Manifold:
    """The printed target, build frame: an angle with unlike arms and a square off its end.

    Large, so that a turn shows; low, so that it is printed in minutes.
    """
    (x, y), (x0, y0) = printer.bed_size_mm, printer.bed_min_mm
    long_mm, short_mm = 0.45 * x, 0.3 * y
    corner = (x0 + 0.275 * x, y0 + 0.3 * y)
    arms = manifold3d.Manifold.cube((long_mm, 8.0, TARGET_MM)).translate((*corner, 0.0))
    arms += manifold3d.Manifold.cube((8.0, short_mm, TARGET_MM)).translate((*corner, 0.0))
    square = manifold3d.Manifold.cube((14.0, 14.0, TARGET_MM))
    return arms + square.translate((corner[0] + 0.7 * long_mm, corner[1] + 0.7 * short_mm, 0.0))


def calibrate(
    scan: Scan,
    standing: Template,
    *,
    options: CalibrateOptions = USUAL_POSE,
    rng: np.random.Generator | None = None,
) -> PoseCalibration:
    """Find the scanner's pose from a scan of the bed and of what stands on it.

    Parameters
    ----------
    scan
        In the scanner's own frame, whatever that is; the bed must be seen.
    standing
        What stands there, build frame.

    Raises
    ------
    AlignmentError
        If there is no bed, nothing on it, another turn fits as well, or the residual is too large.
    """
    rng = rng or np.random.default_rng(0)
    level, bed_mm = _level(scan, options, rng)
    flat = level.apply(scan.points_mm)
    top_mm = float(standing.bounds_mm[1, 2])
    above = (flat[:, 2] > min(0.5 * top_mm, top_mm - 3 * bed_mm)) & (flat[:, 2] < 2 * top_mm + 1)
    if above.sum() < 200:
        raise AlignmentError(
            f"the scan {scan.source} has {int(above.sum())} points above the bed, at least 200 are "
            "needed; is the target there, and is the bed seen around it?"
        )
    centre = _middle(standing)
    tried = thin_out(flat[above], options.tried_points, rng)
    angles = np.arange(options.turns) * 2 * np.pi / options.turns
    turns = [_turned(angle, tried, centre) for angle in angles]
    cost = [off_mm(standing.distance(turn.apply(tried)), options.cap_mm) for turn in turns]
    near = np.abs(flat[:, 2]) < top_mm + 1.0
    cloud = thin_out(scan.points_mm[near & _around(flat, flat[above])], options.fit_points, rng)
    limit_mm, apart_rad = max(0.1, 3 * scan.sigma_mm), np.deg2rad(options.least_apart_deg)
    fits: list[tuple[float, Transform]] = []
    for k in np.argsort(cost)[: options.finest]:
        if any(_apart(turns[k] @ level, other) < apart_rad for _, other in fits):
            continue
        pose = _fit(cloud, standing, turns[k] @ level, limit_mm, options.first_scale_mm)
        fits.append((_residual(standing, pose, cloud, options.cap_mm), pose))
    fits.sort(key=lambda fit: fit[0])
    residual_mm, pose = fits[0]
    others = [mm for mm, other in fits[1:] if _apart(pose, other) >= apart_rad]
    runner_up = min(others, default=np.inf) / max(residual_mm, 1e-6)
    if residual_mm > options.max_residual_mm:
        raise AlignmentError(
            f"the target lies {residual_mm:.3f} mm off where it should be (root mean square), the "
            f"limit is {options.max_residual_mm:g} mm; clean the bed, let the printer finish, scan "
            "again"
        )
    if runner_up < options.same_fit:
        raise AlignmentError(
            f"another turn of the scan fits nearly as well ({runner_up:.2f} times the residual, at "
            f"least {options.same_fit:g} is needed); use a target that looks like itself from one "
            "side only"
        )
    return PoseCalibration(pose, residual_mm, bed_mm, float(min(runner_up, 1e3)), len(cloud))


def write_calibration(
    path: Path, found: PoseCalibration, about: Mapping[str, str] | None = None
) -> None:
    """Write the file that `loop` reads, whole or not at all.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    try:
        with put_in_place(path) as draft:
            draft.write_text(json.dumps({**found.to_json(), **(about or {})}, indent=2) + "\n")
    except OSError as error:
        raise InputError(f"the calibration {path} cannot be written ({error.strerror})") from error


def _level(
    scan: Scan, options: CalibrateOptions, rng: np.random.Generator
) -> tuple[Transform, float]:
    """The bed as the plane of most points, up where the sensors or fewer points are."""
    points = thin_out(scan.points_mm, options.fit_points, rng)
    limit_mm = max(options.plane_mm, 3 * scan.sigma_mm)
    best: tuple[int, Vector, float] = (0, np.array([0.0, 0.0, 1.0]), 0.0)
    for _ in range(options.bed_tries):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        size = float(np.linalg.norm(normal))
        if size < 1e-6:
            continue
        normal = normal / size
        count = int((np.abs((points - a) @ normal) < limit_mm).sum())
        if count > best[0]:
            best = (count, normal, float(a @ normal))
    count, normal, offset = best
    if count < options.least_bed * len(points):
        raise AlignmentError(
            f"no plane holds {options.least_bed:.0%} of the points of {scan.source} (the best "
            f"{count} of {len(points)}); the bed must be seen around the target"
        )
    for limit in (limit_mm, limit_mm, 0.7 * limit_mm):
        on = points[np.abs(points @ normal - offset) < limit]
        middle = on.mean(axis=0)
        _, _, axes = np.linalg.svd(on - middle, full_matrices=False)
        normal, offset = axes[2], float(middle @ axes[2])
    distance = points @ normal - offset
    if scan.sensors_mm is not None:
        up = float(np.median(scan.sensors_mm @ normal - offset)) > 0
    else:
        up = int((distance > 2 * limit_mm).sum()) > int((distance < -2 * limit_mm).sum())
    if not up:
        normal, offset = -normal, -offset
    side = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    rotation = np.stack([side, np.cross(normal, side), normal])
    level = Transform.from_rotation_translation(
        "level", "scanner", rotation=rotation, translation_mm=np.array([0.0, 0.0, -offset])
    )
    return level, float(np.sqrt(((on @ axes[2] - middle @ axes[2]) ** 2).mean()))


def _middle(standing: Template) -> Vector:
    """The mean of what a scanner above would see of the target's top."""
    points, normals = standing.surface_points(1.0)
    top = points[normals[:, 2] > 0.7]
    return np.asarray(top.mean(axis=0))


def _turned(angle_rad: float, points: Points, centre: Vector) -> Transform:
    """Build from level: turned about the vertical, the middle of the points on the target's."""
    rotation = rotation_from_vector(np.array([0.0, 0.0, angle_rad]))
    shift = centre - rotation @ points.mean(axis=0)
    shift[2] = 0.0
    return Transform.from_rotation_translation(
        "build", "level", rotation=rotation, translation_mm=shift
    )


@dataclass(frozen=True, slots=True)
class _OnBed:
    """The field of a target and the bed that it stands on: whichever is nearer."""

    standing: Template

    def distance(self, points_mm: Points) -> Values:
        return np.minimum(self.standing.distance(points_mm), points_mm[:, 2])

    def distance_and_gradient(self, points_mm: Points) -> tuple[Values, Points]:
        f_mm, gradient = self.standing.distance_and_gradient(points_mm)
        bed = points_mm[:, 2] < f_mm
        up = np.array([0.0, 0.0, 1.0])
        return np.where(bed, points_mm[:, 2], f_mm), np.where(bed[:, None], up, gradient)


def _around(flat: Points, target: Float[np.ndarray, "m 3"]) -> Any:  # (n,) bool
    """Points within the target's box and a margin: the far bed tells no more than the near."""
    low, high = target[:, :2].min(axis=0) - 5.0, target[:, :2].max(axis=0) + 5.0
    return ((flat[:, :2] >= low) & (flat[:, :2] <= high)).all(axis=1)


def _fit(
    points: Points, standing: Template, guess: Transform, limit_mm: float, first_scale_mm: float
) -> Transform:
    """To the next minimum on the field of target and bed."""
    found = refine(
        points,
        _OnBed(standing),
        guess.matrix,
        start_scale_mm=first_scale_mm,
        end_scale_mm=limit_mm,
        sigma_mm=limit_mm / 3,
    )
    return Transform("build", "scanner", found.matrix)


def _residual(standing: Template, pose: Transform, points: Points, cap_mm: float) -> float:
    """Root mean square distance of the points from the target or the bed, whichever is nearer."""
    placed = pose.apply(points)
    off = np.minimum(np.abs(standing.distance(placed)), np.abs(placed[:, 2]))
    return float(np.sqrt((np.minimum(off, cap_mm) ** 2).mean()))


def _apart(a: Transform, b: Transform) -> float:
    """Angle between two poses, rad."""
    return turned_rad((a.matrix @ np.linalg.inv(b.matrix))[:3, :3])


def read_calibration(path: Path | None) -> tuple[Transform, str | None]:
    """The pose of a scanner, build from scanner, and its files' unit where one was said with it.

    The pose is identity where there is no file.

    Raises
    ------
    InputError
        If the file holds no pose, or its unit is none that a scan may have.
    """
    if path is None:
        return Transform.identity("build", "scanner"), None
    try:
        words = json.loads(path.read_text())
        matrix, unit = np.array(words["build_from_scanner"], float), words.get("scan_unit")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"the calibration {path} cannot be read ({in_words(error)}); it is a JSON object with "
            "build_from_scanner, a 4×4 matrix"
        ) from error
    if matrix.shape != (4, 4):
        raise InputError(f"the calibration {path} holds {matrix.shape}, not 4×4")
    turn = matrix[:3, :3]
    if not (np.abs(turn @ turn.T - np.eye(3)).max() < SENSOR_RIGID and np.linalg.det(turn) > 0):
        raise InputError(
            f"the calibration {path} is no rigid motion: its rotation stretches or mirrors; "
            "calibrate again"
        )
    if unit is not None:
        mm_per(str(unit), f"the calibration {path} says that scans are in")
    return Transform("build", "scanner", matrix), unit
