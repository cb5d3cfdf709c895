"""The test where sound scans of the part are at hand: how surely a scan is not one of them.

As in `regions.significance`: means over windows on several scales, each in standard errors, and
the number of false windows expected as far out, by the tail of what sound places leave. But nothing
of the null has to be told by the scan that is judged, so no median must guard it against its own
defects: the sound scans tell the bias by place, what they differ by there, and the tail, each
judged by the others. Means find what fills a fraction of a window, and windows go down to single
cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.special import ndtri

from amrepair.arrays import Mask, Points, Values
from amrepair.errors import InputError
from amrepair.field import scales_kernels
from amrepair.field.fused import estimate_spacing
from amrepair.field.near import spacing_in
from amrepair.field.scales import Scale, scales_of
from amrepair.frames import unit_vectors
from amrepair.regions.significance import LEAST_SIGMA_MM, Tail
from amrepair.template.port import Template

# Of a sum of terms of variance 1 and more: less is rounding.
LEAST_VARIANCE = 1e-9


@dataclass(frozen=True, slots=True)
class SoundTestOptions:
    """Settings of the test against sound scans.

    Attributes
    ----------
    neighbours
        Points of the sound scans that tell what is normal at a place: a mean over six has a
        standard error of 0.4 of a point's noise, and reaches hardly a spacing.
    tail_share
        Share of the windows of sound scans, the farthest out, that tell the tail.
    gap_spacings
        No sound scan looked at a place of the surface with none of their points within so many
        spacings: chance leaves 3 in 10⁹ without one, 1 in 100 where they are four times sparser.
    widest_mm
        Windows reach up to this width, as in `RegionOptions`.
    most_off_mm
        Farther off the template a point counts as so far off: clutter must not decide alone.
    stray
        Probability of a point that lies on no surface, or deep in a nook that no sound scan looked
        into: one alone is no defect, however far off it lies.
    template_is_known
        The template is of the part's own mesh: a guess nowhere, whatever sound scans looked at.
    """

    neighbours: int = 6
    tail_share: float = 0.01
    gap_spacings: float = 2.5
    widest_mm: float = 10.0
    most_off_mm: float = 3.0
    stray: float = 0.003
    template_is_known: bool = False


@dataclass(frozen=True, slots=True)
class Judged:
    """What the test says of a scan.

    Attributes
    ----------
    log_expected
        Natural logarithm of the number of false windows expected, over all that is tested, that
        are as far out as this scan's farthest: its p-value where it is small.
    off_mm, sigma_mm
        (n,) deviation of each point from what is normal there, and its standard error; infinite
        where no sound scan looked.
    """

    log_expected: float
    off_mm: Values
    sigma_mm: Values


@dataclass(frozen=True, slots=True)
class _Known:
    """Points of sound scans, by place, with their deviations: (n, 3) in the tree, (n,).

    And the places of the template's surface that none of them looked at; None where all were.
    """

    tree: cKDTree
    f_mm: Values
    spacing_mm: float
    within_mm: float
    unseen: cKDTree | None

    @classmethod
    def of(
        cls, points_mm: Points, f_mm: Values, template: Template, options: SoundTestOptions
    ) -> _Known:
        """By points of sound scans, and their deviations."""
        tree = cKDTree(points_mm)
        spacing_mm = spacing_in(tree)
        within_mm = options.gap_spacings * spacing_mm
        surface = template.surface_points(spacing_mm)[0]
        away = tree.query(surface, distance_upper_bound=within_mm, workers=-1)[0]
        far = surface[np.isinf(away)]
        return cls(tree, f_mm, spacing_mm, within_mm, cKDTree(far) if len(far) else None)

    def looked(self, feet_mm: Points, f_mm: Values) -> Mask:
        """(q,) whether a sound scan looked at the surface that a point's deviation is told by.

        At its foot, and beside it as far as the point lies off: where the template's surface is a
        guess nearer than that, the true one may pass through the point. A guess begins so much
        before it is called one as a gap may be wide.
        """
        away = self.tree.query(feet_mm, distance_upper_bound=self.within_mm, workers=-1)[0]
        looked = np.isfinite(away)
        if self.unseen is not None:
            beside = self.unseen.query(feet_mm, workers=-1)[0] - self.within_mm
            looked &= beside > np.abs(f_mm)
        return looked

    def at(self, points_mm: Points, looked: Mask, count: int) -> tuple[Values, Values, Values]:
        """(q,) mean deviation of the nearest sound points, their standard deviation, and `shared`.

        Nearest in space, not over the surface: where a template closed a hollow by a guess, the
        floor of the hollow is normal, and so is what lies above it.
        """
        count = min(count, len(self.f_mm))
        index = self.tree.query(points_mm, k=[*range(1, count + 1)], workers=-1)[1]
        near = self.f_mm[index]
        asked = np.bincount(index[looked].ravel(), minlength=len(self.f_mm))
        shared = asked[index].sum(axis=1) / count**2
        return near.mean(axis=1), near.std(axis=1), shared


@dataclass(frozen=True, slots=True)
class Seen:
    """What template and sound scans say of a scan's points.

    Attributes
    ----------
    f_mm, normals
        (n,) deviation from the template, (n, 3) its outward normals.
    expected_mm, spread_mm
        (n,) what sound points there deviate by in the mean, and their standard deviation.
    shared
        (n,) variance of `expected_mm` as a sum over points has it, in that of a sound point: where
        few sound points tell many of a scan, what these err by is common to many.
    looked
        (n,) whether a sound scan looked at the surface that tells the deviation.
    """

    f_mm: Values
    normals: Points
    expected_mm: Values
    spread_mm: Values
    shared: Values
    looked: Mask

    @classmethod
    def of(
        cls, points_mm: Points, template: Template, known: _Known | None, options: SoundTestOptions
    ) -> Seen:
        """Of points, (n, 3) template frame; `known` is None where one sound scan is alone."""
        f_mm, gradient = template.distance_and_gradient(points_mm)
        normals = unit_vectors(gradient)
        looked = np.ones(len(f_mm), bool)
        if not options.template_is_known:
            looked = _looked(points_mm, f_mm, normals, template, known)
        expected_mm = spread_mm = shared = np.zeros(len(f_mm))
        if known is not None:
            expected_mm, spread_mm, shared = known.at(points_mm, looked, options.neighbours)
        return cls(f_mm, normals, expected_mm, spread_mm, shared, looked)

    def followed(self, within_mm: float) -> Mask:
        """(n,) whether sound scans lie on the template there, within so much.

        Elsewhere it is a guess, or wrong, and poses should not follow it.
        """
        return np.asarray(self.looked & (np.abs(self.expected_mm) <= within_mm))


@dataclass(frozen=True, slots=True)
class SoundTest:
    """What sound scans of a part leave, and the test of a further scan against it.

    Attributes
    ----------
    template
        Into whose frame scans were laid.
    statistics
        Of single cells and of windows, at each scale from the finest: by what factor their means
        spread more than independent noise does, and how they fall off in units of that; `peaks` is
        a share of the windows.
    """

    template: Template
    known: _Known
    statistics: tuple[tuple[float, Tail], ...]
    options: SoundTestOptions

    @classmethod
    def of(
        cls,
        template: Template,
        scans_mm: Sequence[Float[np.ndarray, "_ 3"]],
        options: SoundTestOptions | None = None,
    ) -> SoundTest:
        """Learn from sound scans.

        Parameters
        ----------
        scans_mm
            Points of sound parts, each (n, 3), template frame; each is judged by the others, one
            alone by the template.

        Raises
        ------
        InputError
            If there is none.
        """
        if not scans_mm:
            raise InputError("the test needs a sound scan at least; name one")
        options = options or SoundTestOptions()
        f_mm = [template.distance(points) for points in scans_mm]

        def known_by(which: Sequence[int]) -> _Known:
            points_mm, told_mm = (
                np.concatenate([each[k] for k in which]) for each in (scans_mm, f_mm)
            )
            return _Known.of(points_mm, told_mm, template, options)

        found = []
        for k, points_mm in enumerate(scans_mm):
            others = [m for m in range(len(scans_mm)) if m != k]
            seen = Seen.of(points_mm, template, known_by(others) if others else None, options)
            found.append(_observed(points_mm, seen, options)[2])
        statistics = (
            np.concatenate([z[level] for z in found if level < len(z)])
            for level in range(max(len(z) for z in found))
        )
        return cls(
            template,
            known_by(range(len(scans_mm))),
            tuple(_null(z, options) for z in statistics),
            options,
        )

    def look(self, points_mm: Points) -> Seen:
        """Ask template and sound scans of a scan's points, (n, 3) in the template's frame."""
        return Seen.of(points_mm, self.template, self.known, self.options)

    def judge(self, points_mm: Points, seen: Seen | None = None) -> Judged:
        """Test a scan, (n, 3) in the template's frame, against what sound ones leave.

        `seen` is what `look` said of the same points.
        """
        seen = seen or self.look(points_mm)
        off_mm, sigma_mm, found = _observed(points_mm, seen, self.options)
        found = found[: len(self.statistics)]
        least = 0.0
        for z, (spread, tail) in zip(found, self.statistics, strict=False):
            if len(z):
                windows = Tail(tail.start, tail.scale, tail.peaks * len(z), tail.told_by)
                farthest = np.array([float(z.max()) / spread])
                least = min(least, float(windows.log_expected(farthest)[0]))
        return Judged(least + float(np.log(max(len(found), 1))), off_mm, sigma_mm)


def _observed(
    points_mm: Points, seen: Seen, options: SoundTestOptions
) -> tuple[Values, Values, list[Float[np.ndarray, " w"]]]:
    """Deviation of each point from what is normal there, its standard error, and the statistics.

    These are |mean| over cells and windows of each scale, the finest first, in its standard errors.
    Of which a single point makes up no more than chance gives to what strays.
    """
    off_mm = np.clip(seen.f_mm - seen.expected_mm, -options.most_off_mm, options.most_off_mm)
    scales = scales_of(
        points_mm,
        seen.normals,
        off_mm,
        np.ones(len(off_mm)),
        cell_mm=estimate_spacing(points_mm),
        widest_mm=options.widest_mm,
    )
    sigma_mm = np.maximum(_noise_mm(off_mm, scales[-1]), seen.spread_mm)
    sigma_mm[~seen.looked] = np.inf
    value = off_mm / sigma_mm
    variance = np.where(seen.looked, 1.0 + seen.shared, 0.0)
    alone = -float(ndtri(0.5 * options.stray))
    rising = np.argsort(np.abs(value), kind="stable")
    found = []
    for scale in scales:
        total, spread = (np.bincount(scale.of_base, each, len(scale)) for each in (value, variance))
        last = np.zeros(len(scale), np.int64)
        last[scale.of_base[rising]] = rising  # of a cell's points the farthest off is written last
        far, its = value[last], variance[last]
        around, its_spread = (
            scales_kernels.window_means(scale.table, scale.count, each) * scale.count
            for each in (total, spread)
        )
        most = scales_kernels.window_farthest(scale.table, scale.count, far)
        found.append(_beyond_one(total, spread, far, its, alone))
        found.append(_beyond_one(around, its_spread, far[most], its[most], alone))
    return off_mm, sigma_mm, found


def _looked(
    points_mm: Points, f_mm: Values, normals: Points, template: Template, known: _Known | None
) -> Mask:
    """(n,) whether what lies there was looked at: what was not is unknown, and speaks for nothing.

    A hollow that the template closed by a guess has no sound point on the guess.
    """
    if known is not None:
        return known.looked(points_mm - f_mm[:, None] * normals, f_mm)
    told = getattr(template, "coverage", None)
    if told is None:
        return np.ones(len(points_mm), bool)
    return np.asarray(~told.unknown_at(points_mm, f_mm, normals))


def _noise_mm(off_mm: Values, scale: Scale) -> float:
    """Standard deviation of one point, by what neighbours within a cell differ by."""
    order = np.argsort(scale.of_base, kind="stable")
    cell, value = scale.of_base[order], off_mm[order]
    apart = np.abs(np.diff(value))[cell[1:] == cell[:-1]]
    if not len(apart):
        return LEAST_SIGMA_MM
    return max(float(np.median(apart)) / scales_kernels.PAIR_MEDIAN, LEAST_SIGMA_MM)


def _beyond_one(
    total: Values, variance: Values, far: Values, its: Values, alone: float
) -> Float[np.ndarray, " s"]:
    """(s,) |sum| in standard deviations, where something was looked at.

    By at most `alone` more than without the term that is farthest off.
    """
    seen = variance > 0
    rest, left = np.abs(total - far)[seen], (variance - its)[seen]
    without = np.where(left > LEAST_VARIANCE, rest / np.sqrt(np.maximum(left, LEAST_VARIANCE)), 0.0)
    return np.asarray(np.minimum(np.abs(total[seen]) / np.sqrt(variance[seen]), without + alone))


def _null(z: Values, options: SoundTestOptions) -> tuple[float, Tail]:
    """By what factor means of sound places spread, and their tail in units of that."""
    spread = max(float(np.median(z)) / float(ndtri(0.75)), 1e-9)
    start = float(np.quantile(z / spread, 1.0 - options.tail_share))
    beyond = z[z > start * spread] / spread - start
    scale = float(beyond.mean()) if len(beyond) else 0.0
    return spread, Tail(start, max(scale, 1e-9), len(beyond) / len(z), float(max(len(beyond), 1)))
