"""The bed as a witness: what a scan sees of it fixes height and tilt before the part is looked at.

A layer that is too low all over looks like a part that stands too low; only the bed tells.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from amrepair.align.refine import Prior
from amrepair.frames import moved, rotation_from_vector
from amrepair.template.port import Template

MOST_BED_POINTS, MOST_FITTED = 80_000, 10_000  # points: the bed is a plane
BED_BAND_MM = 1.0  # how far off the guess may have the bed
SKIRT_MM = 2.0  # bed points this near to the part may be its skirt or its foot
LEAST_BED_POINTS = 300
LEAST_SPREAD_MM = 3.0  # root mean square, across the bed that is seen
# What the bed leaves open: a few micrometres of height, and tilt over a part's length.
HEIGHT_SIGMA_MM = 0.01
TILT_SIGMA_RAD = 2e-4


def level_on_bed(
    points_mm: Float[np.ndarray, "n 3"], template: Template, matrix: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "4 4"], bool]:
    """Correct a guess so that the bed that the scan shows lies at the template's lowest height.

    Parameters
    ----------
    points_mm
        (n, 3) in the scan's frame.
    matrix
        (4, 4) guess, template from scan; the template's Z is the bed's normal.

    Returns
    -------
    The corrected guess, and whether enough bed was seen to correct it.
    """
    low = template.bounds_mm[0]
    placed = moved(points_mm[:: max(1, len(points_mm) // MOST_BED_POINTS)], matrix)
    near = np.flatnonzero(np.abs(placed[:, 2] - low[2]) < BED_BAND_MM)
    if len(near) < LEAST_BED_POINTS:
        return matrix, False
    near = near[:: -(-len(near) // MOST_FITTED)]
    apart = template.distance(placed[near])
    bed = placed[near[apart > SKIRT_MM]]
    if len(bed) < LEAST_BED_POINTS:
        return matrix, False
    centre = bed.mean(axis=0)
    local = bed - centre
    spread_mm2 = np.linalg.eigvalsh(local[:, :2].T @ local[:, :2] / len(local))
    if spread_mm2[0] < LEAST_SPREAD_MM**2:  # a strip of bed does not tell its tilt
        return matrix, False
    design = np.column_stack([local[:, :2], np.ones(len(local))])
    target = bed[:, 2] - low[2]
    fit, scale = np.zeros(3), BED_BAND_MM
    for _ in range(12):
        residual = target - design @ fit
        weight = (scale**2 / (residual**2 + scale**2)) ** 2
        weighted = design.T * weight**2
        fit = np.linalg.solve(weighted @ design, weighted @ target)
        scale = max(0.1, scale * 0.6)
    normal = np.array([-fit[0], -fit[1], 1.0])
    normal /= np.linalg.norm(normal)
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    turn = rotation_from_vector(axis * (np.arcsin(min(1.0, float(np.linalg.norm(axis))))
                                        / max(float(np.linalg.norm(axis)), 1e-12)))  # fmt: skip
    pivot = centre + np.array([0.0, 0.0, fit[2] - target.mean() + 0.0])
    pivot[2] = low[2] + fit[2]
    level = np.eye(4)
    level[:3, :3] = turn
    level[:3, 3] = pivot - turn @ pivot - np.array([0.0, 0.0, fit[2]])
    return level @ matrix, True


def bed_prior(rotation_sigma_rad: float, translation_sigma_mm: float) -> Prior:
    """The guess's own spread, but for height and tilt, which the bed has fixed."""
    return Prior(
        np.array([TILT_SIGMA_RAD, TILT_SIGMA_RAD, rotation_sigma_rad]),
        np.array([translation_sigma_mm, translation_sigma_mm, HEIGHT_SIGMA_MM]),
    )
