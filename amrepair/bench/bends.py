"""Where a part is bent a little: the cut beyond which another rigid motion explains more.

To first order a rigid motion of a piece changes the deviation at x by n·(t + ω × x), n the field's
gradient. So what the best motion of either side of a cut explains are sums over points, and all
cuts across an axis are judged in one pass. It finds where to look; `bodies` moves the pieces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.frames import unit_vectors
from amrepair.template.port import Template

CUT_SHARES = np.arange(0.2, 0.81, 0.05)  # shares of the points on one side of a cut
MOTION_RIDGE = 1e-6  # of a motion that the points of a side do not show


@dataclass(frozen=True, slots=True)
class Cut:
    """A plane across one of the part's main axes.

    Attributes
    ----------
    gain
        By how much the motions of both sides lessen the sum of squares of the noise's standard
        deviations, beyond what one motion of all does: χ² of six degrees of freedom if nothing is
        bent.
    normal, height_mm
        Places p of the surface with p · normal < height lie on the first side.
    """

    gain: float
    normal: Float[np.ndarray, " 3"]
    height_mm: float


def best_cuts(
    points_mm: Float[np.ndarray, "n 3"],
    template: Template,
    surface_mm: Float[np.ndarray, "m 3"],
    *,
    scale_mm: float,
    sigma_mm: float,
) -> list[Cut]:
    """The best cut across each main axis of the template's surface, the best first.

    Parameters
    ----------
    points_mm
        (n, 3) placed.
    surface_mm
        (m, 3) points of the template's surface.
    scale_mm
        Of the loss of Geman and McClure: what lies much farther off tells nothing.
    """
    f_mm, gradient = template.distance_and_gradient(points_mm)
    normals = unit_vectors(gradient)
    # by where a point is due: noise must not choose on which side of a face's own plane it is
    feet_mm = points_mm - f_mm[:, None] * normals
    local = points_mm - points_mm.mean(axis=0)
    reach_mm = float(np.linalg.norm(local, axis=1).max())
    motion = np.concatenate([np.cross(local, normals) / reach_mm, normals], axis=1)
    weight = (scale_mm**2 / (f_mm**2 + scale_mm**2)) ** 2
    products = np.concatenate(
        [
            (motion[:, :, None] * motion[:, None, :]).reshape(-1, 36) * weight[:, None],
            motion * (weight * f_mm)[:, None],
        ],
        axis=1,
    )
    whole = _explained(products.sum(axis=0))
    middle = surface_mm - surface_mm.mean(axis=0)
    found = []
    for axis in np.linalg.eigh(middle.T @ middle)[1].T:
        height = feet_mm @ axis
        order = np.argsort(height)
        below = np.cumsum(products[order], axis=0)
        cuts = [
            Cut(
                float(_explained(below[i - 1]) + _explained(below[-1] - below[i - 1]) - whole)
                / sigma_mm**2,
                axis,
                float(height[order[i]]),
            )
            for i in (CUT_SHARES * len(height)).astype(int)
        ]
        found.append(max(cuts, key=lambda cut: cut.gain))
    return sorted(found, key=lambda cut: -cut.gain)


def _explained(sums: Float[np.ndarray, " 42"]) -> float:
    """What the best motion takes from the sum of squares, from the sums of a side."""
    matrix, right = sums[:36].reshape(6, 6), sums[36:]
    matrix = matrix + MOTION_RIDGE * max(float(np.trace(matrix)), 1e-12) * np.eye(6)
    return float(right @ np.linalg.solve(matrix, right))
