"""Refinement on the field: robust Gauss–Newton on the template's own distance (idea 3).

No correspondences: a point's residual is f(x), its direction the field's gradient. The loss is
Geman–McClure with a scale that shrinks from the error of the guess to the noise; a prior keeps
what the scan does not determine where the guess had it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.align.refine_kernels import normal_equations
from amrepair.frames import rotation_from_vector
from amrepair.template.port import Template

SHRINK = 0.6  # of the loss's scale, from one iteration to the next
STEP_MM = 2e-4  # of the scan's far points: below this nothing moves any more
STEP_SIGMAS = 0.02  # nor where it moves by less than this share of the noise
MAX_ITERATIONS = 60
HASTE = 15  # iterations with whole steps
SLOWEST = 1.0 / 32  # of a step
FREE_RATIO = 0.1  # of the limit: distances that change by less do not hinder the motion
INLIER_SIGMAS = 4.0


@dataclass(frozen=True, slots=True)
class Prior:
    """How well the guess is known: standard deviations about the guess, scan's centroid.

    Attributes
    ----------
    rotation_rad, translation_mm
        (3,) each, about and along the template's axes.
    """

    rotation_rad: Float[np.ndarray, " 3"]
    translation_mm: Float[np.ndarray, " 3"]

    @property
    def information(self) -> Float[np.ndarray, " 6"]:
        """(6,) inverse variances, rotation first."""
        return 1.0 / np.concatenate([self.rotation_rad, self.translation_mm]) ** 2


@dataclass(frozen=True, slots=True)
class Refined:
    """A pose at a minimum, or where the iterations ended.

    Attributes
    ----------
    matrix
        (4, 4) template from scan.
    information
        (6, 6) JᵀWJ / σ², rotation about the centroid first; the prior is not in it.
    residual_mm
        (n,) f at the points.
    """

    matrix: Float[np.ndarray, "4 4"]
    information: Float[np.ndarray, "6 6"]
    residual_mm: Float[np.ndarray, " n"]
    converged: bool
    iterations: int

    def inliers(self, limit_mm: float) -> Float[np.ndarray, " n"]:
        """(n,) 1 where |f| is within the limit."""
        return (np.abs(self.residual_mm) <= limit_mm).astype(np.float64)


def refine(
    points_mm: Float[np.ndarray, "n 3"],
    template: Template,
    matrix: Float[np.ndarray, "4 4"],
    *,
    start_scale_mm: float,
    end_scale_mm: float,
    sigma_mm: float,
    prior: Prior | None = None,
    max_iterations: int = MAX_ITERATIONS,
    enough_mm: float = 0.0,
) -> Refined:
    """Move a pose to the nearest minimum of Σ ρ(f(T x)).

    Parameters
    ----------
    points_mm
        (n, 3) in the scan's frame.
    matrix
        (4, 4) first guess, template from scan.
    start_scale_mm, end_scale_mm
        Scale of the Geman–McClure loss ρ(r) = r²/(r² + s²), first and last.
    sigma_mm
        Noise of a point, for the information.
    enough_mm
        Stop where the next step would be smaller, converged or not.
    """
    centre = points_mm.mean(axis=0)
    reach_mm = float(np.linalg.norm(points_mm - centre, axis=1).max())
    rotation, place = matrix[:3, :3].copy(), matrix[:3, :3] @ centre + matrix[:3, 3]
    first_rotation, first_place = rotation.copy(), place.copy()
    local = points_mm - centre
    scale, converged, hessian = start_scale_mm, False, np.zeros((6, 6))
    f = np.zeros(len(points_mm))
    iterations, last, pace = 0, np.zeros(6), 1.0
    while iterations < max_iterations:
        iterations += 1
        turned = local @ rotation.T
        f, gradient = template.distance_and_gradient(turned + place)
        hessian, slope = normal_equations(turned, f, gradient, scale)
        hessian, slope = hessian / sigma_mm**2, slope / sigma_mm**2
        # neighbouring points err alike (process, calibration): against a prior all of them
        # together count as one
        matrix6 = (hessian + 1e-9 * np.trace(hessian) / 6 * np.eye(6)) / len(points_mm)
        slope = slope / len(points_mm)
        if prior is not None:
            offset = np.concatenate([_vector(rotation @ first_rotation.T), place - first_place])
            matrix6 = matrix6 + np.diag(prior.information)
            slope = slope + prior.information * offset
        step = -np.linalg.solve(matrix6, slope)
        turn = float(np.linalg.norm(step[:3]))
        if turn > 0.2:  # a step this wide has left the linear range
            step *= 0.2 / turn
        if iterations > HASTE:
            # to and fro across an edge of the field, where its gradient turns at once
            pace = max(SLOWEST, 0.5 * pace) if float(step @ last) < 0.0 else min(1.0, 2.0 * pace)
        last = step
        step = pace * step
        rotation = rotation_from_vector(step[:3]) @ rotation
        place = place + step[3:]
        moved_mm = float(np.linalg.norm(step[3:])) + reach_mm * float(np.linalg.norm(step[:3]))
        limit_mm = max(STEP_MM, STEP_SIGMAS * sigma_mm)
        still = moved_mm < limit_mm
        if iterations > HASTE:  # a rod turns on for ever: what counts is what its points would see
            changed_mm = sigma_mm * float(np.sqrt(step @ hessian @ step / len(points_mm)))
            still |= changed_mm < FREE_RATIO * limit_mm
        if scale <= end_scale_mm * (1 + 1e-9) and (still or moved_mm < enough_mm):
            converged = bool(still)
            break
        if moved_mm < 0.25 * scale:
            scale = max(end_scale_mm, scale * SHRINK)
    u, _, vt = np.linalg.svd(rotation)
    rotation = u @ vt
    found = np.eye(4)
    found[:3, :3] = rotation
    found[:3, 3] = place - rotation @ centre
    residual = template.distance(local @ rotation.T + place)
    return Refined(found, hessian, residual, converged, iterations)


def _vector(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
    """Axis-angle vector of a small rotation."""
    skew = 0.5 * (rotation - rotation.T)
    return np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
