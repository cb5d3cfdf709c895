"""Labels: which cells of a field belong to a region, grown from where the test is significant."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from amrepair.field import scales_kernels
from amrepair.field.scales import Scale
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
    for as long as they are beyond the noise and deeper than the tolerance or half the region,
    whichever is less: what is allowed beside a defect is none of it, and a shallow one has a rim.
    """
    scale = levels[0].scale
    value_mm = scale.value_mm[scale.of_base]
    # what is normal where a place was seen as densely: a defect's own slopes are no noise
    noise_mm = options.grow_sigmas * usual_error_mm(levels[0], options)[scale.of_base]
    labels = np.zeros(tolerance_mm.shape, bool)
    log_p = np.zeros(tolerance_mm.shape)
    tests = np.log(2 * len(levels))
    for side, deep_mm in enumerate((-value_mm, value_mm)):
        strips = np.zeros(len(value_mm), bool)
        if side == 1:
            strips[: len(strands)] = strands
        seeds = np.zeros(len(value_mm), bool)
        for level in levels:
            if level.rejected[side].any():
                surest = scales_kernels.surest(
                    level.scale.table, level.scale.count, level.rejected[side], level.log_p[side]
                )[level.scale.of_base]
                seeds |= surest < 0
                log_p[side] = np.minimum(log_p[side], surest + tests)
        through = (deep_mm > options.grow_share * tolerance_mm[side] + noise_mm) | strips
        region = _reached(scale, (seeds | strips) & through, through)
        if not (region >= 0).any():
            continue
        depth_mm = np.zeros(int(region.max()) + 1)
        within = (region >= 0) & seeds
        np.maximum.at(depth_mm, region[within], deep_mm[within])
        # a strip alone has no depth to go by; number −1 looks up the last, and is no region anyhow
        low_mm = np.minimum(0.5 * depth_mm[region], tolerance_mm[side])
        through &= (region >= 0) & ((deep_mm > low_mm + noise_mm) | (depth_mm[region] == 0))
        labels[side] = _reached(scale, (seeds | strips) & through, through) >= 0
    labels[1] &= ~labels[0]
    return labels, np.minimum(log_p, 0.0)


def _reached(
    scale: Scale, seeds: Bool[np.ndarray, " b"], through: Bool[np.ndarray, " b"]
) -> Int[np.ndarray, " b"]:
    """(b,) number of the connected group of cells in `through` that holds a seed, else −1."""
    open_cells, start_cells = np.zeros((2, len(scale)), bool)
    open_cells[scale.of_base[through]] = True
    start_cells[scale.of_base[seeds]] = True
    group, groups = scales_kernels.components(scale.table, scale.count, open_cells)
    kept = np.zeros(groups + 1, bool)
    kept[group[start_cells]] = True
    kept[-1] = False  # what −1 looks up
    return np.where(through & kept[group][scale.of_base], group[scale.of_base], -1)
