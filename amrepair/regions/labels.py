"""Labels: which cells of a field belong to a region, grown from where the test is significant."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from amrepair.field import scales_kernels
from amrepair.regions.options import RegionOptions
from amrepair.regions.significance import Level, class_medians


def grown(
    levels: tuple[Level, ...],
    tolerance_mm: Float[np.ndarray, "2 b"],
    options: RegionOptions,
) -> Bool[np.ndarray, "2 b"]:
    """(2, b) cells of missing and of excess regions.

    From every window that is significant a region grows through neighbouring cells of the field
    for as long as their deviation is beyond a share of the tolerance and beyond the noise.
    """
    finest = levels[0]
    scale = finest.scale
    value_mm = scale.value_mm[scale.of_base]
    # what is normal where a place was seen as densely: a defect's own slopes are no noise
    error_mm = class_medians(scale, finest.error_mm, options)[scale.of_base]
    low_mm = options.grow_share * tolerance_mm + options.grow_sigmas * error_mm
    through = np.stack([-value_mm, value_mm]) > low_mm
    labels = np.zeros_like(through)
    for side in range(2):
        seeds = np.zeros(len(value_mm), bool)
        for level in levels:
            here = level.rejected[side]
            if here.any():
                window = scales_kernels.spread(level.scale.table, level.scale.count, here)
                seeds |= window[level.scale.of_base]
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
    return labels
