"""What views say differently of a place tells how far off the mean of those that saw it may be.

Views err each on its own: by an offset of the whole view, and by errors that hang together over a
few millimetres. How far their means over windows lie apart shows both at that width, and nothing of
what the part itself lacks, which all views see alike. A mean over several views is off by less than
what only one of them saw. And where the views of one window contradict what it tells, it is no
surer than they are apart, however many points one of them has there: a scanner errs by whole
patches, while what lacks of a part all views lack.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Numbers, Values
from amrepair.field import scales_kernels
from amrepair.field.scales import CELL_POINTS, RANK, Scale, faced_places
from amrepair.observe.robust import MAD_TO_SIGMA
from amrepair.regions.inspected import Inspected


@dataclass(frozen=True, slots=True)
class Said:
    """What each view says of each place on the surface.

    Attributes
    ----------
    foot
        (n,) the place that each of the first n original cells lies over. Of a place one view may
        see the surface and another what lies deep below it: two cells.
    points, total_mm
        (f, v) each view's number of points over each place, and the sum of their deviations.
    own
        (n, v) each view's share of the points in each cell: of a window all cells count alike.
    """

    foot: Numbers
    points: Float[np.ndarray, "f v"]
    total_mm: Float[np.ndarray, "f v"]
    own: Float[np.ndarray, "n v"]

    @classmethod
    def of(cls, inspected: Inspected) -> Self | None:
        """From the shares of the inspected cells; None where views are not told apart."""
        shares, n = inspected.shares, inspected.cells
        if shares is None:
            return None
        half_mm = 0.5 * inspected.cell_mm
        value_mm, normal = inspected.value_mm[:n], inspected.normal[:n]
        beyond_mm = value_mm - np.clip(value_mm, -half_mm, half_mm)
        place_mm = inspected.place_mm[:n] - beyond_mm[:, None] * normal
        foot = faced_places(place_mm, normal, inspected.cell_mm)
        views = int(shares.view.max(initial=0)) + 1
        at = foot[shares.place] * views + shares.view
        size = (int(foot.max(initial=-1)) + 1) * views
        points, total_mm = (
            np.bincount(at, told, size).reshape(-1, views)
            for told in (shares.count, shares.count * shares.value_mm)
        )
        every = np.bincount(shares.place, shares.count, n)[shares.place]
        own = np.bincount(shares.place * views + shares.view, shares.count / every, n * views)
        return cls(foot, points, total_mm, own.reshape(n, views))

    def over(self, scale: Scale) -> tuple[Float[np.ndarray, "s v"], ...]:
        """(s, v) points and summed deviations over each window's places; shares of its cells."""
        n, feet = len(self.foot), len(self.points)
        pair = np.unique(scale.of_base[:n] * feet + self.foot)  # each place once in a cell
        cell, foot = pair // feet, pair % feet
        gathered = (
            (cell, self.points[foot]), (cell, self.total_mm[foot]), (scale.of_base[:n], self.own)
        )  # fmt: skip
        return tuple(
            scales_kernels.window_sums(scale.table, scale.count, _summed(at, told, len(scale)))
            for at, told in gathered
        )


def _summed(at: Numbers, told: Float[np.ndarray, "k v"], size: int) -> Float[np.ndarray, "s v"]:
    views = told.shape[1]
    index = (at[:, None] * views + np.arange(views)).ravel()
    return np.bincount(index, told.ravel(), size * views).reshape(size, views)


@dataclass(frozen=True, slots=True)
class ViewErrors:
    """How far off one view is over windows of a width, and how many of them saw each.

    Attributes
    ----------
    one_mm
        Standard deviation of what one view says of a window; 0 where views are not told apart.
    cell_by, window_by
        (s,) how many views a cell of each window is worth, and the median of its cells.
    here_mm
        (s,) standard error of what each window tells, by what its own views say; 0 where only one
        saw it.
    """

    one_mm: float
    cell_by: Values
    window_by: Values
    here_mm: Values

    @classmethod
    def of(cls, scale: Scale, said: Said | None) -> Self:
        """From what views say of each window's places.

        Nothing is taken off for the noise of the views' points, which is in the means that are
        compared as it is in every other mean. What no point told, as surface that rays passed,
        counts as seen by one view.
        """
        if said is None:
            return cls(0.0, np.ones(len(scale)), np.ones(len(scale)), np.zeros(len(scale)))
        points, total_mm, own = said.over(scale)
        alone = np.ones(len(scale.of_base))
        alone[: len(said.own)] = np.square(said.own).sum(axis=1)
        alone = np.bincount(scale.of_base, alone) / np.bincount(scale.of_base)
        cell_by = 1.0 / scales_kernels.window_means(scale.table, scale.count, alone)
        judged = scale.is_surface & ~scale.apart
        one_mm = _one_mm(points[judged], total_mm[judged])
        here_mm = _here_mm(points, total_mm, scale.median_mm, one_mm)
        return cls(one_mm, cell_by, _worth(own), here_mm)


def _here_mm(
    points: Float[np.ndarray, "s v"],
    total_mm: Float[np.ndarray, "s v"],
    told_mm: Values,
    one_mm: float,
) -> Values:
    """(s,) standard error of what each window tells, by what its own views say; 0 of one view.

    Each view speaks by its points, up to those that make a surface: more of them err together. The
    share of their spread that views usually have, one standard deviation each, is left out: few
    views often lie farther apart by chance.

    References
    ----------
    Liang & Zeger, "Longitudinal data analysis using generalized linear models", 1986: the variance
    by clusters, here views. DerSimonian & Laird, "Meta-analysis in clinical trials", 1986: what is
    left of a spread beyond the usual, Q - (k - 1).
    """
    views = (points > 0.0).sum(axis=1)
    off_mm = total_mm / np.maximum(points, 1.0) - told_mm[:, None]
    says = np.minimum(points, RANK * CELL_POINTS)
    every = np.maximum(says.sum(axis=1), 1.0)
    several = views / np.maximum(views - 1, 1)
    spread = several * (says * np.square(off_mm)).sum(axis=1) / every
    beyond = np.maximum(1.0 - one_mm**2 / np.maximum(spread, np.finfo(float).tiny), 0.0)
    variance = several * np.square(says * off_mm).sum(axis=1) / every**2
    return np.where(views > 1, np.sqrt(beyond * variance), 0.0)


def _worth(points: Float[np.ndarray, "s v"]) -> Values:
    """(s,) how many views a mean of their points is worth; 1 where there are none.

    Views err each on its own, so that the mean over n points of each errs as that of (Σ n)² / Σ n²
    views (Kish 1965, effective sample size).
    """
    square = np.square(points).sum(axis=1)
    return np.divide(points.sum(axis=1) ** 2, square, out=np.ones(len(points)), where=square > 0.0)


def _one_mm(points: Float[np.ndarray, "s v"], total_mm: Float[np.ndarray, "s v"]) -> float:
    """Robust standard deviation of a view's mean over a window; 0 where none has several views.

    By what each says differently from all others of its window, by how many points tell that: the
    others' mean over n points of each errs as Σ n² / (Σ n)² of one.
    """
    rest = points.sum(axis=1)[:, None] - points
    both = (points > 0.0) & (rest > 0.0)
    if not both.any():
        return 0.0
    others_mm = (total_mm.sum(axis=1)[:, None] - total_mm)[both] / rest[both]
    squares = (np.square(points).sum(axis=1)[:, None] - np.square(points))[both]
    apart_mm = np.abs(total_mm[both] / points[both] - others_mm)
    apart_mm /= np.sqrt(1.0 + squares / rest[both] ** 2)
    order = np.argsort(apart_mm)
    told_by = np.cumsum((points[both] * rest[both] / (points[both] + rest[both]))[order])
    return MAD_TO_SIGMA * float(apart_mm[order][np.searchsorted(told_by, 0.5 * told_by[-1])])
