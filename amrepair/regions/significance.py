"""The test: where local means lie beyond the tolerance by more than this scan's errors explain.

What is tested is a minimum effect, |mean deviation| ≤ δ (Murphy and Myors 1999): δ is what a sound
part may deviate by. Means over windows of several widths (scales) are tested, and the stated number
of false regions is shared out over scales, signs and windows.

The standard error of a mean comes from the scan itself and has two parts. One is independent from
cell to cell, and neighbouring cells tell it by their differences. The other is common to a whole
window, the wander, and windows far apart tell it by theirs. Only few places are so far apart that
their errors are independent, so a deviation divided by this standard error is distributed as
Student's t rather than normally. Where several views saw a window they tell its common part, too,
by how much they differ (`between_views`).

Real scanners leave more outliers than that. Where more places exceed the tolerance than can be
real, their peaks tell the tail of the errors (Efron 2004, by peaks over a threshold); what stands
out even from that tail is a defect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import comb, log_ndtr, ndtri

from amrepair.arrays import Mask, Numbers, Values
from amrepair.field import scales_kernels
from amrepair.field.groups import connected, group_points
from amrepair.field.scales import RANK, WINDOW_FACING, Scale, faced_places, scales_of
from amrepair.regions.between_views import Said, ViewErrors
from amrepair.regions.error_calibration import Calibration
from amrepair.regions.inspected import Inspected
from amrepair.regions.options import RegionOptions

# A quarter of the differences of two standard normal values are smaller: √2 Φ⁻¹(5/8).
PAIR_QUARTILE = float(np.sqrt(2.0) * ndtri(0.625))
# Of the 3 × 3 cells of a plane's window, those that one at its rim has.
FULL_WINDOW = 2 * RANK
# Standard error of a median, of that of a mean, for normal noise: √(π/2).
MEDIAN_LOSS = float(np.sqrt(np.pi / 2))
# Of fewer peaks the lower half is too few to tell a tail from.
LEAST_PEAKS = 2 * RANK
# Coordinates in files are rounded to micrometres; no error is smaller.
LEAST_SIGMA_MM = 1e-3
# Of normal noise 0.3 % lies farther out.
OUTLIER_SIGMAS = 3.0
# More standard errors than that are certain.
MOST_ERRORS = 1e3
# The first quartile of the differences of all pairs, as an estimate of a normal standard deviation,
# is worth this share of the places (Rousseeuw and Croux 1993, section 4).
PAIRS_EFFICIENCY = 0.82


@dataclass(frozen=True, slots=True)
class Tail:
    """How the peaks of sound places beyond the tolerance fall off, in standard errors.

    Attributes
    ----------
    start, scale
        Beyond `start` the peaks are exponentially distributed with mean `scale`. A scale of 0 says
        that there is no tail beyond that of normal noise.
    peaks
        How many such peaks a scan has, on both sides together.
    told_by
        How many peaks the scale was estimated from; the fewer, the less certain it is.
    longest
        The longest scale that is believed, however few peaks it was estimated from.
    """

    start: float
    scale: float
    peaks: float
    told_by: float
    longest: float = np.inf

    def log_expected(self, z: Values) -> Values:
        """(s,) logarithm of how many peaks of sound places are expected beyond each value.

        Where the mean of an exponential is itself estimated from `told_by` peaks, the predicted
        tail is a Lomax distribution.
        """
        beyond = np.maximum(z - self.start, 0.0)
        falls = np.maximum(
            self.told_by * np.log1p(beyond / (self.told_by * self.scale)), beyond / self.longest
        )
        return np.asarray(np.log(self.peaks) - falls)

    def exceeded_by(self, expected: float) -> float:
        """The value beyond which so many peaks of sound places are expected in a scan."""
        ratio = max(self.peaks / expected, 1.0)
        told = self.told_by * self.scale * (ratio ** (1.0 / self.told_by) - 1.0)
        return self.start + min(told, self.longest * float(np.log(ratio)))


NO_TAIL = Tail(0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Errors:
    """Standard errors at one scale.

    Attributes
    ----------
    cell_mm, window_mm
        (s,) independent part of the standard error of a cell's value, and of a window's median.
    common_mm, most_common_mm
        (s,) part of the standard error that all cells of a window share; and if nothing of what
        windows wander by were the process's.
    wander_mm, freedom
        (c,) standard deviation of window means, for each class of how well windows were seen, and
        the degrees of freedom of its estimate.
    group
        (s,) the class of each window; 0 was seen best.
    facing
        All but a few windows were seen at a cosine of incidence of at least this.
    """

    cell_mm: Values
    window_mm: Values
    common_mm: Values
    most_common_mm: Values
    wander_mm: Float[np.ndarray, " c"]
    freedom: Float[np.ndarray, " c"]
    group: Numbers
    facing: float

    @property
    def independent(self) -> float:
        """How many of `RANK` cells of a window err independently: from 1 (all together) to `RANK`.

        If all errors were independent, a window's median would err by no more than the differences
        of its cells explain. What it errs by beyond that, its cells have in common.
        """
        whole = np.hypot(self.window_mm, self.common_mm)
        ratio = float(np.median(self.window_mm)) / float(np.median(whole))
        return 1.0 + (RANK - 1) * ratio**2

    def of(self, own_mm: Values, quantile: float) -> tuple[Values, Values]:
        """(s,) standard errors of a statistic with such an independent part, and their freedom.

        What the process is known to leave is taken off what windows wander by. The less is left,
        the less certain it is, and at most it is all of the wander: of the two, the one counts that
        believes more of a window at this quantile.
        """
        less, whole = (self._with(own_mm, each) for each in (self.common_mm, self.most_common_mm))
        surer = as_student(quantile, less[1]) * less[0] <= as_student(quantile, whole[1]) * whole[0]
        error_mm, freedom = (np.where(surer, *both) for both in zip(less, whole, strict=True))
        return error_mm, freedom

    def _with(self, own_mm: Values, common_mm: Values) -> tuple[Values, Values]:
        """(s,) standard errors with such a common part, and their degrees of freedom.

        Only the variance of the wander is uncertain (Satterthwaite 1946). Where the wander adds
        nothing to the independent part, the standard error counts as known: infinite.
        """
        error_mm = np.hypot(own_mm, common_mm)
        wander_mm = np.where(common_mm > 0.0, self.wander_mm[self.group], 0.0)
        share = (wander_mm / error_mm) ** 4
        known = np.full(len(share), np.inf)
        np.divide(self.freedom[self.group], share, out=known, where=share > 0.0)
        return error_mm, known


@dataclass(frozen=True, slots=True)
class Level:
    """One statistic, tested at one scale. In pairs, missing comes first, then excess.

    Attributes
    ----------
    scale, errors
        The scale, and its standard errors.
    tolerance_mm, error_mm
        (2, s) δ, and (s,) the standard error of the statistic.
    freedom
        (s,) degrees of freedom of the standard error.
    beyond_mm, z
        (2, s) how far each window lies beyond the tolerance; and the same in standard errors, as
        the normal value that is as rare as this value of Student's t.
    critical
        (2,) a window is significant if its z is above this,
    far_off_mm
        (2,) and if it also lies beyond the tolerance by more than this, since sound places may
        seem to where the scanner errs most.
    quantile
        What `critical` would be if errors were normal.
    log_p
        (2, s) natural logarithm of the expected number of false regions at least as high.
    peaks
        The highest z of each group of windows beyond the tolerance.
    tail
        How the peaks of sound places fall off.
    """

    scale: Scale
    errors: Errors
    tolerance_mm: Float[np.ndarray, "2 s"]
    error_mm: Values
    freedom: Values
    beyond_mm: Float[np.ndarray, "2 s"]
    z: Float[np.ndarray, "2 s"]
    critical: Float[np.ndarray, " 2"]
    far_off_mm: Float[np.ndarray, " 2"]
    quantile: float
    log_p: Float[np.ndarray, "2 s"]
    peaks: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " q"]]
    tail: Tail

    @property
    def rejected(self) -> Bool[np.ndarray, "2 s"]:
        """(2, s) windows whose deviation is significant."""
        far = self.beyond_mm > self.far_off_mm[:, None]
        # how sound places stray says nothing of a wall's end, which lies deep or is none
        critical = np.where(self.scale.apart, self.quantile, self.critical[:, None])
        return np.asarray(far & (self.z > critical))

    @property
    def chance_mm(self) -> Values:
        """(s,) how far beyond the tolerance a sound place may seem to be missing, by chance."""
        by_noise_mm = as_student(self.critical[0], self.freedom) * self.error_mm
        return np.maximum(by_noise_mm, self.far_off_mm[0])

    def far_mm(self, start: float) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " q"]]:
        """(p,), (q,) how far beyond the tolerance groups of windows with z above `start` lie."""
        over = self.z > start
        groups = [_groups(self.scale, each) for each in over]
        low, high = (_peaks(*each) for each in zip(groups, over, self.beyond_mm, strict=True))
        return low, high

    @property
    def smallest_mm(self) -> float:
        """The deviation that would be significant at half of the places."""
        return float(np.median(self.tolerance_mm[0] + self.chance_mm))


def as_normal(t: Float[np.ndarray, "*n"], freedom: Values) -> Any:
    """(*n,) normal values as rare as values of Student's t; `freedom` runs along the last axis.

    References
    ----------
    Wallace, "Bounds on normal approximations to Student's and the chi-square distributions", 1959.
    """
    some = np.isfinite(freedom)
    few = np.where(some, freedom, 1.0)
    length = np.sqrt(few * np.log1p(np.square(np.where(np.isfinite(t), t, 0.0)) / few))
    found = np.sign(t) * (8.0 * few + 1.0) / (8.0 * few + 3.0) * length
    return np.where(some & np.isfinite(t), found, t)


def as_student(z: float, freedom: Values) -> Values:
    """(s,) the inverse of `as_normal`, at most `MOST_ERRORS`."""
    some = np.isfinite(freedom) & np.isfinite(z)
    few = np.where(some, freedom, 1.0)
    length = (8.0 * few + 3.0) / (8.0 * few + 1.0) * (z if np.isfinite(z) else 0.0)
    found = np.sign(length) * np.sqrt(few * np.expm1(np.minimum(length**2 / few, 700.0)))
    return np.where(some, np.minimum(found, MOST_ERRORS), z)


def tested(
    inspected: Inspected, options: RegionOptions, calibration: Calibration | None
) -> tuple[Level, ...]:
    """Test the medians of windows at every scale, and small groups of cells at the first.

    At the first scale the statistic is the third lowest and third highest cell of a window, so that
    three deviating cells suffice. This level comes first in the result.
    """
    scales = scales_of(
        inspected.place_mm,
        inspected.normal,
        inspected.value_mm,
        inspected.weight,
        cell_mm=inspected.cell_mm,
        widest_mm=options.widest_mm,
        apart=inspected.apart,
    )
    said = Said.of(inspected)
    share = options.false_regions / (2 * (len(scales) + 1))
    levels: list[Level] = []
    for k, scale in enumerate(scales):
        size = np.maximum(np.bincount(scale.of_base, minlength=len(scale)), 1)
        cells = [
            np.bincount(scale.of_base, told, len(scale)) / size
            for told in (*inspected.tolerance_mm, inspected.facing, inspected.pose_mm)
        ]
        *delta, faced = (
            scales_kernels.window_means(scale.table, scale.count, told) for told in cells[:-1]
        )
        ranked = pose = scales_kernels.window_medians(scale.table, scale.count, cells[-1])
        if k == 0:  # single cells are tested at the first scale alone
            ranked = scales_kernels.most_of_ranked(
                scale.table, scale.count, scale.value_mm, cells[-1], RANK
            )
        group = seen_class(scale, faced, options.seen_step)
        judged = scale.is_surface & ~_scattered(scale, scales[0], group, options)
        most_mm = options.most_wander * point_sigma_mm(scales[0])
        views = ViewErrors.of(scale, said)
        by_cells, by_means = _errors(
            scale, group, faced, (ranked, pose), views, options, calibration, most_mm
        )
        allowed_mm = np.stack(delta)
        means = np.stack([-scale.median_mm, scale.median_mm])
        thirds = np.stack([-scale.low_mm, scale.high_mm])
        for statistic, sides, errors in ((0, thirds, by_cells), (1, means, by_means))[k > 0 :]:
            narrower = levels[-1].tail if levels else NO_TAIL
            levels.append(
                _level(
                    scale, judged, sides, allowed_mm, errors, share, options, calibration,
                    statistic, narrower,
                )
            )  # fmt: skip
    return tuple(levels)


def _scattered(scale: Scale, first: Scale, group: Numbers, options: RegionOptions) -> Mask:
    """(s,) windows of sparse points that tell nothing: strays, or seen as no others were.

    A surface fills its windows, those at its rim by two thirds, however sparsely it was seen; and
    what errors it has there only enough windows tell that were seen as badly, or worse.
    """
    sparse = ~first.is_surface[first.of_base]
    size = np.maximum(np.bincount(scale.of_base, minlength=len(scale)), 1)
    share = np.bincount(scale.of_base, sparse, len(scale)) / size
    mostly = scales_kernels.window_means(scale.table, scale.count, share) > 0.5
    filled = scale.is_surface & (scale.count >= FULL_WINDOW)
    alike = np.bincount(group[mostly & filled], minlength=int(group.max()) + 1)
    as_badly = np.cumsum(alike[::-1])[::-1]
    return np.asarray(mostly & ~(filled & (as_badly[group] >= options.least_cells)))


def point_sigma_mm(first: Scale) -> float:
    """Standard deviation of a single point about its neighbours, from the first scale's cells."""
    return float(np.median(first.noise_mm) * np.sqrt(max(float(np.median(first.weight)), 1.0)))


def _errors(
    scale: Scale,
    group: Numbers,
    facing: Values,
    poses_mm: tuple[Values, Values],
    views: ViewErrors,
    options: RegionOptions,
    calibration: Calibration | None,
    most_mm: float,
) -> tuple[Errors, Errors]:
    """The standard errors of a scale, of its cells and of its windows' medians.

    They are independent from cell to cell, and common to windows; `poses_mm` is what adds to the
    latter, of the `RANK`-th cells and of windows. Windows far apart tell what they
    have in common, and so do views of the same window, which are right too where fewer of them saw
    a place, or where they contradict what it tells; they tell of the same errors, and the largest
    counts.
    """
    classes = int(group.max()) + 1
    # a cell whose few neighbours happen to agree is as noisy as others that were seen as well
    usual = by_class(group, scale.noise_mm, options)[group]
    cell = np.maximum(np.maximum(scale.noise_mm, usual), LEAST_SIGMA_MM)
    window = MEDIAN_LOSS * cell / np.sqrt(scale.count)
    if calibration is None:
        wander, freedom = _wander(scale, group, classes, options, most_mm)
    else:
        wander, freedom = calibration.wander(scale.width_mm, classes)
    # the calibration has seen nothing so far aslant: there errors grow
    aslant = 1.0 if calibration is None else np.maximum(calibration.facing / facing, 1.0)
    few = min(options.least_cells, len(facing)) - 1
    least = float(np.partition(facing, few)[few])
    by_wander = (wander[group] * aslant) ** 2
    found = []
    for seen_by, pose_mm in zip((views.cell_by, views.window_by), poses_mm, strict=True):
        by_views = np.maximum(views.one_mm**2 / seen_by, np.square(views.here_mm))
        common, most = (
            np.sqrt(
                np.maximum(np.maximum(by_wander - process_mm2, by_views) - window**2, 0.0)
                + pose_mm**2
            )
            for process_mm2 in (options.process_sigma_mm**2, 0.0)
        )
        found.append(Errors(cell, window, common, most, wander, freedom, group, least))
    return found[0], found[1]


def seen_class(scale: Scale, facing: Values, step: float) -> Numbers:
    """(s,) class of how well each window was seen; 0 is the better half.

    By the number of points or by the cosine of incidence, whichever is worse relative to the
    median, in steps of `step` octaves. A scanner errs more where it looks aslant, at edges, and at
    the border of what it saw.
    """
    relative = np.minimum(
        scale.window_weight / float(np.median(scale.window_weight)),
        facing / float(np.median(facing)),
    )
    return np.maximum(-np.floor(np.log2(relative) / step), 0.0).astype(np.int64)


def by_class(
    group: Numbers,
    value: Values,
    options: RegionOptions,
    *,
    share: float = 0.5,
    classes: int | None = None,
) -> Float[np.ndarray, " c"]:
    """(c,) the median, or another quantile, of a value in each class of windows.

    Made to rise from class to class, since errors do not shrink where a place was seen less well;
    but by no more than the square of how much less well, since at an angle of incidence θ errors of
    real scans grow with 1/cos θ to 1/cos² θ.
    """
    size = np.bincount(group, minlength=classes or 0)
    found = np.zeros(len(size))
    ends, alike = np.cumsum(size), value[np.argsort(group, kind="stable")]
    for k in np.flatnonzero(size >= options.least_cells):
        found[k] = float(np.quantile(alike[ends[k] - size[k] : ends[k]], share))
    most = found[0] * 4.0 ** (options.seen_step * np.arange(len(found)))
    return np.maximum.accumulate(np.minimum(found, most))


def _wander(
    scale: Scale, group: Int[np.ndarray, " s"], classes: int, options: RegionOptions, most_mm: float
) -> tuple[Values, Values]:
    """(c,) the wander, that is the standard deviation of window means, and its degrees of freedom.

    Estimated from differences between windows that face the same way and lie farther apart than
    errors are correlated. A pair belongs to the class of its worse seen window. Only windows that
    face the same way are paired: where a whole layer is too low, all of them are, and this must not
    count as an error.
    """
    own = ~scale.apart  # how deep a wall's end lies tells nothing of errors
    place_mm, normal = scale.place_mm[own], scale.normal[own]
    pick = np.arange(0, len(place_mm), max(len(place_mm) // options.most_windows, 1))
    # patches farther apart than errors are correlated: their number is that of independent places
    patch_of = faced_places(place_mm, normal, 0.5 * options.far_mm)
    # a defect on a third of the best seen places is in half of all pairs, so the median would see
    # it; the lower quartile does not
    off_mm, worse, touched = scales_kernels.differences_apart(
        place_mm, normal, scale.median_mm[own], group[own], patch_of, pick,
        0.5 * options.far_mm, options.far_mm, WINDOW_FACING, classes,
    )  # fmt: skip
    off_mm /= PAIR_QUARTILE
    found = by_class(worse, off_mm, options, share=0.25, classes=classes)
    # a bent part wanders too, smoothly and farther than any scanner does
    found *= min(1.0, most_mm / max(float(found[0]), LEAST_SIGMA_MM))
    pairs = np.bincount(worse, minlength=classes)
    return found, _freedom(pairs, touched.sum(axis=1), options)


def _freedom(
    pairs: Int[np.ndarray, " c"], places: Int[np.ndarray, " c"], options: RegionOptions
) -> Float[np.ndarray, " c"]:
    """(c,) degrees of freedom of each class's wander, from how many places its pairs join.

    A class with too few pairs has those of the class whose value it takes.
    """
    freedom = np.empty(len(pairs))
    last = 1.0
    for k in range(len(pairs)):
        if pairs[k] >= options.least_cells:
            last = max(PAIRS_EFFICIENCY * (int(places[k]) - 1), 1.0)
        freedom[k] = last
    return freedom


def _level(
    scale: Scale,
    judged: Mask,
    sides: Float[np.ndarray, "2 s"],
    tolerance_mm: Float[np.ndarray, "2 s"],
    errors: Errors,
    share: float,
    options: RegionOptions,
    calibration: Calibration | None,
    statistic: int,
    narrower: Tail,
) -> Level:
    """Standardise one statistic, and find from which value on it is significant.

    `judged` windows are tested, the others are not; `statistic` is 0 for the third lowest and
    highest cells, 1 for medians; `share` is the number of false regions that this level may cause
    on one side, and `narrower` the tail of the level before.
    """
    own_mm, together = (
        (errors.cell_mm, errors.independent) if statistic == 0 else (errors.window_mm, 1.0)
    )
    n = max(int(judged.sum()), 1)
    # the chance that r = `together` of the k cells of a window are all so far out: C(k, r) · Q^r
    usual = float(np.median(scale.count))
    ways = float(comb(usual, together)) if together > 1.0 and usual > together else 1.0
    quantile = -float(ndtri(min((share / (n * ways)) ** (1.0 / together), 0.5)))
    error_mm, freedom = errors.of(own_mm, quantile)
    beyond_mm = sides - tolerance_mm
    z = as_normal(beyond_mm / error_mm, freedom)
    z[:, ~judged] = -np.inf
    critical = np.full(2, quantile)
    if statistic == 0 and calibration is None:
        outlying = _outlying(scale, error_mm, tolerance_mm, options.one_sided)
        # with so many outlying cells, three of them meet in a window by chance
        critical[n * comb(usual, RANK) * outlying**RANK > share] = np.inf
    safe = np.clip(z, 0.0, MOST_ERRORS)
    log_p = np.log(n * ways) + together * log_ndtr(-safe)
    far_off_mm = np.zeros(2)
    over = (z > options.tail_from) & ~scale.apart
    groups = [_groups(scale, each) for each in over]
    low, high = (_peaks(*each) for each in zip(groups, over, z, strict=True))
    tail = NO_TAIL
    if calibration is None:
        tail = _tail(scale, over, groups, z, narrower, options)
    for side in (0, 1):
        if calibration is not None:
            width_mm = scale.width_mm if statistic else None
            far_off = calibration.far_off_in(width_mm, side, len(scale))
            log_p[side] = np.maximum(log_p[side], far_off.log_expected(beyond_mm[side]))
            far_off_mm[side] = far_off.exceeded_by(share)
        elif tail.scale > 0:
            by_tail = np.maximum(log_p[side], tail.log_expected(safe[side]))
            log_p[side] = np.where(scale.apart, log_p[side], by_tail)
            critical[side] = max(critical[side], tail.exceeded_by(share))
    return Level(
        scale, errors, tolerance_mm, error_mm, freedom, beyond_mm, z, critical, far_off_mm,
        quantile, log_p, (low, high), tail,
    )  # fmt: skip


def _outlying(
    scale: Scale, error_mm: Values, tolerance_mm: Float[np.ndarray, "2 s"], one_sided: float
) -> Float[np.ndarray, " 2"]:
    """(2,) the share of cells that are outliers by the scanner's errors, for missing and excess.

    A defect's own cells are outliers too and must not count as errors, which two rules prevent.
    Errors lie all over a scan but a defect at one place, so the largest connected group is left
    out. And errors lie on both sides of the template but a defect on one, so a side has at most
    `one_sided` times as many errors as the other side shows. (For a count of k, the mean under a
    uniform prior is k + 1.)
    """
    off_mm = scale.value_mm - scale.median_mm
    low, high = (
        side > np.maximum(OUTLIER_SIGMAS * error_mm, tolerance_mm[0]) for side in (-off_mm, off_mm)
    )
    outliers = low | high
    largest = int(np.bincount(_groups(scale, outliers)[outliers], minlength=1).max())
    most = (1.0 + one_sided) * (np.array([high.sum(), low.sum()]) + 1.0)
    return np.minimum(outliers.sum() - largest, most) / len(outliers)


def _groups(scale: Scale, chosen: Mask) -> Numbers:
    """(s,) the number of the connected group of chosen windows that each window belongs to."""
    window, cell = scale.cells_of(chosen)
    beside = chosen[cell]
    return connected(window[beside], cell[beside], len(chosen))


def _peaks(group: Numbers, over: Mask, value: Values) -> Float[np.ndarray, " p"]:
    """(p,) the highest value of each group of the windows in `over`, in rising order."""
    peak = np.full(len(value), -np.inf)
    np.maximum.at(peak, group[over], value[over])
    return np.sort(peak[np.isfinite(peak)])


def _elsewhere(
    over: Mask,
    place: Numbers,
    own: Int[np.ndarray, " p"],
    opposite: Int[np.ndarray, " q"],
    options: RegionOptions,
) -> Mask:
    """(s,) which windows of a side in `over` are no defect's, by the rules of `_outlying`.

    A break is rough, and its windows are many peaks by themselves, some on the other side: those at
    the place that has the most are left out, but for where enough `opposite` ones lie elsewhere.
    `place` is that of each window, `own` and `opposite` those of the sides' peaks.
    """
    if not len(own):
        return over
    most = int(np.bincount(own).argmax())
    others = int((opposite != most).sum())
    if options.one_sided * (others + 1) >= LEAST_PEAKS:
        return over
    return np.asarray(over & (place != most))


def _tail(
    scale: Scale,
    over: Bool[np.ndarray, "2 s"],
    groups: list[Numbers],
    z: Float[np.ndarray, "2 s"],
    narrower: Tail,
    options: RegionOptions,
) -> Tail:
    """Fit an exponential tail to the peaks over the tolerance that are errors, of both sides.

    Errors lie on both sides of the template, so that either tells of the other's; what a defect
    leaves at one place does not. Where too few tell of errors, the `narrower` windows' do: means
    over more are no outliers more often.

    Which peaks are errors is found by a forward search, as in Kimber 1982. Peaks that even the
    longest tail would not reach are left out first. The lower half of the rest is taken for errors;
    from there upwards each peak is added for as long as it is no outlier of the exponential fitted
    to those below it. The first outlier and all above it may be real defects.
    """
    start, longest = options.tail_from, options.longest_tail

    def reach(count: int) -> float:
        return start + longest * float(np.log(max(count, 1) / options.false_regions))

    place = np.full(len(scale), -1)
    which = np.flatnonzero(over.any(axis=0))
    place[which] = group_points(scale.place_mm[which], reach_mm=scale.width_mm)
    at = [
        place[mine][np.unique(group[mine], return_index=True)[1]]
        for mine, group in zip(over, groups, strict=True)
    ]
    elsewhere = (
        _elsewhere(mine, place, own, opposite, options)
        for mine, own, opposite in zip(over, at, at[::-1], strict=True)
    )
    both = [_peaks(*each) for each in zip(groups, elsewhere, z, strict=True)]
    told = np.sort(np.concatenate(both))
    while len(told) and told[-1] > reach(len(told)):
        told = told[:-1]
    if len(told) < LEAST_PEAKS:
        return replace(narrower, peaks=max(float(len(told)), 1.0))
    beyond = told - start
    for sound in range(len(beyond) // 2, len(beyond) + 1):
        mean = min(float(beyond[:sound].mean()), longest)
        tail = Tail(start, mean, float(sound), float(sound), longest)
        if sound < len(beyond) and told[sound] > tail.exceeded_by(options.false_regions):
            break
    return tail
