"""The bed as a witness: what a scan sees of it fixes height and tilt before the part is looked at.

A layer that is too low all over looks like a part that stands too low; only the bed tells.
"""

from __future__ import annotations

import numpy as np

from amrepair.align.options import DEFAULT_ALIGN, BedOptions
from amrepair.align.refine import Prior
from amrepair.arrays import Matrix, Points
from amrepair.frames import moved, rigid, rotation_from_vector, turn_between
from amrepair.template.port import Template


def level_on_bed(
    points_mm: Points, template: Template, matrix: Matrix, options: BedOptions = DEFAULT_ALIGN.bed
) -> tuple[Matrix, bool]:
    """Correct a guess so that the bed that the scan shows lies where the template's foot stands.

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
    bed_z_mm = float(template.bounds_mm[0, 2]) - options.under_foot_mm
    placed = moved(points_mm[:: max(1, len(points_mm) // options.most_points)], matrix)
    near = np.flatnonzero(np.abs(placed[:, 2] - bed_z_mm) < options.band_mm)
    if len(near) < options.least_points:
        return matrix, False
    near = near[:: -(-len(near) // options.most_fitted)]
    apart = template.distance(placed[near])
    bed = placed[near[apart > options.skirt_mm]]
    if len(bed) < options.least_points:
        return matrix, False
    centre = bed.mean(axis=0)
    local = bed - centre
    spread_mm2 = np.linalg.eigvalsh(local[:, :2].T @ local[:, :2] / len(local))
    if spread_mm2[0] < options.least_spread_mm**2:  # a strip of bed does not tell its tilt
        return matrix, False
    design = np.column_stack([local[:, :2], np.ones(len(local))])
    target = bed[:, 2] - bed_z_mm
    fit, scale = np.zeros(3), options.band_mm
    for _ in range(options.rounds):
        residual = target - design @ fit
        weight = (scale**2 / (residual**2 + scale**2)) ** 2
        weighted = design.T * weight**2
        fit = np.linalg.solve(weighted @ design, weighted @ target)
        scale = max(options.last_scale_mm, scale * options.shrink)
    normal = np.array([-fit[0], -fit[1], 1.0])
    normal /= np.linalg.norm(normal)
    turn = rotation_from_vector(turn_between(normal, np.array([0.0, 0.0, 1.0])))
    pivot = np.array([*centre[:2], bed_z_mm + fit[2]])
    level = rigid(turn, pivot - turn @ pivot - np.array([0.0, 0.0, fit[2]]))
    return level @ matrix, True


def bed_prior(
    rotation_sigma_rad: float,
    translation_sigma_mm: float,
    options: BedOptions = DEFAULT_ALIGN.bed,
) -> Prior:
    """The guess's own spread, but for height and tilt, which the bed has fixed."""
    return Prior(
        np.array([options.tilt_sigma_rad, options.tilt_sigma_rad, rotation_sigma_rad]),
        np.array([translation_sigma_mm, translation_sigma_mm, options.height_sigma_mm]),
    )
