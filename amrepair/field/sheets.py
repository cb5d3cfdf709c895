"""Sheets: broken faces so near to template surface that was seen that one side says the other.

What is left of a cut may be thinner than what planes tell apart, or the winding number. Of the
two sides of such a sheet one is the template's own surface; the other faces away from it, since
between two surfaces that were seen nothing is but what stands there.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

# Thicker ones have sides that are told by themselves (in spacings of the scan).
THICK_SPACINGS = 2.5
# The two sides are askew to each other by less than 26°.
ALONG_COSINE = 0.9
# The template's surface was seen there if a point lies on it within this (in spacings), and not
# all of those around on one side.
SEEN_SPACINGS, AROUND, LOPSIDED = 1.6, 8, 0.6


def other_sides(
    place_mm: Float[np.ndarray, "n 3"],
    plane: Float[np.ndarray, "n 3"],
    deviation_mm: Float[np.ndarray, " n"],
    gradient: Float[np.ndarray, "n 3"],
    broken: Bool[np.ndarray, " n"],
    *,
    spacing_mm: float,
) -> Bool[np.ndarray, " n"]:
    """(n,) broken places that are the inner side of a sheet, whose outer side is the template's.

    Parameters
    ----------
    place_mm, plane
        Places of the scan on the planes through their neighbours, and those planes' normals.
    deviation_mm, gradient
        The template's distance there, and its unit gradient.
    spacing_mm
        Of the scan.
    """
    sheet = np.zeros(len(place_mm), dtype=bool)
    thin = broken & (deviation_mm < 0) & (deviation_mm > -THICK_SPACINGS * spacing_mm)
    which = np.flatnonzero(thin & (np.abs((gradient * plane).sum(axis=1)) > ALONG_COSINE))
    on_mm = place_mm[~broken]
    if len(which) == 0 or len(on_mm) < AROUND:
        return sheet
    foot = place_mm[which] - deviation_mm[which, None] * gradient[which]
    distance, index = cKDTree(on_mm).query(foot, k=AROUND, workers=2)
    offset = on_mm[index] - foot[:, None, :]
    sideways = np.linalg.norm(offset, axis=2).mean(axis=1)
    lopsided = np.linalg.norm(offset.mean(axis=1), axis=1) / np.maximum(sideways, 1e-9)
    sheet[which] = (distance[:, 0] < SEEN_SPACINGS * spacing_mm) & (lopsided < LOPSIDED)
    return sheet


def with_own_area(
    area_mm2: Float[np.ndarray, " n"],
    neighbours: Int[np.ndarray, "n k"],
    sheet: Bool[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Areas of points, those of a sheet by their neighbours on the same side alone."""
    alike = (sheet[neighbours] == sheet[:, None]).sum(axis=1)
    beside = sheet | sheet[neighbours].any(axis=1)
    ratio = neighbours.shape[1] / np.maximum(alike, 1)
    return np.asarray(np.where(beside, ratio * area_mm2, area_mm2))
