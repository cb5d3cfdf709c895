"""Refinement on the field: robust Gauss–Newton on the template's own distance.

No point is matched with another: a point's residual is f(x), its direction the field's gradient.
The loss is Geman–McClure with a scale that shrinks from the error of the guess to the noise; a
prior keeps what the scan does not determine where the guess had it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from amrepair.align import refine_kernels as kernels
from amrepair.arrays import Mask, Matrix, Points, Values, Vector
from amrepair.frames import nearest_rotation, rigid
from amrepair.template.port import Distances, OnGrid

MAX_ITERATIONS = 60


@dataclass(frozen=True, slots=True)
class Prior:
    """How well the guess is known: standard deviations about the guess, scan's centroid.

    Attributes
    ----------
    rotation_rad, translation_mm
        (3,) each, about and along the template's axes.
    """

    rotation_rad: Vector
    translation_mm: Vector

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

    matrix: Matrix
    information: Float[np.ndarray, "6 6"]
    residual_mm: Values
    converged: bool
    iterations: int

    def loss(self, scale_mm: float, which: Mask | slice = slice(None)) -> float:
        """Mean Geman–McClure loss of the points, or of some, at a scale, from 0 to 1."""
        square = np.square(self.residual_mm[which])
        return float((square / (square + scale_mm**2)).mean())


def refine(
    points_mm: Points,
    template: Distances,
    matrix: Matrix,
    *,
    start_scale_mm: float,
    end_scale_mm: float,
    sigma_mm: float,
    prior: Prior | None = None,
    max_iterations: int = MAX_ITERATIONS,
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
    """
    return refine_all(
        points_mm,
        template,
        [matrix],
        start_scale_mm=start_scale_mm,
        end_scale_mm=end_scale_mm,
        sigma_mm=sigma_mm,
        prior=prior,
        max_iterations=max_iterations,
    )[0]


def refine_all(
    points_mm: Points,
    template: Distances,
    matrices: Sequence[Matrix],
    *,
    start_scale_mm: float,
    end_scale_mm: float,
    sigma_mm: float,
    prior: Prior | None = None,
    max_iterations: int = MAX_ITERATIONS,
    enough_mm: float = 0.0,
    outside_mm: float = 0.0,
) -> list[Refined]:
    """`refine` from several poses, in their order; all steps at once where the field is a grid.

    With `outside_mm` points inside may be far off and none outside: there the loss is Huber's, of
    this scale.
    """
    if not len(matrices):
        return []
    centre = points_mm.mean(axis=0)
    local = np.ascontiguousarray(points_mm - centre, dtype=np.float64)
    reach_mm = float(np.linalg.norm(local, axis=1).max())
    rotations = np.array([matrix[:3, :3] for matrix in matrices], dtype=np.float64)
    places = np.array([m[:3, :3] @ centre + m[:3, 3] for m in matrices], dtype=np.float64)
    known = np.zeros(6) if prior is None else prior.information
    # neighbouring points err alike (process, calibration): against a prior all of them together
    # count as one
    limits = (float(len(local)), reach_mm, sigma_mm, end_scale_mm, enough_mm)
    asked = (known, start_scale_mm, max_iterations, limits, outside_mm)
    if isinstance(template, OnGrid):
        hessians, residuals, ends = kernels.refine_all(
            local, rotations, places, *asked, template.grid_numbers
        )
    else:
        hessians, residuals, ends = _refine_by_asking(local, rotations, places, *asked, template)
    rotations = nearest_rotation(rotations)
    found = []
    for k, (rotation, place) in enumerate(zip(rotations, places, strict=True)):
        matrix = rigid(rotation, place - rotation @ centre)
        information = hessians[k] / sigma_mm**2
        iterations, converged = ends[k]
        found.append(Refined(matrix, information, residuals[k], bool(converged), int(iterations)))
    return found


def _refine_by_asking(
    local: Points,
    rotations: Float[np.ndarray, "k 3 3"],
    places: Float[np.ndarray, "k 3"],
    known: Float[np.ndarray, " 6"],
    start_scale_mm: float,
    max_iterations: int,
    limits: tuple[float, float, float, float, float],
    outside_mm: float,
    template: Distances,
) -> tuple[Float[np.ndarray, "k 6 6"], Float[np.ndarray, "k n"], Int[np.ndarray, "k 2"]]:
    """As `refine_kernels.refine_all`, of any template."""
    hessians = np.zeros((len(rotations), 6, 6))
    residuals = np.empty((len(rotations), len(local)))
    ends = np.empty((len(rotations), 2), dtype=np.int64)
    for k, (rotation, place) in enumerate(zip(rotations, places, strict=True)):
        first = np.column_stack([rotation, place])
        last, pace, scale, iterations, ended = np.zeros(6), 1.0, start_scale_mm, 0, kernels.GO_ON
        while iterations < max_iterations and ended == kernels.GO_ON:
            iterations += 1
            turned = local @ rotation.T
            f, gradient = template.distance_and_gradient(turned + place)
            hessians[k], slope = kernels.normal_equations(
                turned, f, np.ascontiguousarray(gradient), scale, outside_mm
            )
            ended, pace, scale = kernels.step(
                hessians[k], slope, known, first, rotation, place, last, pace, scale, iterations,
                limits,
            )  # fmt: skip
        residuals[k] = template.distance(local @ rotation.T + place)
        ends[k] = iterations, ended == kernels.CONVERGED
    return hessians, residuals, ends
