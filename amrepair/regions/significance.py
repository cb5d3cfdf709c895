"""The test: where robust local means lie beyond the tolerance by more than this scan's errors.

The null is a minimum-effect one, |mean deviation| ≤ δ (Murphy and Myors 1999): δ is what a sound
part may depart by, so that noise alone hardly matters. Means over several scales are tested; the
stated number of false regions is shared out over scales, signs and windows. The standard error of
a mean comes from the scan itself: what neighbouring cells differ by, and by how much windows that
were seen as densely depart as a whole, less what the process is known to leave. Where more places
exceed the tolerance than can be real, their peaks tell the tail of the null (Efron 2004, by peaks
over a threshold), with the highest of them left out as possibly real.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from scipy.special import comb
from scipy.stats import norm

from amrepair.field import scales_kernels
from amrepair.field.scales import FACING_COSINE, RANK, Scale
from amrepair.field.scales_kernels import NORMAL_MEDIAN
from amrepair.regions.options import RegionOptions

# Standard error of a median, of that of a mean, for normal noise: √(π/2).
MEDIAN_LOSS = float(np.sqrt(np.pi / 2))
# Coordinates in files are rounded to micrometres; no error is smaller.
LEAST_SIGMA_MM = 1e-3


@dataclass(frozen=True, slots=True)
class Tail:
    """How the standardised exceedances of sound places fall off.

    Attributes
    ----------
    start, scale
        Beyond `start` peaks are exponential with mean `scale`; 0: as normal noise.
    peaks
        How many there were to tell it from.
    """

    start: float
    scale: float
    peaks: int


NORMAL_TAIL = Tail(0.0, 0.0, 0)


@dataclass(frozen=True, slots=True)
class Level:
    """One statistic at one scale, and what is significant of it.

    Attributes
    ----------
    scale
        The scale.
    tolerance_mm, error_mm
        (2, s) δ for missing and excess, and (s,) the standard error of the statistic.
    z
        (2, s) standard errors beyond the tolerance: missing, excess.
    critical
        (2,) from which on they are significant.
    log_p
        (2, s) natural logarithm of the expected number of false regions as high or higher.
    """

    scale: Scale
    tolerance_mm: Float[np.ndarray, "2 s"]
    error_mm: Float[np.ndarray, " s"]
    z: Float[np.ndarray, "2 s"]
    critical: Float[np.ndarray, " 2"]
    log_p: Float[np.ndarray, "2 s"]
    tails: tuple[Tail, Tail]

    @property
    def rejected(self) -> Bool[np.ndarray, "2 s"]:
        """(2, s) windows whose deviation is significant."""
        return np.asarray(self.z > self.critical[:, None])

    @property
    def smallest_mm(self) -> float:
        """The deviation that half of the places would show as significant."""
        return float(np.median(self.tolerance_mm[0] + self.critical[0] * self.error_mm))


def tested(
    scales: tuple[Scale, ...],
    tolerance_mm: Float[np.ndarray, "2 b"],
    options: RegionOptions,
    *,
    tail: Tail | None,
) -> tuple[Level, ...]:
    """Test every scale's medians, and the third deepest and highest cells of the first.

    Parameters
    ----------
    tolerance_mm
        (2, b) δ of each cell of the field: for missing, for excess.
    tail
        Of sound places, as a calibration knows it; None tells it from the scan.
    """
    share = options.false_regions / (2 * (len(scales) + 1))
    levels = []
    for k, scale in enumerate(scales):
        size = np.maximum(np.bincount(scale.of_base, minlength=len(scale)), 1)
        delta = np.stack(
            [np.bincount(scale.of_base, side, minlength=len(scale)) / size for side in tolerance_mm]
        )
        apart = _wander(scale, options)
        common = np.sqrt(np.maximum(apart**2 - options.process_sigma_mm**2, 0.0))
        single = np.maximum(scale.noise_mm, LEAST_SIGMA_MM)
        noise = MEDIAN_LOSS * single / np.sqrt(scale.count)
        if k == 0:
            thirds = (-scale.low_mm, scale.high_mm)
            together = _independent(scale, noise, apart)
            error = np.hypot(single, common)
            levels.append(_level(scale, thirds, delta, error, share, options, tail, together))
        means = (-scale.median_mm, scale.median_mm)
        error = np.hypot(noise, common)
        levels.append(_level(scale, means, delta, error, share, options, tail, 1.0))
    return tuple(levels)


def density_class(scale: Scale, step: float) -> Int[np.ndarray, " s"]:
    """(s,) how densely each window was seen: octaves over `step`, 0 the sparsest.

    The half that was seen best is one class.
    """
    relative = scale.window_weight / float(np.median(scale.window_weight))
    octaves = np.minimum(np.floor(np.log2(relative) / step), 0.0).astype(np.int64)
    return np.asarray(octaves - octaves.min())


def class_medians(
    scale: Scale, value: Float[np.ndarray, " s"], options: RegionOptions
) -> Float[np.ndarray, " s"]:
    """(s,) median of a value over the windows that were seen as densely."""
    group = density_class(scale, options.density_step)
    return _by_class(group, value, int(group.max()) + 1, options)[group]


def _by_class(
    group: Int[np.ndarray, " n"],
    value: Float[np.ndarray, " n"],
    classes: int,
    options: RegionOptions,
) -> Float[np.ndarray, " c"]:
    """(c,) median of a value in each class, never less in one that was seen less densely.

    Aslant and at edges a scanner errs more, and as a whole, over the length on which its errors
    hang together.
    """
    found = np.zeros(classes)
    worst = 0.0
    for k in range(classes - 1, -1, -1):
        here = group == k
        if here.sum() >= options.least_cells:
            worst = max(worst, float(np.median(value[here])))
        found[k] = worst
    return found


def _wander(scale: Scale, options: RegionOptions) -> Float[np.ndarray, " s"]:
    """(s,) standard deviation of window means about what is normal some way off.

    From the differences of windows that face the same way, about as far apart as errors hang
    together: a layer that lacks as a whole is no noise. By how densely the worse one was seen.
    """
    far_mm = options.far_mm
    pick = np.arange(0, len(scale), max(len(scale) // options.most_pairs, 1))
    tree = cKDTree(scale.place_mm)
    around = tree.query_ball_point(scale.place_mm[pick], far_mm, return_sorted=False)
    size = np.array([len(found) for found in around])
    one = np.repeat(pick, size)
    other = np.concatenate([np.asarray(found, np.int64) for found in around])
    apart_mm = np.linalg.norm(scale.place_mm[one] - scale.place_mm[other], axis=1)
    alike = (scale.normal[one] * scale.normal[other]).sum(axis=1) > FACING_COSINE
    kept = alike & (apart_mm > 0.5 * far_mm)
    one, other = one[kept], other[kept]
    if len(one) < options.least_cells:
        return np.zeros(len(scale))
    group = density_class(scale, options.density_step)
    worse = np.minimum(group[one], group[other])
    off_mm = np.abs(scale.median_mm[one] - scale.median_mm[other]) / NORMAL_MEDIAN / np.sqrt(2.0)
    return _by_class(worse, off_mm, int(group.max()) + 1, options)[group]


def _independent(
    scale: Scale, noise_mm: Float[np.ndarray, " s"], apart_mm: Float[np.ndarray, " s"]
) -> float:
    """How many of `RANK` cells of a window err by themselves: all do, or (1) all err together.

    Of independent errors a window's median has the `noise_mm` that its cells' differences tell;
    what it departs by more, its cells have in common.
    """
    ratio = (float(np.median(noise_mm)) / max(float(np.median(apart_mm)), LEAST_SIGMA_MM)) ** 2
    return 1.0 + (RANK - 1) * min(ratio, 1.0)


def _level(
    scale: Scale,
    sides: tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]],
    tolerance_mm: Float[np.ndarray, "2 s"],
    error_mm: Float[np.ndarray, " s"],
    share: float,
    options: RegionOptions,
    tail: Tail | None,
    together: float,
) -> Level:
    """Standardise one statistic, and say from which value on it is significant."""
    z = (np.stack(sides) - tolerance_mm) / error_mm
    alone = scale.count < RANK  # fewer cells than that are no surface
    z[:, alone] = -np.inf
    n = max(int((~alone).sum()), 1)
    # `together` of a window's cells are all as far out: Q^r in any of C(k, r) choices
    usual = float(np.median(scale.count))
    ways = float(comb(usual, together)) if together > 1.0 and usual > together else 1.0
    quantile = norm.isf(min((share / (n * ways)) ** (1.0 / together), 0.5))
    log_p, critical, tails = np.empty_like(z), np.empty(2), []
    for side in range(2):
        fitted = tail or _tail(scale, z[side], options)
        tails.append(fitted)
        safe = np.clip(z[side], 0.0, 1e3)
        log_p[side] = np.log(n * ways) + together * norm.logsf(safe)
        critical[side] = quantile
        if fitted.scale > 0:
            fallen = np.log(max(fitted.peaks, 1)) - (safe - fitted.start) / fitted.scale
            log_p[side] = np.maximum(log_p[side], fallen)
            level = fitted.start + fitted.scale * np.log(max(fitted.peaks, 1) / share)
            critical[side] = max(quantile, level)
    return Level(scale, tolerance_mm, error_mm, z, critical, log_p, (tails[0], tails[1]))


def _tail(scale: Scale, z: Float[np.ndarray, " s"], options: RegionOptions) -> Tail:
    """The exponential tail of the peaks over the tolerance, the highest left out.

    The maximum-likelihood mean of an exponential of which the largest values are known only to be
    no smaller (type II censoring; Epstein and Sobel 1953).
    """
    over = z > options.tail_from
    group, groups = scales_kernels.components(scale.table, scale.count, over)
    kept = groups - options.most_defects
    if kept < options.most_defects // 2:  # too few to tell a tail from
        return Tail(options.tail_from, 0.0, groups)
    peak = np.full(groups, -np.inf)
    np.maximum.at(peak, group[over], z[over])
    peak = np.sort(peak) - options.tail_from
    mean = (peak[:kept].sum() + options.most_defects * peak[kept - 1]) / kept
    return Tail(options.tail_from, float(mean), groups)
