"""A bent part is two rigid pieces: which of them stayed where it was.

An alignment lays the piece that was seen most on the template. What is left may be the same
surface turned by some degrees: then the scan is two bodies, and the one that makes up more of the
*template* is taken to be in place. It judges poses; it makes no scores.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from amrepair.align.refine import refine
from amrepair.align.thinning import thin_out
from amrepair.template.port import Template

LEAST_SHARE = 0.1  # of the points: a smaller piece never outweighs the other
LEAST_EXPLAINED = 0.6  # of that piece, by its own pose; the bent zone fits neither
MOST_WRONG = 0.2  # of either piece, on the wrong side of the plane between them
POINTS = 3_000
CLEAR_SIGMAS, CLEAR_RATIO = 4.0, 0.002  # a point is off the surface; the ratio is of the diagonal
FIRST_RATIO = 0.04  # scale of the second alignment's loss, of the diagonal
SURFACE_RATIO = 1.0 / 60.0  # spacing of the template's points, of the diagonal


def standing_pose(
    points_mm: Float[np.ndarray, "n 3"],
    template: Template,
    matrix: Float[np.ndarray, "4 4"],
    sigma_mm: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "4 4"]:
    """The pose of the larger piece, where the scan shows a part bent in two; else the one given.

    Parameters
    ----------
    points_mm
        (n, 3) in the scan's frame.
    matrix
        (4, 4) template from scan, as aligned.
    sigma_mm
        Noise of the points.
    """
    diagonal_mm = float(np.linalg.norm(np.ptp(template.bounds_mm, axis=0)))
    limit_mm = max(CLEAR_SIGMAS * sigma_mm, CLEAR_RATIO * diagonal_mm)
    cloud = thin_out(points_mm, 2 * POINTS, rng)
    off = _distance(cloud, template, matrix) > limit_mm
    if off.mean() < LEAST_SHARE:
        return matrix
    rest = cloud[off]
    moved = refine(
        thin_out(rest, POINTS, rng),
        template,
        matrix,
        start_scale_mm=FIRST_RATIO * diagonal_mm,
        end_scale_mm=limit_mm,
        sigma_mm=max(sigma_mm, 1e-3),
        max_iterations=40,
    ).matrix
    if (_distance(rest, template, moved) <= limit_mm).mean() < LEAST_EXPLAINED:
        return matrix
    on_other = off & (_distance(cloud, template, moved) <= limit_mm)
    return moved if _share(cloud, off, on_other, template, (matrix, moved)) > 0.5 else matrix


def _distance(
    points: Float[np.ndarray, "n 3"], template: Template, matrix: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, " n"]:
    return np.abs(template.distance(points @ matrix[:3, :3].T + matrix[:3, 3]))


def _share(
    cloud: Float[np.ndarray, "n 3"],
    off: Bool[np.ndarray, " n"],
    on_other: Bool[np.ndarray, " n"],
    template: Template,
    poses: tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]],
) -> float:
    """Share of the template's surface on the second piece's side of the plane between the two.

    A plane (Fisher's discriminant), not the nearest points: a view shows little of what it was not
    made for. 0 where no plane parts them.
    """
    first, second = (
        cloud[which] @ matrix[:3, :3].T + matrix[:3, 3]
        for which, matrix in zip((~off, on_other), poses, strict=True)
    )
    within = np.cov(first.T) + np.cov(second.T)
    within += 1e-6 * np.trace(within) * np.eye(3)
    across = np.linalg.solve(within, second.mean(axis=0) - first.mean(axis=0))
    low, high = first @ across, second @ across
    limits = np.quantile(np.concatenate([low, high]), np.linspace(0.02, 0.98, 97))
    wrong = [0.5 * float((low > at).mean() + (high <= at).mean()) for at in limits]
    best = int(np.argmin(wrong))
    if wrong[best] > MOST_WRONG:
        return 0.0
    diagonal_mm = float(np.linalg.norm(np.ptp(template.bounds_mm, axis=0)))
    surface = template.surface_points(SURFACE_RATIO * diagonal_mm)[0]
    return float((surface @ across > limits[best]).mean())
