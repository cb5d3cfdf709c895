"""What sound parts are like: where they depart from the template, by how much, and how far apart.

The template's field is the prior. At every site of its surface each sound scan says by how much the
part departs there; the median over the scans is the offset that the field takes on, what they
differ by becomes its tolerance. Elephant's feet, rounded corners and shrinkage are then no defects,
and a dent in one of the scans does not enter. It places no scans: they come in the template's
frame.

References
----------
Smyth, "Linear models and empirical Bayes methods for assessing differential expression", 2004,
section 6.2: variances of many sites, few observations each, shrunk towards a common one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from scipy.special import digamma, ndtr, polygamma, stdtrit

from amrepair.arrays import Points, Values, Vector
from amrepair.errors import InputError
from amrepair.frames import grid_points, unit_vectors
from amrepair.template.grid import Grid, GridSdf
from amrepair.template.grid_kernels import shared_nodes
from amrepair.template.learned import TOLERATED_SPREADS, LearnedSdf, Tolerance

MAD_TO_SIGMA = 1.4826  # of a Gaussian
SITE_AND_NEIGHBOURS = [1, 2, 3, 4, 5]  # a site and its four neighbours, nearest first


@dataclass(frozen=True, slots=True)
class SoundOptions:
    """How sound parts are learned from.

    Attributes
    ----------
    site_mm
        Distance between sites: a bead and a half are resolved, and a scan of usual density has some
        points about each.
    reach_mm
        A point farther from the template is no part of the surface beside it, and none teaches
        anything; farther away the field stays as it was.
    facing_mm
        Of two places on a wall's two sides the normals differ; so many mm apart stand for a right
        angle between them.
    least_points
        Of a scan about a site: fewer say nothing there.
    outvoted_p
        A scan that departs from the others with less than this probability, over all sites, is said
        to be defective there.
    """

    site_mm: float = 0.6
    reach_mm: float = 2.0
    facing_mm: float = 2.0
    least_points: int = 4
    outvoted_p: float = 0.01


@dataclass(frozen=True, slots=True)
class SoundSites:
    """Places on a template's surface and who lies near which.

    Attributes
    ----------
    place_mm, normal
        (s, 3) each, template frame.
    tree
        Of places and normals together, so that the two sides of a thin wall are far apart.
    """

    place_mm: Float[np.ndarray, "s 3"]
    normal: Float[np.ndarray, "s 3"]
    facing_mm: float
    tree: cKDTree

    @classmethod
    def on(cls, template: GridSdf, options: SoundOptions) -> SoundSites:
        """On a template's surface, `site_mm` apart."""
        place, normal = template.surface_points(options.site_mm)
        tree = cKDTree(np.column_stack([place, options.facing_mm * normal]))
        return cls(place, normal, options.facing_mm, tree)

    def nearest(
        self, points_mm: Points, f_mm: Values, outward: Points, count: int
    ) -> tuple[Float[np.ndarray, "n k"], Int[np.ndarray, "n k"]]:
        """Distances and numbers of the sites nearest to where points lie over the surface."""
        feet = points_mm - f_mm[:, None] * outward
        found = self.tree.query(
            np.column_stack([feet, self.facing_mm * outward]), k=[*range(1, count + 1)], workers=-1
        )
        return np.asarray(found[0]), np.asarray(found[1])


@dataclass(frozen=True, slots=True)
class SoundParts:
    """What sound scans say of a template's surface.

    Attributes
    ----------
    sites
        Where.
    offset_mm
        (s,) median over the scans of how far out of the template the part is; 0 where none looked.
    spread_mm
        (s,) a third of what a further sound part stays within, 99.7 % of the time, about the
        offset; 0 where fewer than two scans looked.
    scans
        (s,) how many scans looked.
    outvoted_mm2
        (k,) by scan, the area over which it departs from the others by more than chance.
    outvoted_at_mm
        (k, 3) the middle of that area; NaN where there is none.
    """

    sites: SoundSites
    offset_mm: Float[np.ndarray, " s"]
    spread_mm: Float[np.ndarray, " s"]
    scans: Int[np.ndarray, " s"]
    outvoted_mm2: Float[np.ndarray, " k"]
    outvoted_at_mm: Float[np.ndarray, "k 3"]

    def at(
        self, values: Float[np.ndarray, " s"], points_mm: Points, f_mm: Values, outward: Points
    ) -> Values:
        """(n,) a value of the sites over the surface: the four nearest, by inverse distance."""
        away, index = self.sites.nearest(points_mm, f_mm, outward, min(4, len(values)))
        weight = 1.0 / np.maximum(away, 1e-6)
        return np.asarray((weight * values[index]).sum(axis=1) / weight.sum(axis=1))


def learn(
    template: GridSdf,
    scans_mm: Sequence[Float[np.ndarray, "_ 3"]],
    options: SoundOptions | None = None,
) -> tuple[LearnedSdf, SoundParts]:
    """A template that knows what sound parts are like.

    Parameters
    ----------
    template
        The prior.
    scans_mm
        Points of sound parts, each (n, 3), template frame; three and more outvote a defect in one.

    Raises
    ------
    InputError
        If there is no scan, or one shows nothing of the part.
    """
    options = options or SoundOptions()
    if not scans_mm:
        raise InputError("nothing can be learned from no scan; name a scan of a sound part")
    sites = SoundSites.on(template, options)
    means = np.stack([_means(points, template, sites, options) for points in scans_mm])
    for k, row in enumerate(means):
        if np.isnan(row).all():
            raise InputError(
                f"scan {k + 1} has no surface within {options.reach_mm:g} mm of the template; "
                "check its pose and its unit"
            )
    sound = _summary(means, sites, options)
    return _on_top(template, sound, options), sound


def _means(
    points_mm: Points, template: GridSdf, sites: SoundSites, options: SoundOptions
) -> Float[np.ndarray, " s"]:
    """(s,) mean deviation of a scan about each site; NaN where it has too few points."""
    f_mm, gradient = template.distance_and_gradient(points_mm)
    near = np.abs(f_mm) < options.reach_mm
    outward = unit_vectors(gradient[near])
    away, index = sites.nearest(points_mm[near], f_mm[near], outward, 1)
    own = away[:, 0] < 2.0 * options.site_mm  # beyond, another surface is meant
    at, value = index[own, 0], f_mm[near][own]
    count = np.bincount(at, minlength=len(sites.place_mm)).astype(np.float64)
    total = np.bincount(at, value, minlength=len(sites.place_mm)).astype(np.float64)
    few = np.flatnonzero(count < options.least_points)
    if len(few):  # then with the sites beside it that face the same way
        beside = sites.tree.query(sites.tree.data[few], k=SITE_AND_NEIGHBOURS, workers=-1)[1]
        wide = count[beside].sum(axis=1), total[beside].sum(axis=1)
        count[few], total[few] = wide
    mean = total / np.maximum(count, 1.0)
    return np.asarray(np.where(count >= options.least_points, mean, np.nan))


def _summary(
    means: Float[np.ndarray, "k s"], sites: SoundSites, options: SoundOptions
) -> SoundParts:
    """Offsets, spreads, and which scans depart from the others."""
    seen = np.isfinite(means)
    count = seen.sum(axis=0)
    offset = np.zeros(means.shape[1])
    some = count > 0
    offset[some] = np.nanmedian(means[:, some], axis=0)
    off = np.where(seen, means - offset, 0.0)
    deviation = _robust_deviation(off, seen)
    freedom = np.maximum(count - 1.0, 0.0)
    prior_freedom, prior_deviation = _common(deviation, freedom)
    whole = freedom + prior_freedom
    shrunk = np.sqrt(
        (prior_freedom * prior_deviation**2 + freedom * deviation**2) / np.maximum(whole, 1e-9)
    )
    share = ndtr(TOLERATED_SPREADS)
    wide = stdtrit(np.maximum(whole, 1.0), share) / TOLERATED_SPREADS
    spread = np.where(count > 1, shrunk * np.sqrt(1 + 1 / np.maximum(count, 1)) * wide, 0.0)
    limit = -stdtrit(np.maximum(whole, 1.0), options.outvoted_p / max(int(seen.sum()), 1) / 2)
    outvoted = seen & (count > 2) & (np.abs(off) > limit * shrunk * np.sqrt(1 + 1 / count.clip(1)))
    return SoundParts(
        sites, offset, spread, count,
        outvoted.sum(axis=1) * options.site_mm**2,
        np.stack([_middle(sites.place_mm, which) for which in outvoted]),
    )  # fmt: skip


def _middle(place_mm: Float[np.ndarray, "s 3"], which: Bool[np.ndarray, " s"]) -> Vector:
    return np.asarray(place_mm[which].mean(axis=0) if which.any() else np.full(3, np.nan))


def _robust_deviation(
    off: Float[np.ndarray, "k s"], seen: Bool[np.ndarray, "k s"]
) -> Float[np.ndarray, " s"]:
    """(s,) standard deviation about the median, by the median absolute deviation.

    About the median of k normal values that is too small by about (k − 1)/k for few of them, as a
    mean square is.
    """
    count = seen.sum(axis=0)
    spread = np.zeros(off.shape[1])
    some = count > 1
    spread[some] = MAD_TO_SIGMA * np.nanmedian(np.where(seen, np.abs(off), np.nan)[:, some], axis=0)
    return spread * np.sqrt(np.maximum(count, 1) / np.maximum(count - 1, 1))


def _common(
    deviation: Float[np.ndarray, " s"], freedom: Float[np.ndarray, " s"]
) -> tuple[float, float]:
    """Degrees of freedom and standard deviation of the prior that all sites' variances share.

    References
    ----------
    Smyth 2004, section 6.2: from mean and variance of log s².
    """
    told = (freedom > 0) & (deviation > 0)
    if told.sum() < 2:
        return 0.0, 0.0
    log2, half = np.log(deviation[told] ** 2), 0.5 * freedom[told]
    e = log2 - digamma(half) + np.log(half)
    beyond = float(e.var(ddof=1) - polygamma(1, half).mean())
    if beyond <= 0:  # they differ by no more than chance: one variance for all
        return 1e3, float(np.exp(0.5 * e.mean()))
    half_prior = _inverse_trigamma(beyond)
    return 2 * half_prior, float(
        np.exp(0.5 * (e.mean() + digamma(half_prior) - np.log(half_prior)))
    )


def _inverse_trigamma(y: float) -> float:
    """x with trigamma(x) = y, by Newton's steps (Smyth 2004, appendix)."""
    x = 0.5 + 1 / y
    for _ in range(50):
        value = float(polygamma(1, x))
        step = value * (1 - value / y) / float(polygamma(2, x))
        x += step
        if abs(step) < 1e-8 * x:
            break
    return x


def _on_top(template: GridSdf, sound: SoundParts, options: SoundOptions) -> LearnedSdf:
    """The field with the offset taken from it, its mesh moved out by it, and the tolerance.

    Nodes that blocks share are asked once.
    """
    grid = template.grid
    axes = [grid.origin_mm[k] + grid.cell_mm * np.arange(n) for k, n in enumerate(grid.base.shape)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    base = _lowered(grid.base, nodes, template, sound, options)
    fine = grid.blocks.shape[1] - 1
    back, first = shared_nodes(grid.cells, grid.block_of.astype(np.int64), fine)
    block, own = np.divmod(first, (fine + 1) ** 3)
    inner = grid_points(*[np.arange(fine + 1)] * 3)
    where = grid.origin_mm + (grid.cells[block] * fine + inner[own]) * (grid.cell_mm / fine)
    lowered = _lowered(grid.blocks.reshape(-1)[first], where, template, sound, options)
    blocks = np.ascontiguousarray(lowered[back].reshape(grid.blocks.shape))
    moved = template.mesh.copy()
    vertices = np.asarray(template.mesh.vertices, dtype=np.float64)
    f_mm, gradient = template.distance_and_gradient(vertices)
    outward = unit_vectors(gradient)
    moved.vertices = (
        vertices + sound.at(sound.offset_mm, vertices, f_mm, outward)[:, None] * outward
    )
    taught = replace(
        template,
        grid=Grid(grid.origin_mm, grid.cell_mm, base, grid.block_of, blocks),
        mesh=moved,
        metadata={**template.metadata, "learned_from": str(int(sound.scans.max(initial=0)))},
    )
    return LearnedSdf.on(taught, _tolerance(template, sound, options))


def _lowered(
    values: Float[np.ndarray, "*n"],
    nodes_mm: Float[np.ndarray, "*n 3"],
    template: GridSdf,
    sound: SoundParts,
    options: SoundOptions,
) -> Float[np.ndarray, "*n"]:
    """Distances at nodes minus the offset there; within reach of the surface."""
    flat, places = values.reshape(-1).copy(), nodes_mm.reshape(-1, 3)
    near = np.flatnonzero(np.abs(flat) < options.reach_mm)
    f_mm, gradient = template.distance_and_gradient(places[near])
    flat[near] -= sound.at(sound.offset_mm, places[near], f_mm, unit_vectors(gradient))
    return np.ascontiguousarray(flat.reshape(values.shape), dtype=np.float32)


def _tolerance(template: GridSdf, sound: SoundParts, options: SoundOptions) -> Tolerance:
    """The spread in cells about the surface; the larger of it and what was tolerated before."""
    low, high = template.bounds_mm + np.array([[-1.0], [1.0]]) * options.reach_mm
    shape = np.ceil((high - low) / options.site_mm).astype(int)
    axes = [low[k] + options.site_mm * (np.arange(shape[k]) + 0.5) for k in range(3)]
    centres = grid_points(*axes)
    f_mm = template.distance(centres)
    near = np.flatnonzero(np.abs(f_mm) < options.reach_mm)
    spread = np.zeros(len(centres))
    f_near, gradient = template.distance_and_gradient(centres[near])
    spread[near] = sound.at(sound.spread_mm, centres[near], f_near, unit_vectors(gradient))
    if isinstance(template, LearnedSdf):
        spread = np.maximum(spread, template.tolerance.at(centres))
    return Tolerance(low, options.site_mm, spread.reshape(tuple(shape)).astype(np.float32))
