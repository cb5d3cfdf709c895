"""`fit_from_scans`: a template from sound scans or views, without the part's mesh."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import amrepair
from amrepair.arrays import Mask, Matrix, Points, Values, Vector
from amrepair.errors import InputError
from amrepair.frames import diagonal
from amrepair.merge.cloud import outward_by, planes, spacing_of
from amrepair.merge.fuse import Cloud, Fused, fuse, widened
from amrepair.merge.joint import Slack
from amrepair.merge.options import DEFAULT_MERGE, MergeOptions
from amrepair.merge.place import Placement, place
from amrepair.merge.views import View
from amrepair.scans import Scan
from amrepair.template import GridSdf, MeshSdf
from amrepair.template.fit import fit_fast
from amrepair.template.grid import Coverage
from amrepair.template.learned import LearnedSdf
from gcode.progress import Progress, silent

METRE_MM, LEAST_PART_MM = 1000.0, 1.0  # no printed part is smaller: its numbers are metres


@dataclass(frozen=True, slots=True)
class ScanFit:
    """A template from scans, and what went into it.

    Attributes
    ----------
    poses
        (4, 4) template from scan, None for scans that were left out; scan in mm.
    left_out
        By number of a scan: why.
    outvoted
        By number of a scan: the mm² on which the others outvoted it.
    """

    template: GridSdf
    fused: Fused
    poses: tuple[Matrix | None, ...]
    sigma_mm: float
    rmse_mm: float
    left_out: Mapping[int, str]
    outvoted: Mapping[int, float]

    def as_json(self, scans: Sequence[str]) -> dict[str, Any]:
        """What `template fit --json` prints of it."""
        return {
            "scans": rows_of_scans(scans, self.poses, self.left_out, self.outvoted),
            "noise_mm": self.sigma_mm,
            "rmse_mm": self.rmse_mm,
            "unseen_mm2": self.fused.coverage.unseen_mm2,
            "unseen_ratio": self.fused.unseen_ratio,
        }


def rows_of_scans(
    scans: Sequence[str],
    poses: Sequence[Matrix | None],
    left_out: Mapping[int, str],
    outvoted: Mapping[int, float],
) -> list[dict[str, Any]]:
    """What became of each scan, for `--json`."""
    return [
        {
            "file": name,
            "pose": None if pose is None else pose.tolist(),
            "left_out": left_out.get(k),
            "outvoted_mm2": outvoted.get(k, 0.0),
        }
        for k, (name, pose) in enumerate(zip(scans, poses, strict=True))
    ]


def fit_from_scans(
    scans: Sequence[Scan],
    *,
    poses: Mapping[str, Matrix] | None = None,
    turntable_deg: float | None = None,
    options: MergeOptions = DEFAULT_MERGE,
    seed: int = 0,
    progress: Progress = silent,
) -> ScanFit:
    """Fit a template to sound scans of one part.

    Parameters
    ----------
    scans
        Noisy, overlapping, partial, each in a frame of its own; the template's frame is the first
        scan's (of those that could be placed). A part that would be smaller than a millimetre is
        taken for one in metres, and that is said.
    poses
        By file name, (4, 4) common frame from scan, in the scans' unit: where to begin.
    turntable_deg
        The scans are a turntable's, in their order, so far apart.

    Raises
    ------
    InputError
        If there are too few points, or the scans' sizes tell of different units.
    AlignmentError
        If most scans do not fit each other.
    TemplateError
        If they enclose no solid.
    """
    scans, unit_mm = _in_millimetres(scans)
    _refuse(scans, options)
    rng = np.random.default_rng(seed)
    views = []
    for k, scan in enumerate(scans):
        progress("measure scans", float(k), float(len(scans)))
        views.append(View.of(scan, rng, options))
    placed = place(
        views, rng, told=poses, unit_mm=unit_mm, turntable_deg=turntable_deg,
        options=options, progress=progress,
    )  # fmt: skip
    progress("fuse scans", 0.0, 1.0)
    cloud = _joined(views, placed)
    fused = fuse(cloud, options=options.fuse)
    progress("fuse scans", 1.0, 1.0)
    weak = {k: s for k, s in placed.slacks.items() if s.sigma_mm > cloud.sigma_mm}
    outvoted = _outvoted(cloud, fused, list(placed.poses), options)
    notes = (
        *(["the scans are taken as metres: as millimetres the part would be smaller than one"]
          if unit_mm != 1.0 else []),
        *_notes(scans, placed, fused, options),
        *(said_outvoted(scans[k], outvoted[k], at_mm)
          for k, at_mm in zip(placed.poses, fused.outvoted_at_mm, strict=True) if k in outvoted),
        *_said_weak(scans, weak),
    )  # fmt: skip
    made = fit_fast(
        MeshSdf.from_mesh(fused.mesh),
        seed=seed,
        least_residual_mm=options.followed_noises * cloud.sigma_mm,
        metadata=_metadata(scans, notes, seed),
        progress=progress,
    )
    return ScanFit(
        template=_with_tolerance(made, cloud, fused, placed, weak),
        fused=fused,
        poses=tuple(placed.poses.get(k) for k in range(len(scans))),
        sigma_mm=cloud.sigma_mm,
        rmse_mm=placed.rmse_mm,
        left_out=placed.left_out,
        outvoted=outvoted,
    )


def _in_millimetres(scans: Sequence[Scan]) -> tuple[list[Scan], float]:
    """The scans in mm, and what their unit is."""
    sizes = [diagonal(scan.points_mm) for scan in scans]
    if not scans or max(sizes) >= LEAST_PART_MM:
        return list(scans), 1.0
    return [
        replace(
            scan,
            points_mm=METRE_MM * scan.points_mm,
            sensors_mm=None if scan.sensors_mm is None else METRE_MM * scan.sensors_mm,
        )
        for scan in scans
    ], METRE_MM


def _refuse(scans: Sequence[Scan], options: MergeOptions) -> None:
    if not scans:
        raise InputError("a template from scans needs at least one scan; none was given")
    for scan in scans:
        if len(scan) < options.view.least_points:
            raise InputError(
                f"the scan {scan.source} has {len(scan)} points; a template needs at least "
                f"{options.view.least_points:,} of each scan"
            )
    sizes = [diagonal(scan.points_mm) for scan in scans]
    usual = float(np.median(sizes))
    for scan, size in zip(scans, sizes, strict=True):
        if not usual / options.unit_size_jump < size < usual * options.unit_size_jump:
            hint = " (metres for millimetres?)" if size < usual / 100 else ""
            raise InputError(
                f"the scan {scan.source} is {size:.3g} mm across, the scans' median is "
                f"{usual:.3g} mm: they cannot be the same part in the same unit{hint}; convert "
                "or remove it"
            )


def _joined(views: Sequence[View], placed: Placement) -> Cloud:
    """All placed points with outward normals."""
    chosen = {k: views[k] for k in placed.poses}
    points = [v.surface.points_mm @ placed.poses[k][:3, :3].T + placed.poses[k][:3, 3]
              for k, v in chosen.items()]  # fmt: skip
    normals = [v.surface.normals @ placed.poses[k][:3, :3].T for k, v in chosen.items()]
    scan = np.repeat(np.arange(len(chosen)), [len(p) for p in points])
    spacings = np.array([view.spacing_mm for view in chosen.values()])
    every, facing = np.concatenate(points), np.concatenate(normals)
    # where the scans overlap little, the joint cloud is no denser than one of them
    spacing_mm = max(float((spacings**-2.0).sum() ** -0.5), spacing_of(every))
    sure = np.concatenate([view.sure for view in chosen.values()])
    sigma_mm = max(view.sigma_mm for view in chosen.values())
    if not sure.all():
        tilt = np.concatenate([view.tilt_rad for view in chosen.values()])
        facing = _by_all(every, facing, sure, tilt, spacing_mm, sigma_mm)
    return Cloud(every, facing, scan, len(chosen), spacing_mm, sigma_mm, float(spacings.max()))


def _by_all(
    points_mm: Points,
    normals: Points,
    sure: Mask,
    tilt_rad: Values,
    spacing_mm: float,
    sigma_mm: float,
) -> Points:
    """Outward normals by what all scans have about a place, where that tells them better.

    Together they are denser, and reach less far across thin walls.
    """
    every = planes(points_mm, spacing_mm)
    better = (every.tilt_rad < tilt_rad) & ~sure
    found = np.where(better[:, None], every.normals, normals)
    return outward_by(points_mm, found, sure, spacing_mm, sigma_mm)


def _outvoted(
    cloud: Cloud, fused: Fused, which: Sequence[int], options: MergeOptions
) -> dict[int, float]:
    """By number of a scan: the mm² on which it was outvoted, where that is no chance."""
    least_mm2 = max(
        options.outvoted_spacings * cloud.sparsest_mm**2,
        options.outvoted_share * float(fused.mesh.area),
        options.outvoted_times * float(np.median(fused.outvoted_mm2)),
    )
    return {
        k: float(area)
        for k, area in zip(which, fused.outvoted_mm2, strict=True)
        if area > least_mm2
    }


def _with_tolerance(
    made: GridSdf,
    cloud: Cloud,
    fused: Fused,
    placed: Placement,
    weak: Mapping[int, Slack],
) -> GridSdf:
    """The template with how far sound parts differ, and where nobody knows."""
    spread = fused.spread
    if spread is not None and weak:
        slack_mm = np.zeros(len(cloud.points_mm))
        for place_, k in enumerate(placed.poses):
            if k in weak:
                own = cloud.scan == place_
                slack_mm[own] = weak[k].across(cloud.points_mm[own], cloud.normals[own])
        spread = widened(spread, cloud, slack_mm)
    coverage: Coverage | None = None if fused.coverage.unseen_mm2 == 0.0 else fused.coverage
    fitted = replace(
        made,
        bias_mm=float(np.hypot(made.bias_mm, 2.0 * fused.standard_error_mm)),
        coverage=coverage,
    )
    if spread is None:
        return fitted
    return LearnedSdf.on(fitted, spread)


def _metadata(scans: Sequence[Scan], notes: Sequence[str], seed: int) -> dict[str, str]:
    return {
        "recipe": "fast",
        "seed": str(seed),
        "version": amrepair.__version__,
        "notes": "; ".join(notes),
        "scans": json.dumps([{"source": s.source, "sha256": _sha256(s)} for s in scans]),
    }


def _notes(
    scans: Sequence[Scan], placed: Placement, fused: Fused, options: MergeOptions
) -> list[str]:
    used = len(placed.poses)
    notes = [f"{used} of {len(scans)} scans merged"]
    notes += [f"{scans[k].source} {why}, and was left out" for k, why in placed.left_out.items()]
    if fused.unseen_ratio > options.told_share:
        notes.append(
            f"{fused.coverage.unseen_mm2:,.0f} mm² ({fused.unseen_ratio:.1%}) of the surface was "
            "seen by no scan and is closed by a guess, is unknown, and is never called missing"
        )
    if used > 1 and fused.single_ratio > 0.05:
        notes.append(f"{fused.single_ratio:.0%} of the surface was seen by one scan only")
    if fused.rejected:
        notes.append(f"{fused.rejected} points contradicted by other scans were left out")
    return notes


def said_outvoted(scan: Scan, area_mm2: float, at_mm: Vector) -> str:
    """That the others outvoted a scan, over what area and where."""
    x, y, z = at_mm
    return (
        f"{scan.source} differs from the others over {area_mm2:,.0f} mm² about "
        f"({x:.1f}, {y:.1f}, {z:.1f}) mm (the template's frame) and was outvoted there: "
        "look at that part, or that scan"
    )


def _said_weak(scans: Sequence[Scan], weak: Mapping[int, Slack]) -> list[str]:
    return [
        f"{scans[k].source} is held along ({x:.2f}, {y:.2f}, {z:.2f}) to "
        f"{slack.sigma_mm:.2f} mm only (standard deviation, the template's frame), since it shares "
        "hardly a face across that with the others. What it alone saw there may be off by three "
        "times that, and is tolerated as far. Add a view that shows faces across that direction "
        "beside faces that the others show"
        for k, slack in weak.items()
        for x, y, z in [slack.axis]
    ]


def _sha256(scan: Scan) -> str:
    return hashlib.sha256(np.ascontiguousarray(scan.points_mm).tobytes()).hexdigest()
