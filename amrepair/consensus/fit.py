"""`fit_from_scans`: a template from normal scans, with or without the part's mesh."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

import amrepair
from amrepair.align import align
from amrepair.consensus.cloud import outward, planes, spacing_of
from amrepair.consensus.fuse import Cloud, Fused, fuse
from amrepair.consensus.register import Placed, place_all
from amrepair.consensus.together import Piece, Slack
from amrepair.consensus.views import towards_sensors
from amrepair.errors import AlignmentError, InputError
from amrepair.scans import Scan
from amrepair.template import LearnedSdf, MeshSdf
from amrepair.template.fit import fit_fast
from amrepair.template.learned import Tolerance
from gcode.progress import Progress, silent

if TYPE_CHECKING:
    import trimesh

LEAST_POINTS = 2_000
MAX_POINTS = 400_000  # of one scan; more add time, not accuracy
# Of one point's noise: a template that follows what is finer is larger, slower, and no truer (4
# scans of 200,000 points, noise 30 µm: 8.8 µm off, 8.2 so).
FOLLOWED = 0.5
SIZE_JUMP = 3.0  # scans of one part in one unit differ by less
# A scan whose pose is known no better than one of its points is said to be; nor is one that is
# known to this.
SURE_MM = 0.02
ALONE = Placed((0,), (np.eye(4),), 0.0, ())


@dataclass(frozen=True, slots=True)
class ScanFit:
    """A template from scans, and what went into it.

    Attributes
    ----------
    poses
        (4, 4) template from scan, None for scans that were left out.
    notes
        Sentences for the user.
    """

    template: LearnedSdf
    fused: Fused
    poses: tuple[Float[np.ndarray, "4 4"] | None, ...]
    sigma_mm: float
    rmse_mm: float
    notes: tuple[str, ...]


def fit_from_scans(
    scans: Sequence[Scan],
    *,
    mesh: trimesh.Trimesh | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> ScanFit:
    """Fit a template to normal scans of one part.

    Parameters
    ----------
    scans
        Noisy, overlapping, partial, each in a frame of its own; the template's frame is the first
        scan's (of those that could be placed), or the mesh's.
    mesh
        The nominal shape: scans are aligned to it, and it stands where no scan looked.

    Raises
    ------
    InputError
        If there are too few points, or the scans' sizes tell of different units.
    AlignmentError
        If most scans do not fit each other, or none fits the mesh.
    TemplateError
        If they enclose no solid.
    """
    _refuse(scans)
    rng = np.random.default_rng(seed)
    pieces = []
    for k, scan in enumerate(scans):
        progress("fit: scans", 0.2 * k / len(scans), 1.0)
        pieces.append(_piece(scan, rng))
    nominal = None if mesh is None else MeshSdf.from_mesh(mesh)
    if nominal is None:
        placed = place_all(pieces, rng, progress) if len(pieces) > 1 else ALONE
    else:
        placed = _on_mesh(scans, nominal, rng)
    progress("fit: scans", 0.7, 1.0)
    cloud = _joined([pieces[k] for k in placed.which], [scans[k] for k in placed.which], placed)
    fused = fuse(cloud, behind=nominal)
    progress("fit: scans", 1.0, 1.0)
    weak = _weak(placed, cloud.sigma_mm)
    notes = (*_notes(scans, placed, fused, len(placed.which)), *_said(scans, placed, weak))
    closed = fused.mesh
    closed.metadata["notes"] = notes
    metadata = {
        "recipe": "fast",
        "seed": str(seed),
        "version": amrepair.__version__,
        "notes": "; ".join(notes),
        "scans": json.dumps([{"source": s.source, "sha256": _sha256(s)} for s in scans]),
    }
    made = fit_fast(
        MeshSdf.from_mesh(closed),
        seed=seed,
        least_residual_mm=FOLLOWED * cloud.sigma_mm,
        metadata=metadata,
        progress=progress,
    )
    spread = fused.spread
    if spread is not None and weak:
        spread = spread.widened(cloud, _slack_mm(cloud, placed, weak))
    template = replace(
        made,
        bias_mm=float(np.hypot(made.bias_mm, 2.0 * fused.standard_error_mm)),
        tolerance=None
        if spread is None
        else Tolerance(spread.origin_mm, spread.cell_mm, spread.values_mm),
    )
    poses: list[np.ndarray | None] = [None] * len(scans)
    for k, pose in zip(placed.which, placed.poses, strict=True):
        poses[k] = pose
    return ScanFit(template, fused, tuple(poses), cloud.sigma_mm, placed.rmse_mm, notes)


def _refuse(scans: Sequence[Scan]) -> None:
    if not scans:
        raise InputError("a template from scans needs at least one scan; none was given")
    for scan in scans:
        if len(scan) < LEAST_POINTS:
            raise InputError(
                f"the scan {scan.source} has {len(scan)} points; a template needs at least "
                f"{LEAST_POINTS:,} of each scan"
            )
    sizes = [float(np.linalg.norm(np.ptp(scan.points_mm, axis=0))) for scan in scans]
    usual = float(np.median(sizes))
    for scan, size in zip(scans, sizes, strict=True):
        if not usual / SIZE_JUMP < size < usual * SIZE_JUMP:
            hint = " (metres for millimetres?)" if size < usual / 100 else ""
            raise InputError(
                f"the scan {scan.source} is {size:.3g} mm across, the scans' median is "
                f"{usual:.3g} mm: they cannot be the same part in the same unit{hint}; convert "
                "or remove it"
            )


def _piece(scan: Scan, rng: np.random.Generator) -> Piece:
    chosen = np.arange(len(scan))
    if len(chosen) > MAX_POINTS:
        chosen = np.sort(rng.permutation(len(chosen))[:MAX_POINTS])
    distinct, first = np.unique(scan.points_mm[chosen], axis=0, return_index=True)
    if len(distinct) < LEAST_POINTS:
        raise InputError(
            f"the scan {scan.source} has only {len(distinct)} different points among "
            f"{len(chosen)}; check the export"
        )
    spacing_mm = spacing_of(distinct)
    plane = planes(distinct, spacing_mm)
    index = None if scan.sensor_index is None else scan.sensor_index[chosen][first]
    return Piece(scan.source, distinct, plane.normals, plane.rough_mm, spacing_mm, plane.sigma_mm,
                 cKDTree(distinct), scan.sensors_mm, index)  # fmt: skip


def _on_mesh(scans: Sequence[Scan], nominal: MeshSdf, rng: np.random.Generator) -> Placed:
    """Each scan on the nominal shape; those that do not fit it are left out."""
    which, poses, squares, left_out, reasons = [], [], [], [], []
    for k, scan in enumerate(scans):
        try:
            found = align(scan, nominal, rng=rng)
        except AlignmentError as error:
            left_out.append(k)
            reasons.append(str(error))
            continue
        which.append(k)
        poses.append(np.array(found.template_from_scan.matrix))
        squares.append(found.rmse_mm**2)
    if 2 * len(left_out) >= len(scans):
        raise AlignmentError(
            f"{len(left_out)} of {len(scans)} scans do not fit the mesh: {reasons[0]}"
        )
    return Placed(tuple(which), tuple(poses), float(np.sqrt(np.mean(squares))), tuple(left_out))


def _joined(pieces: Sequence[Piece], scans: Sequence[Scan], placed: Placed) -> Cloud:
    """All placed points with outward normals."""
    points = np.concatenate(
        [p.points_mm @ m[:3, :3].T + m[:3, 3] for p, m in zip(pieces, placed.poses, strict=True)]
    )
    normals = np.concatenate(
        [p.normals @ m[:3, :3].T for p, m in zip(pieces, placed.poses, strict=True)]
    )
    scan = np.repeat(np.arange(len(pieces)), [len(p.points_mm) for p in pieces])
    spacing_mm = float(1.0 / np.sqrt(sum(1.0 / p.spacing_mm**2 for p in pieces)))
    # where the scans overlap little, the joint cloud is no denser than one of them
    spacing_mm = max(spacing_mm, spacing_of(points))
    sigma_mm = max(p.sigma_mm for p in pieces)
    out = outward(points, normals, spacing_mm)
    for k, (number, pose) in enumerate(zip(placed.which, placed.poses, strict=True)):
        if number in placed.views:
            own = scan == k
            looks = placed.views[number].looks
            facing = towards_sensors(pieces[k].points_mm, pieces[k].normals, looks)
            sure = facing.sure | ~looks.guessed
            out[own] = np.where(sure[:, None], facing.normals @ pose[:3, :3].T, out[own])
    return Cloud(points, out, scan, len(pieces), spacing_mm, sigma_mm)


def _notes(scans: Sequence[Scan], placed: Placed, fused: Fused, used: int) -> tuple[str, ...]:
    notes = [f"consensus of {used} of {len(scans)} scans"]
    for k in placed.left_out:
        reason = placed.reasons.get(k, "fits none of the others")
        notes.append(f"{scans[k].source} {reason}, and was left out")
    if fused.unseen_ratio > 0.002:
        notes.append(f"{fused.unseen_ratio:.1%} of the surface was seen by no scan and is a guess")
    if used > 1 and fused.single_ratio > 0.05:
        notes.append(f"{fused.single_ratio:.0%} of the surface was seen by one scan only")
    if fused.rejected:
        notes.append(f"{fused.rejected} points contradicted by other scans were left out")
    return tuple(notes)


def _weak(placed: Placed, noise_mm: float) -> dict[int, Slack]:
    """By place in the list: of scans whose surface may be off by more than their points are."""
    limit_mm = max(noise_mm, SURE_MM)
    return {k: slack for k, slack in enumerate(placed.slacks) if slack.sigma_mm > limit_mm}


def _said(scans: Sequence[Scan], placed: Placed, weak: Mapping[int, Slack]) -> list[str]:
    return [
        f"{scans[placed.which[k]].source} is held along ({x:.2f}, {y:.2f}, {z:.2f}) to "
        f"{slack.sigma_mm:.2f} mm only (standard deviation, the template's frame), since it shares "
        "hardly a face across that with the others. What it alone saw there may be off by three "
        "times that, and is tolerated as far. Add a view that shows faces across that direction "
        "beside faces that the others show"
        for k, slack in weak.items()
        for x, y, z in [slack.axis]
    ]


def _slack_mm(cloud: Cloud, placed: Placed, weak: Mapping[int, Slack]) -> Float[np.ndarray, " n"]:
    """(n,) of each point: standard deviation of its scan's pose across the surface."""
    found = np.zeros(len(cloud.points_mm))
    for k, slack in weak.items():
        own = cloud.scan == k
        found[own] = slack.across(cloud.points_mm[own], cloud.normals[own])
    return found


def _sha256(scan: Scan) -> str:
    return hashlib.sha256(np.ascontiguousarray(scan.points_mm).tobytes()).hexdigest()
