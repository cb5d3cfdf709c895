"""PAM, the Pose Alignment Module of PASDF, as the paper has it: `--method paper`.

FPFH features, RANSAC with two checks, ICP, and again from the aligned source until the Chamfer loss
is small enough. Lengths are in units of the template's radius about its mean. The released code's
differences and the paper's ablations are options by name. It looks for no symmetric poses and
computes no better answer than the published one; `refine` does. open3d is loaded on first use.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from amrepair.align.options import PUBLISHED_PAM, PamOptions
from amrepair.align.registration import Registration
from amrepair.arrays import Matrix, Points, Vector
from amrepair.device import open3d
from amrepair.errors import AlignmentError
from amrepair.frames import Transform, diagonal, moved, nearest_rotation, rigid
from amrepair.scans import Scan
from amrepair.template.port import Template
from gcode.progress import Progress, silent

# What the directed loss of the released code is multiplied by.
DIRECTED_FACTOR = 100.0


class PamError(AlignmentError):
    """PAM ended above its threshold; the last pose rides along.

    Attributes
    ----------
    matrix
        (4, 4) target from source after the last iteration.
    loss, threshold
        Of the last iteration.
    """

    def __init__(self, message: str, *, matrix: Matrix, loss: float, threshold: float) -> None:
        super().__init__(message)
        self.matrix, self.loss, self.threshold = matrix, loss, threshold


@dataclass(frozen=True, slots=True)
class PamResult:
    """Where PAM ended below its threshold.

    Attributes
    ----------
    matrix
        (4, 4) target from source, mm.
    radius_mm
        The unit of its lengths.
    """

    matrix: Matrix
    loss: float
    threshold: float
    iterations: int
    radius_mm: float


def pam(
    source_mm: Points,
    target_mm: Float[np.ndarray, "m 3"],
    *,
    options: PamOptions = PUBLISHED_PAM,
    rng: np.random.Generator,
    source: str = "source",
    progress: Progress = silent,
) -> PamResult:
    """Algorithm 1: align a cloud to the template's cloud.

    Parameters
    ----------
    source_mm, target_mm
        (n, 3) and (m, 3), each in a frame of its own.
    rng
        Seeds RANSAC. Open3D runs it on several threads: with more than one the result may differ
        from run to run.

    Raises
    ------
    PamError
        If the loss stays above the threshold for all iterations.
    """
    o3d = open3d()
    o3d.utility.random.seed(int(rng.integers(2**31)))
    # The library prints warnings to standard output, which belongs to the caller.
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    middle, start = target_mm.mean(axis=0), source_mm.mean(axis=0)
    radius_mm = float(np.linalg.norm(target_mm - middle, axis=1).max())
    target = (target_mm - middle) / radius_mm
    moving = (source_mm - start) / radius_mm
    pose = np.eye(4)
    prepared = _prepare(target, options) if options.ransac else None
    threshold = options.threshold
    loss = np.inf
    rounds = options.iterations if options.iterate else 1
    for k in range(1, rounds + 1):
        progress("align", float(k - 1), float(rounds))
        step = _register(moving, target, prepared, options)
        moving = moved(moving, step)
        pose = step @ pose  # the ICP result already holds the RANSAC step: composed once
        loss = _loss(moving, target, options, rng)
        if loss < threshold:
            return PamResult(_in_mm(pose, start, middle, radius_mm), loss, threshold, k, radius_mm)
        if k < rounds:
            threshold += options.threshold_step
    raise PamError(
        f"PAM did not converge on {source}: its loss is {loss:.4g} after {rounds} iterations, the "
        f"limit is {threshold:.4g}; try another voxel, or the method robust",
        matrix=_in_mm(pose, start, middle, radius_mm),
        loss=float(loss),
        threshold=float(threshold),
    )


def _in_mm(pose: Matrix, start: Vector, middle: Vector, radius_mm: float) -> Matrix:
    rotation = nearest_rotation(pose[:3, :3])  # ten products of rotations drift
    return rigid(rotation, middle + radius_mm * pose[:3, 3] - rotation @ start)


def _cloud(points: Points) -> Any:
    o3d = open3d()
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def _prepare(points: Points, options: PamOptions) -> tuple[Any, Any]:
    """Down-sampled cloud and its FPFH."""
    o3d = open3d()
    search = o3d.geometry.KDTreeSearchParamHybrid
    down = _cloud(points).voxel_down_sample(options.voxel)
    down.estimate_normals(search(options.normal_voxels * options.voxel, options.normal_neighbours))
    features = o3d.pipelines.registration.compute_fpfh_feature(
        down, search(options.feature_voxels * options.voxel, options.feature_neighbours)
    )
    return down, features


def _register(
    moving: Points,
    target: Float[np.ndarray, "m 3"],
    prepared: tuple[Any, Any] | None,
    options: PamOptions,
) -> Matrix:
    """One round: RANSAC on features, then ICP from there."""
    reg = open3d().pipelines.registration
    step = np.eye(4)
    if prepared is not None:
        down, features = _prepare(moving, options)
        reach = options.ransac_voxels * options.voxel
        step = np.array(
            reg.registration_ransac_based_on_feature_matching(
                down,
                prepared[0],
                features,
                prepared[1],
                options.mutual,
                reach,
                reg.TransformationEstimationPointToPoint(False),
                3,
                [
                    reg.CorrespondenceCheckerBasedOnEdgeLength(options.edge_ratio),
                    reg.CorrespondenceCheckerBasedOnDistance(reach),
                ],
                reg.RANSACConvergenceCriteria(options.ransac_iterations, options.confidence),
            ).transformation
        )
    if options.icp:
        step = np.array(
            reg.registration_icp(
                _cloud(moving),
                _cloud(target),
                options.icp_voxels * options.voxel,
                step,
                reg.TransformationEstimationPointToPoint(),
                reg.ICPConvergenceCriteria(max_iteration=options.icp_iterations),
            ).transformation
        )
    return step


def _loss(
    moving: Points, target: Float[np.ndarray, "m 3"], options: PamOptions, rng: np.random.Generator
) -> float:
    pair = [moving, target]
    if options.loss_on_voxels:
        pair = [np.asarray(_cloud(c).voxel_down_sample(options.voxel).points) for c in pair]
    if options.loss_points:
        pair = [c[np.sort(rng.permutation(len(c))[: options.loss_points])] for c in pair]
    forth = cKDTree(pair[1]).query(pair[0], workers=-1)[0]
    if options.loss == "directed":
        return DIRECTED_FACTOR * float(forth.mean())
    back = cKDTree(pair[0]).query(pair[1], workers=-1)[0]
    return float((forth**2).mean() + (back**2).mean())


def template_cloud(template: Template, count: int) -> Float[np.ndarray, "m 3"]:
    """(m, 3) about `count` points of the template's surface."""
    diagonal_mm = diagonal(template.bounds_mm)
    spacing_mm = diagonal_mm / 40.0
    few = len(template.surface_points(spacing_mm)[0])
    return template.surface_points(spacing_mm * float(np.sqrt(few / count)))[0]


def align_paper(
    scan: Scan,
    template: Template,
    *,
    options: PamOptions = PUBLISHED_PAM,
    guess: Transform | None = None,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Registration:
    """`align` by the published method; `symmetric_alternatives` is empty: it does not look.

    Raises
    ------
    AlignmentError
        If PAM does not converge, or converges on a pose that leaves most points unexplained.
    """
    source_mm = (scan if guess is None else scan.moved(guess)).points_mm
    found = pam(
        source_mm,
        template_cloud(template, options.target_points),
        options=options,
        rng=rng,
        source=scan.source,
        progress=progress,
    )
    matrix = found.matrix if guess is None else found.matrix @ guess.matrix
    placed = moved(scan.points_mm, matrix)
    residual_mm, gradient = template.distance_and_gradient(placed)
    # The method cannot place a scan better than its own last search radius.
    reach = options.icp_voxels if options.icp else options.ransac_voxels
    limit_mm = max(options.inlier_mm, reach * options.voxel * found.radius_mm)
    inlier = np.abs(residual_mm) <= limit_mm
    ratio = float(inlier.mean())
    if ratio < options.least_explained:
        raise AlignmentError(
            f"the scan {scan.source} does not fit its template: PAM converged at a loss of "
            f"{found.loss:.4g} (limit {found.threshold:.4g}), but only {ratio:.0%} of the points "
            f"lie within {limit_mm:.2g} mm (at least {options.least_explained:.0%} are needed); "
            "use the method robust"
        )
    arm = placed - placed.mean(axis=0)
    jacobian = np.concatenate([np.cross(arm, gradient), gradient], axis=1)[inlier]
    rmse_mm = float(np.sqrt(np.mean(residual_mm[inlier] ** 2)))
    return Registration(
        template_from_scan=Transform("template", scan.frame, matrix),
        rmse_mm=rmse_mm,
        inlier_ratio=ratio,
        information=jacobian.T @ jacobian / max(scan.sigma_mm, rmse_mm, 1e-3) ** 2,
        symmetric_alternatives=(),
        method="paper",
        iterations=found.iterations,
    )
