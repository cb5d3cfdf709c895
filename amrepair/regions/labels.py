"""Labels: which places belong to a region, grown from those where the test is significant."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from amrepair.arrays import Mask
from amrepair.field.groups import CELLS_APART, connected
from amrepair.field.near import has_near
from amrepair.field.scales import Scale
from amrepair.regions.options import RegionOptions
from amrepair.regions.significance import LEAST_SIGMA_MM, Level, by_class


def grown(
    levels: tuple[Level, ...],
    tolerance_mm: Float[np.ndarray, "2 b"],
    options: RegionOptions,
    *,
    anywhere_mm: float,
    strands: Mask,
) -> tuple[Bool[np.ndarray, "2 b"], Float[np.ndarray, "2 b"]]:
    """Grow regions from significant windows, for missing and for excess.

    A region grows through touching cells for as long as a cell lies beyond the noise and a share
    of the tolerance, and so does the median of a window beside it. Where the tolerance is larger
    than usual, by the job or by how sound parts differ, all of it has to be exceeded.

    Parameters
    ----------
    tolerance_mm
        The tolerance of each place.
    anywhere_mm
        The usual tolerance, of places where nothing more is allowed.
    strands
        Cells that stand out as narrow strips: regions of excess begin there, too.

    Returns
    -------
    (2, b) whether each place belongs to a region of missing and of excess; and (2, b) the logarithm
    of the expected number of false regions at least as significant, over all tests.
    """
    first, scale = levels[0], levels[0].scale
    value_mm = scale.value_mm[scale.of_base]
    # what is normal where a place was seen as well: a defect's own slopes are no noise
    group = first.errors.group
    usual_mm = by_class(group, first.error_mm, options)[group]
    noise_mm = options.grow_sigmas * usual_mm[scale.of_base]
    more = tolerance_mm > anywhere_mm + LEAST_SIGMA_MM
    low_mm = np.where(more, tolerance_mm, options.grow_share * tolerance_mm) + noise_mm
    labels = np.zeros(tolerance_mm.shape, bool)
    log_p = np.zeros(tolerance_mm.shape)
    tests = np.log(2 * len(levels))
    for side, sign in enumerate((-1.0, 1.0)):
        deep_mm = sign * value_mm
        seeds, small = np.zeros((2, len(value_mm)), bool)
        for level in levels:
            if level.rejected[side].any():
                window, cell = level.scale.cells_of(level.rejected[side])
                surest = np.zeros(len(level.scale))  # of the windows that each cell lies in
                np.minimum.at(surest, cell, level.log_p[side][window])
                surest = surest[level.scale.of_base]
                seeds |= surest < 0
                if level.scale is scale:
                    small |= surest < 0
                log_p[side] = np.minimum(log_p[side], surest + tests)
        deep = deep_mm > low_mm[side]
        # beside a window whose median is beyond, too: a cell here and there leads nowhere
        around_mm = sign * scale.median_mm[scale.of_base]
        through = deep & _beside(scale, deep & (small | (around_mm > low_mm[side])))
        if side == 1:
            seeds[: len(strands)] |= strands
            through[: len(strands)] |= strands
        labels[side] = _reached(scale, seeds & through, through)
    labels[1] &= ~labels[0]
    return labels, np.minimum(log_p, 0.0)


def _beside(scale: Scale, chosen: Mask) -> Mask:
    """(b,) whether a cell, or one that touches it, is chosen."""
    if not chosen.any():
        return chosen
    cells_mm = scale.place_mm[np.unique(scale.of_base[chosen])]
    return has_near(scale.place_mm, cells_mm, CELLS_APART * scale.cell_mm)[scale.of_base]


def _reached(scale: Scale, seeds: Mask, through: Mask) -> Mask:
    """(b,) cells of `through` that are connected to a seed, whichever way they face."""
    reached = np.zeros(len(through), bool)
    if not seeds.any():
        return reached
    cells = np.unique(scale.of_base[through])
    tree = cKDTree(scale.place_mm[cells])
    first, second = tree.query_pairs(CELLS_APART * scale.cell_mm, output_type="ndarray").T
    of_base = connected(first, second, len(cells))[np.searchsorted(cells, scale.of_base[through])]
    reached[through] = np.isin(of_base, of_base[seeds[through]])
    return reached
