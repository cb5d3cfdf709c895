"""Labels: which cells of a field belong to a region, grown from where the test is significant."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from amrepair.field import scales_kernels
from amrepair.regions.options import RegionOptions
from amrepair.regions.significance import Level, usual_error_mm


def grown(
    levels: tuple[Level, ...],
    tolerance_mm: Float[np.ndarray, "2 b"],
    options: RegionOptions,
    *,
    strands: Bool[np.ndarray, " s"],
) -> tuple[Bool[np.ndarray, "2 b"], Float[np.ndarray, "2 b"]]:
    """(2, b) cells of missing and of excess regions, and how sure the windows over each are.

    `strands` are cells that stand out as strips. The second is the logarithm of the expected
    number of false regions, over all that is tested.

    From every window that is significant a region grows through neighbouring cells of the field
    for as long as their deviation is beyond a share of the tolerance and beyond the noise.
    """
    finest = levels[0]
    scale = finest.scale
    value_mm = scale.value_mm[scale.of_base]
    # what is normal where a place was seen as densely: a defect's own slopes are no noise
    error_mm = usual_error_mm(finest, options)[scale.of_base]
    low_mm = options.grow_share * tolerance_mm + options.grow_sigmas * error_mm
    through = np.stack([-value_mm, value_mm]) > low_mm
    through[1, : len(strands)] |= strands
    labels = np.zeros_like(through)
    log_p = np.zeros(through.shape)
    tests = np.log(2 * len(levels))
    for side in range(2):
        seeds = np.zeros(len(value_mm), bool)
        if side == 1:
            seeds[: len(strands)] = strands
        for level in levels:
            if level.rejected[side].any():
                surest = scales_kernels.surest(
                    level.scale.table, level.scale.count, level.rejected[side], level.log_p[side]
                )[level.scale.of_base]
                seeds |= surest < 0
                log_p[side] = np.minimum(log_p[side], surest + tests)
        seeds &= through[side]
        if not seeds.any():
            continue
        open_cells, start_cells = np.zeros((2, len(scale)), bool)
        open_cells[scale.of_base[through[side]]] = True
        start_cells[scale.of_base[seeds]] = True
        group, groups = scales_kernels.components(scale.table, scale.count, open_cells)
        kept = np.zeros(groups + 1, bool)
        kept[group[start_cells]] = True
        kept[-1] = False  # what −1 looks up
        labels[side] = kept[group][scale.of_base] & through[side]
    labels[1] &= ~labels[0]
    return labels, np.minimum(log_p, 0.0)
