"""Occupancy: which space around broken surface is solid, as the most probable labelling of voxels.

Where solid meets empty there is surface. Along points of the scan it costs nothing; elsewhere as
much as it is improbable that nobody saw it. The cheapest labelling is a minimum cut (Hornung &
Kobbelt 2006; Labatut, Pons & Keriven 2009). It needs neither rays nor normals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from amrepair.arrays import Mask, Numbers, Points, Values, VoxelMask, Voxels
from amrepair.field import cut_kernels as kernels
from amrepair.field.groups import group_points
from amrepair.field.near import has_near, nearest_within
from amrepair.field.options import OccupancyOptions
from amrepair.frames import box_of, cells_of, diagonal, in_box, spread_directions, unit_vectors
from amrepair.template.port import Template

# Capacities are whole numbers of this share of a nat; none is larger than that many.
UNIT_NATS, MOST_NATS = 0.01, 1e4
# So often at most a labelling is asked for without what was sealed in the last.
MOST_SEALED = 3
# Before and behind a plane, in voxels: there its sides are looked up.
LOOK_VOXELS = (0.75, 1.5, 2.5)
# Blocks of so many voxels a side whose middle is so many sides from the template's surface are
# wholly in it or outside it: √3 / 2, and a little.
TRACED_BLOCK, FAR_BLOCKS = 4, 1.1
# Ways that surface can face, 9° apart.
FACED_WAYS = 500
# Any surface faces one of the axes by 1/√3 at least.
LEAST_FACING = 0.57


@dataclass(frozen=True, slots=True)
class Broken:
    """Scanned surface that is not the template's; nobody knows which way its planes look.

    Attributes
    ----------
    place_mm, plane
        (q, 3) places, and unit normals of the planes through their neighbours.
    f_mm, outward
        (q,) the template's distance there, and (q, 3) its unit gradient.
    """

    place_mm: Points
    plane: Points
    f_mm: Values
    outward: Points


@dataclass(frozen=True)
class Occupancy:
    """Voxels of a box, template frame.

    Attributes
    ----------
    low_mm, voxel_mm
        Corner of the box, and edge of a voxel.
    solid
        (x, y, z) whether material is there.
    designed
        (x, y, z) whether it should be.
    """

    low_mm: Float[np.ndarray, " 3"]
    voxel_mm: float
    solid: VoxelMask
    designed: VoxelMask

    def at(self, points_mm: Points) -> Values:
        """Of points in the template: positive where solid, negative where empty, 0 unknown."""
        index, ok = _cells(points_mm, self.low_mm, self.voxel_mm, self.solid.shape)
        said = np.zeros(len(points_mm))
        said[ok] = self._told[tuple(index[ok].T)]
        return said

    @cached_property
    def _told(self) -> Voxels:
        """As voxels say; one that the template's surface cuts off, as those beside it in there."""
        told = np.where(self.solid, np.float32(1.0), np.float32(-1.0))
        beside = ndimage.uniform_filter(np.where(self.designed, told, np.float32(0.0)), 3)
        return np.asarray(np.where(self.designed, told, np.where(np.abs(beside) > 1e-3, beside, 0)))

    def open_side(self, faces: Broken) -> Values:
        """(q,) positive where space ahead of a plane is empty, negative behind, 0 unknown.

        Only on the same side of the template's surface: beyond that one surface more may lie.
        """
        side = np.zeros(len(faces.f_mm))
        for step in LOOK_VOXELS:
            for way in (-1.0, 1.0):
                at_mm = faces.place_mm + way * step * self.voxel_mm * faces.plane
                index, ok = _cells(at_mm, self.low_mm, self.voxel_mm, self.solid.shape)
                at = tuple(index[ok].T)
                same = self.designed[at] == (faces.f_mm[ok] < 0)
                side[ok] -= way * np.where(same, np.where(self.solid[at], 1.0, -1.0), 0.0)
        return side


@dataclass(frozen=True, slots=True)
class _Grid:
    """Voxels of a box: the template's distance at each, and the number of those to be labelled."""

    low_mm: Float[np.ndarray, " 3"]
    voxel_mm: float
    f_mm: Voxels
    number: Int[np.ndarray, "x y z"]

    @property
    def is_inside(self) -> Mask:
        """(v,) whether the voxels to be labelled lie in the template."""
        return np.asarray(self.f_mm[self.number >= 0] < 0)

    def numbers_at(self, points_mm: Points) -> Numbers:
        """(k,) number of the voxel that holds each point, −1 where none does."""
        index, ok = _cells(points_mm, self.low_mm, self.voxel_mm, self.number.shape)
        found = np.full(len(points_mm), -1, np.int64)
        found[ok] = self.number[tuple(index[ok].T)]
        return found


@dataclass(frozen=True, slots=True)
class _Facets:
    """Where two voxels meet of which one is to be labelled: numbers, axis, middle.

    `one` lies before `other` on the axis; −1 is a voxel that is known to be empty.
    """

    one: Numbers
    other: Numbers
    axis: Numbers
    middle_mm: Points
    on_template: Mask


@dataclass(frozen=True, slots=True)
class _Scanned:
    """A scan around broken surface: what of it is broken, points on the template, its spacing."""

    template: Template
    broken: Broken
    on_mm: Points
    spacing_mm: float
    options: OccupancyOptions

    def sees(self, asked_mm: Points) -> Mask:
        """Whether at least half as many points lie around each place as on surface that was seen.

        Half, so that along a straight rim of what was seen neither side gains.
        """
        within_mm = self.options.seen_spacings * self.spacing_mm
        half = int(0.5 * np.pi * self.options.seen_spacings**2)
        return has_near(asked_mm, self.on_mm, within_mm, enough=half)


def find_occupancy(
    template: Template,
    broken: Broken,
    on_mm: Float[np.ndarray, "m 3"],
    surface: tuple[Points, Points],
    *,
    spacing_mm: float,
    options: OccupancyOptions,
) -> Occupancy:
    """Label the space around broken surface.

    Parameters
    ----------
    on_mm
        Points of the scan that lie on the template.
    surface
        Places evenly spread on the template's surface, and outward unit normals.
    """
    if len(broken.f_mm) == 0:
        none = np.zeros((0, 0, 0), bool)
        return Occupancy(np.zeros(3), spacing_mm, none, none)
    places_mm, normals = surface
    scan = _Scanned(template, broken, on_mm, spacing_mm, options)
    bare = ~has_near(places_mm, on_mm, options.gap_spacings * spacing_mm)
    box_mm = _box(scan, places_mm[bare])
    grid = _grid(scan, box_mm)
    seen = scan.sees(places_mm)
    unseen = _nats_unseen(normals, seen, (grid.voxel_mm / spacing_mm) ** 2, options)
    scan = replace(scan, on_mm=on_mm[in_box(on_mm, *box_mm)])
    facets = _facets(grid)
    unexplained = _unexplained(scan, facets, grid.voxel_mm)
    cut = _Cut.of(facets, unseen[facets.axis] * unexplained[:, None], _told(scan, grid))
    mouths = _Mouths.of(scan, facets, unexplained, grid)
    solid = np.zeros(grid.number.shape, bool)
    solid[grid.number >= 0] = ~_with_open_sides(scan, cut, grid, mouths)
    found = _as_seen(solid, scan, grid)
    found |= _guessed(found, (*surface, seen), scan, grid)
    return Occupancy(grid.low_mm, grid.voxel_mm, found, grid.f_mm < 0)


def _box(scan: _Scanned, bare_mm: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "2 3"]:
    """What is broken, holes in the seen surface that touch it, and where it looks out of others."""
    broken, options = scan.broken, scan.options
    reach_mm = max(options.hole_mm, 3.0 * scan.spacing_mm)
    # a bare place among covered ones is chance
    holes_mm = bare_mm[has_near(bare_mm, bare_mm, reach_mm, enough=options.hole_places)]
    marked_mm = np.concatenate([broken.place_mm, holes_mm])
    group = group_points(marked_mm, reach_mm=reach_mm)
    touching = np.isin(group, np.unique(group[: len(broken.f_mm)]))
    places = [marked_mm[touching]]
    if len(holes_mm):
        out_mm = _ways_out(scan.template, broken, options)
        places.append(out_mm[has_near(out_mm, holes_mm, reach_mm)])
    box_mm = box_of(np.concatenate(places)) + options.margin_mm * np.array([[-1.0], [1.0]])
    over_mm = max(float(broken.f_mm.max()), 0.0) + 2.0 * scan.spacing_mm
    low_mm, high_mm = scan.template.bounds_mm + over_mm * np.array([[-1.0], [1.0]])
    return np.clip(box_mm, low_mm, high_mm)


def _ways_out(template: Template, broken: Broken, options: OccupancyOptions) -> Points:
    """Where lines from broken surface along its planes' normals first leave the template.

    No surface is nearer than the template's distance: so far each step goes (Hart 1996).
    """
    some = slice(None, None, max(1, len(broken.f_mm) // options.looking_places))
    front_mm = np.concatenate([broken.place_mm[some]] * 2)
    along = np.concatenate([broken.plane[some], -broken.plane[some]])
    f_mm = np.concatenate([broken.f_mm[some]] * 2)
    step_mm = 0.5 * options.hole_mm
    out = []
    for _ in range(int(diagonal(template.bounds_mm) / step_mm) + 1):
        front_mm = front_mm + np.maximum(-f_mm, step_mm)[:, None] * along
        f_mm = template.distance(front_mm)
        left = f_mm >= 0
        out.append(front_mm[left] - f_mm[left, None] * along[left])
        front_mm, along, f_mm = front_mm[~left], along[~left], f_mm[~left]
        if len(front_mm) == 0:
            break
    return np.concatenate(out)


def _grid(scan: _Scanned, box_mm: Float[np.ndarray, "2 3"]) -> _Grid:
    """Voxels of a box, as fine as their number allows.

    Those to be labelled lie in the template, or no farther outside it than the scan does.
    """
    options, highest_mm = scan.options, float(scan.broken.f_mm.max())
    extent_mm = np.maximum(np.ptp(box_mm, axis=0), 1e-6)
    voxel_mm = options.voxel_spacings * scan.spacing_mm
    most = options.box_ratio * options.most_voxels
    voxel_mm = max(voxel_mm, float(np.cbrt(np.prod(extent_mm) / most)))
    while True:
        shape = np.ceil(extent_mm / voxel_mm).astype(np.int64)
        f_mm = _distances(scan.template, box_mm[0], voxel_mm, shape)
        asked = f_mm < (highest_mm + voxel_mm if highest_mm > 0 else 0.0)
        count = int(asked.sum())
        if count <= options.most_voxels:
            break
        voxel_mm *= 1.02 * (count / options.most_voxels) ** (1 / 3)
    number = np.full(f_mm.shape, -1, np.int64)
    number[asked] = np.arange(count)
    return _Grid(box_mm[0], voxel_mm, f_mm, number)


def _distances(
    template: Template,
    low_mm: Float[np.ndarray, " 3"],
    voxel_mm: float,
    shape: Int[np.ndarray, " 3"],
) -> Voxels:
    """The template's distance at each voxel's middle; far from its surface that of a block's."""
    blocks = -(-shape // TRACED_BLOCK)
    middles = TRACED_BLOCK * (np.argwhere(np.ones(blocks, bool)) + 0.5)
    coarse = template.distance(low_mm + voxel_mm * middles)
    whole = coarse.reshape(blocks)
    for axis in range(3):
        whole = whole.repeat(TRACED_BLOCK, axis=axis)
    f_mm = whole[tuple(slice(size) for size in shape)].copy()
    # no voxel of a block lies farther from its middle
    near = np.argwhere(np.abs(f_mm) < FAR_BLOCKS * TRACED_BLOCK * voxel_mm)
    f_mm[tuple(near.T)] = template.distance(low_mm + voxel_mm * (near + 0.5))
    return f_mm


def _facets(grid: _Grid) -> _Facets:
    """All facets of the voxels to be labelled, but for those on the box's own faces."""
    found = []
    for axis in range(3):
        first = tuple(slice(None, -1 if k == axis else None) for k in range(3))
        second = tuple(slice(1 if k == axis else None, None) for k in range(3))
        one, other = grid.number[first], grid.number[second]
        at = np.nonzero((one >= 0) | (other >= 0))
        middle_mm = grid.low_mm + (np.stack(at, axis=1) + 0.5) * grid.voxel_mm
        middle_mm[:, axis] += 0.5 * grid.voxel_mm
        surface = (grid.f_mm[first][at] < 0) != (grid.f_mm[second][at] < 0)
        found.append((one[at], other[at], np.full(len(at[0]), axis), middle_mm, surface))
    return _Facets(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _nats_unseen(
    normals: Points, seen: Mask, points: float, options: OccupancyOptions
) -> Float[np.ndarray, "3 2"]:
    """How improbable a facet is that nobody saw, by axis and by the way it faces (+, −), nats.

    The scan saw of the template's surface that faces this way such a share: as probably it would
    have seen this, with as many points as its area holds at the scan's density.
    """
    ways = np.stack([np.eye(3), -np.eye(3)], axis=1).reshape(-1, 3)
    cover = _cover(ways, normals, np.ones(len(normals)), seen, options)
    chance = np.minimum(cover, options.largest_cover) * (1.0 - np.exp(-points))
    return np.asarray(-np.log1p(-chance).reshape(3, 2))


def _cover(
    ways: Points,
    normals: Float[np.ndarray, "m 3"],
    every: Float[np.ndarray, " m"],
    seen: Bool[np.ndarray, " m"] | Float[np.ndarray, " m"],
    options: OccupancyOptions,
) -> Values:
    """(n,) how much was seen of the template's surface that faces about each way.

    `every` and `seen` count places by their normals, of which all and those that were.
    """
    cosine = ways @ normals.T
    weight = np.where(cosine > options.way_cosine, cosine**2, 0.0)
    whole = weight @ every
    return np.asarray(np.where(whole > 0, weight @ seen / np.where(whole > 0, whole, 1.0), 1.0))


def _hidden(normals: Points, seen: Mask, options: OccupancyOptions) -> Mask:
    """Places that nobody saw, where most surface that faces as they do was not seen either."""
    ways = spread_directions(FACED_WAYS)
    of = cKDTree(ways).query(normals)[1]
    every, looked = (np.bincount(of, which, FACED_WAYS) for which in (None, seen))
    cover = _cover(ways, ways, every.astype(np.float64), looked, options)
    return np.asarray(~seen & (cover[of] < options.hidden_cover))


def _unexplained(scan: _Scanned, facets: _Facets, voxel_mm: float) -> Values:
    """(k,) 0 where scanned points lie on a facet, 1 where none does.

    On the template's surface its own points count, elsewhere those of what is broken.
    """
    share = np.ones(len(facets.one))
    on, off = np.flatnonzero(facets.on_template), np.flatnonzero(~facets.on_template)
    share[on] = ~scan.sees(_feet(scan.template, facets.middle_mm[on])[0])
    width_mm = _width_mm(scan, voxel_mm)
    middle_mm = facets.middle_mm[off]
    nearest = nearest_within(middle_mm, scan.broken.place_mm, 1.4 * width_mm)
    found = nearest >= 0
    apart_mm = np.linalg.norm(middle_mm[found] - scan.broken.place_mm[nearest[found]], axis=1)
    share[off[found]] = -np.expm1(-((apart_mm / width_mm) ** 4))
    return share


def _feet(template: Template, points_mm: Points) -> tuple[Points, Points]:
    """Nearest places on the template, and outward unit normals."""
    f_mm, gradient = template.distance_and_gradient(points_mm)
    outward = unit_vectors(gradient)
    return points_mm - f_mm[:, None] * outward, outward


def _width_mm(scan: _Scanned, voxel_mm: float) -> float:
    """How far from its points surface may be put; steps of voxels by up to half of one more."""
    return scan.options.gap_spacings * scan.spacing_mm + 0.6 * voxel_mm


def _told(scan: _Scanned, grid: _Grid) -> Float[np.ndarray, " v"]:
    """(v,) what is known of each voxel by itself, nats: positive solid, negative empty.

    As designed, a little; behind a point on the template's surface solid and before it empty, but
    for strays; and beyond the box as designed.
    """
    inside = grid.is_inside
    facet = (grid.voxel_mm / scan.spacing_mm) ** 2
    told = np.where(inside, 1.0, -1.0) * facet * grid.voxel_mm / scan.options.deep_mm
    f_mm, gradient = scan.template.distance_and_gradient(scan.on_mm)
    outward = unit_vectors(gradient)
    for way in (-0.5, 0.5):
        number = grid.numbers_at(scan.on_mm + (way * grid.voxel_mm - f_mm)[:, None] * outward)
        number = number[number >= 0]
        number = number[inside[number] == (way < 0)]
        count = np.bincount(number, minlength=len(told))
        told += np.sign(way) * count * np.log(scan.options.stray)
    for axis in range(3):
        for end in (0, -1):
            face = np.take(grid.number, end, axis=axis)
            face = face[face >= 0]
            told[face] += np.where(inside[face], facet, -facet)
    return told


@dataclass(frozen=True, slots=True)
class _Cut:
    """The cheapest labelling of voxels, a minimum cut; and those of other prices from there on.

    Of equally cheap ones that with the most solid: empty is what still reaches what is empty for
    certain once no more flow fits (Ford & Fulkerson 1956).

    Attributes
    ----------
    facets, nats
        Where two voxels meet, (k, 2) of each the price of `one` solid alone, and of `other` alone.
    told
        (v,) of each voxel that is empty.
    beyond
        (2, v) of one that is solid where nothing is beyond it, on the one side and the other.
    beside
        (v, 6) voxels before and behind on each axis, −1 where there is none.
    fits, ends
        (v, 6) to each of them, (v,) from what is solid or, negative, to what is empty: what flow
        still fits, `UNIT_NATS`.
    empty
        (v,) whether each voxel is.
    """

    facets: _Facets
    nats: Float[np.ndarray, "k 2"]
    told: Values
    beyond: Float[np.ndarray, "2 v"]
    beside: Int[np.ndarray, "v 6"]
    fits: Int[np.ndarray, "v 6"]
    ends: Numbers
    empty: Mask

    @classmethod
    def of(cls, facets: _Facets, nats: Float[np.ndarray, "k 2"], told: Values) -> _Cut:
        """By what it costs where voxels meet, and what is told of each."""
        beyond = np.zeros((2, len(told)))
        for mine, none, k in ((facets.one, facets.other, 0), (facets.other, facets.one, 1)):
            edge = (mine >= 0) & (none < 0)  # what lies beyond is empty: solid ends here
            beyond[k] = np.bincount(mine[edge], nats[edge, k], minlength=len(told))
        whole = facets.one, facets.other, facets.axis, _in_units(nats), len(told)
        beside, fits = kernels.joined(*whole)
        ends = _in_units(told - beyond[0] - beyond[1])
        empty = kernels.flow(beside, fits, ends) == kernels.EMPTY
        return cls(facets, nats, told, beyond, beside, fits, ends, empty)

    def labelled(self, told: Values) -> Mask:
        """(v,) what is empty where voxels are less surely solid."""
        before, now = (
            _in_units(each - self.beyond[0] - self.beyond[1]) for each in (self.told, told)
        )
        ends = self.ends + now - before
        return np.asarray(kernels.flow(self.beside, self.fits.copy(), ends) == kernels.EMPTY)

    def cost(self, empty: Mask) -> float:
        """Of a labelling, nats."""
        solid = np.append(~empty, False)
        one, other = solid[self.facets.one], solid[self.facets.other]
        surface = self.nats[one & ~other, 0].sum() + self.nats[other & ~one, 1].sum()
        return float(self.told[empty].sum() + surface)

    def least_rise(self, told: Values) -> float:
        """How much more any labelling costs at least in which what is told to be is empty, nats.

        Whatever flow still comes from there is cut, but for half a unit of each price.
        """
        surely = told <= -MOST_NATS
        rise = float(np.maximum(self.ends[surely], 0).sum()) - 0.5 * (self.nats.size + len(told))
        return max(rise * UNIT_NATS, 0.0)


def _in_units(nats: Float[np.ndarray, "*shape"]) -> Int[np.ndarray, "*shape"]:
    """Whole numbers of `UNIT_NATS`."""
    return np.round(np.clip(nats, -MOST_NATS, MOST_NATS) / UNIT_NATS).astype(np.int32)


@dataclass(frozen=True, slots=True)
class _Mouths:
    """Where one could look into the template: its surface that no point lies on.

    Whoever scanned the broken surface of a void looked in from outside, so that a void without a
    mouth a bead wide is none. A cut cannot say so: where most of a part is gone the cheapest
    labelling may be a void sealed in what was seen to stand, under the broken surface and not over
    it.

    Attributes
    ----------
    grid
        Of the voxels.
    mouth_mm2
        (v,) unseen surface of each voxel in the template.
    least_mm2, least
        Of a mouth; as many points lie on so much surface: fewer places, or voxels of a void, are
        not worth a question.
    """

    grid: _Grid
    mouth_mm2: Values
    least_mm2: float
    least: float

    @classmethod
    def of(cls, scan: _Scanned, facets: _Facets, unexplained: Values, grid: _Grid) -> _Mouths:
        """Of the facets on the template's surface that scanned points do not explain."""
        at = facets.on_template & (unexplained > 0.0)
        inside = np.append(grid.is_inside, False)
        one, other = facets.one[at], facets.other[at]
        within = np.where(inside[one], one, other)
        mouth_mm2 = np.bincount(within, minlength=len(inside) - 1) * grid.voxel_mm**2
        least_mm2 = float(np.pi * scan.options.bead_mm**2)
        return cls(grid, mouth_mm2, least_mm2, least_mm2 / scan.spacing_mm**2)

    def sealed(self, empty: Mask) -> Mask:
        """(v,) what is empty and should not be, with no way to the outside."""
        within = self.grid.number >= 0
        void = np.zeros(within.shape, bool)
        void[within] = empty & self.grid.is_inside
        group = ndimage.label(void)[0][within]
        mouth_mm2 = np.bincount(group, self.mouth_mm2)
        shut = (mouth_mm2 < self.least_mm2) & (np.bincount(group) >= self.least)
        shut[0] = False
        return np.asarray(shut[group])

    def cheapest(self, cut: _Cut, told: Values) -> Mask:
        """(v,) what is empty by the cheapest labelling without what is sealed."""
        empty = cut.empty if told is cut.told else cut.labelled(told)
        for _ in range(MOST_SEALED):
            sealed = self.sealed(empty)
            if not sealed.any():
                break
            told = np.where(sealed, MOST_NATS, told)
            empty = cut.labelled(told)
        return empty


@dataclass(frozen=True, slots=True)
class _Sides:
    """Voxels on both sides of broken surface, and what it costs where both are solid.

    Nobody sees a surface with material on both sides: such a place is a stray, at its price. A cut
    cannot say "one side or the other"; labellings that open a side are proposed, and compared.

    Attributes
    ----------
    toward, away
        (q,) number of the voxel on each side, by which way the template's surface is nearer; −1 is
        air, or was not looked at.
    askew
        (q,) neither side is.
    beyond
        (2, q) voxels farther off, before and behind.
    within
        (2, q) voxels of the template, toward and away, as far off as the labelled surface may be
        put from its points; −1 is air, or was not looked at.
    price
        Of a place with material on both sides, nats.
    """

    toward: Numbers
    away: Numbers
    askew: Mask
    beyond: Int[np.ndarray, "2 q"]
    within: Int[np.ndarray, "2 q"]
    price: float

    @classmethod
    def of(cls, scan: _Scanned, grid: _Grid) -> _Sides:
        """Of broken surface, a voxel's edge before and behind it."""
        broken, options = scan.broken, scan.options
        along = (broken.outward * broken.plane).sum(axis=1)
        step_mm = grid.voxel_mm * np.sign(along)[:, None] * broken.plane
        toward, away, *beyond = (
            grid.numbers_at(broken.place_mm + way * step_mm)
            for way in (1.0, -1.0, LOOK_VOXELS[-1], -LOOK_VOXELS[-1])
        )
        far = _width_mm(scan, grid.voxel_mm) / grid.voxel_mm + 0.5
        within = np.stack([grid.numbers_at(broken.place_mm + way * step_mm) for way in (far, -far)])
        within = np.where(np.append(grid.is_inside, False)[within], within, -1)
        askew = np.abs(along) < options.way_cosine
        # of a wide facet's many places together no more is known than of a facet that nobody saw
        most = -np.log1p(-options.largest_cover) / (grid.voxel_mm / scan.spacing_mm) ** 2
        price = float(min(-np.log(options.stray), most))
        return cls(toward, away, askew, np.stack(beyond), within, price)

    def is_shut(self, empty: Mask) -> Bool[np.ndarray, " q"]:
        """(q,) whether both sides are solid, as far off as surface may be put."""
        solid, void = np.append(~empty, False), np.append(empty, False)
        shut = solid[self.toward] & solid[self.away]
        return np.asarray(shut & ~void[self.within].any(axis=0))

    def proposed(self, empty: Mask, room: Numbers, told: Values, least: float) -> Iterator[Values]:
        """What voxels would say were shut places open towards the surface; away from it, as in a
        hollow under a film too thin to be told from it; or were a room empty that they bound.

        `least` of them, or no room is.
        """
        shut = self.is_shut(empty)
        for side in (self.toward, self.away):
            which = side[shut & ~self.askew]
            yield told - self.price * np.bincount(which, minlength=len(told))
        beside = np.where(self.beyond < 0, 0, room[self.beyond])[:, shut]
        bounds = np.bincount(beside[:, beside[0] != beside[1]].ravel(), minlength=2)
        for k in 1 + np.flatnonzero(bounds[1:] >= least):
            yield np.where(room == k, -MOST_NATS, told)


def _with_open_sides(scan: _Scanned, cut: _Cut, grid: _Grid, mouths: _Mouths) -> Mask:
    """What is empty by a cut, or by a cheaper labelling in which broken surface has an open side.

    As much of it as is around a bead must have none, or it stays.
    """
    sides = _Sides.of(scan, grid)

    def cost(labels: Mask) -> float:
        return cut.cost(labels) + float(sides.price * sides.is_shut(labels).sum())

    empty = mouths.cheapest(cut, cut.told)
    if sides.is_shut(empty).sum() < mouths.least:
        return empty
    within = grid.number >= 0
    uncut = within.copy()
    uncut[within] = ~empty
    scan_mm = np.concatenate([scan.broken.place_mm, scan.on_mm])
    index, ok = _cells(scan_mm, grid.low_mm, grid.voxel_mm, uncut.shape)
    scanned = np.zeros(uncut.shape, bool)
    scanned[tuple(index[ok].T)] = True
    # rooms are what scanned surface separates, of which a voxel may hold no point by chance
    uncut &= ~ndimage.binary_dilation(scanned, np.ones((3, 3, 3), bool))
    room = ndimage.label(uncut)[0][within]
    best, least_cost = empty, cost(empty)
    for proposed in sides.proposed(empty, room, cut.told, mouths.least):
        if cut.cost(cut.empty) + cut.least_rise(proposed) > least_cost:
            continue
        tried = mouths.cheapest(cut, proposed)
        if (price := cost(tried)) < least_cost:
            best, least_cost = tried, price
    return best


def _as_seen(solid: VoxelMask, scan: _Scanned, grid: _Grid) -> VoxelMask:
    """The same, but as designed where too little that is broken bounds what differs.

    What hides a part of the surface hides all of it at once, so that no number of unseen places is
    evidence of a void. A void that takes an area M of the template's surface has a broken edge: if
    it goes right through, around M/2, at least as long as a circle's and a bead thick.
    """
    found, designed = solid.copy(), grid.f_mm < 0
    index, ok = _cells(scan.broken.place_mm, grid.low_mm, grid.voxel_mm, solid.shape)
    at = tuple(index[ok].T)
    cross = ndimage.generate_binary_structure(3, 1)
    for differs in (designed & ~solid, solid & ~designed):
        groups, count = ndimage.label(differs)
        # a broken place lies in what differs or in a voxel beside it
        beside = ndimage.grey_dilation(groups, footprint=cross)
        broken_mm2 = np.bincount(beside[at], minlength=count + 1) * scan.spacing_mm**2
        least_mm2 = np.zeros(count + 1)
        if differs[designed].any():
            mouth = np.zeros(solid.shape, np.int64)
            for axis in range(3):
                for way in (1, -1):
                    mouth += ~np.roll(designed, way, axis=axis)
            mouth_mm2 = np.bincount(groups[differs], mouth[differs], count + 1) * grid.voxel_mm**2
            around_mm = 2.0 * np.sqrt(np.pi * 0.5 * mouth_mm2)
            least_mm2 = scan.options.least_seen * scan.options.bead_mm * around_mm
        alone = differs & ~((broken_mm2 > 0) & (broken_mm2 >= least_mm2))[groups]
        found[alone] = designed[alone]
    return found


def _guessed(
    solid: VoxelMask, surface: tuple[Points, Points, Mask], scan: _Scanned, grid: _Grid
) -> VoxelMask:
    """What is said to be empty, though its end nearest by was not scanned and nobody looked in.

    The cheapest labelling ends a void at the smallest surface that closes it: a dent at the rim of
    a dome that nobody saw would take the dome along.

    Parameters
    ----------
    surface
        Places on the template, outward unit normals, and whether they were seen.
    """
    designed = grid.f_mm < 0
    void = designed & ~solid
    ends, scanned = np.zeros_like(void), {}
    width_mm = _width_mm(scan, grid.voxel_mm)
    for side, index, middle_mm in _facets_toward(void, designed & solid, grid):
        ends |= _marked(void, index)
        known = has_near(middle_mm, scan.broken.place_mm, width_mm)
        # a film's inner side may be told from the template's surface by no point
        feet_mm, _ = _feet(scan.template, middle_mm)
        film = np.linalg.norm(middle_mm - feet_mm, axis=1) < width_mm
        known |= film & scan.sees(feet_mm)
        scanned[side] = _marked(void, index[known])
    if not ends.any():
        return np.zeros_like(void)
    (box,) = ndimage.find_objects(void.astype(np.int8))
    nearest = ndimage.distance_transform_edt(
        ~ends[box], return_distances=False, return_indices=True
    )
    # a gap in what was scanned of an end, no wider than points are asked for, is chance
    across = 2 * math.ceil(width_mm / grid.voxel_mm) + 1
    known, every = (
        ndimage.uniform_filter(one[box].astype(np.float32), across, mode="constant")
        for one in (np.logical_or.reduce([*scanned.values()]), ends)
    )
    guessed = void.copy()
    guessed[box] &= (known < 0.5 * every)[tuple(nearest)]
    if guessed.any():
        guessed &= ~_looked_into(void, scanned, surface, scan, grid)
    return guessed


def _looked_into(
    void: VoxelMask,
    scanned: dict[tuple[int, int], VoxelMask],
    surface: tuple[Points, Points, Mask],
    scan: _Scanned,
    grid: _Grid,
) -> VoxelMask:
    """What is empty straight below template surface that would have been seen, were it there, as
    far as to an end that was scanned (by axis and way), or right through.

    What hides a part of the surface ends not just where its faces meet: what lies beside hidden
    surface, and does not face away from it, may be hidden, too.
    """
    places_mm, normals, seen = surface
    hidden = _hidden(normals, seen, scan.options)
    within_mm = scan.options.seen_spacings * scan.spacing_mm + grid.voxel_mm
    mouths, looked = {}, np.zeros_like(void)
    for (axis, way), index, middle_mm in _facets_toward(void, grid.f_mm >= 0, grid):
        toward = hidden & (way * normals[:, axis] > -scan.options.way_cosine)
        known = way * _feet(scan.template, middle_mm)[1][:, axis] > LEAST_FACING
        known &= ~has_near(middle_mm, places_mm[toward], within_mm)
        mouths[axis, way] = _marked(void, index), _marked(void, index[known])
    for (axis, way), (_, known) in mouths.items():
        through, _ = mouths[axis, -way]
        found = through | scanned[axis, -way]
        looked |= _along(void, known, axis, -way) & _along(void, found, axis, way)
    return looked


def _facets_toward(
    void: VoxelMask, beside: VoxelMask, grid: _Grid
) -> Iterator[tuple[tuple[int, int], Int[np.ndarray, "k 3"], Points]]:
    """Axis and way; empty voxels beside which such ones lie there, and where the two meet."""
    every = np.argwhere(void)
    for axis in range(3):
        for way in (1, -1):
            step = way * np.eye(3, dtype=np.int64)[axis]
            other = every + step
            there = (other >= 0).all(axis=1) & (other < np.array(void.shape)).all(axis=1)
            there[there] = beside[tuple(other[there].T)]
            index = every[there]
            middle_mm = grid.low_mm + (index + 0.5 * (step + 1)) * grid.voxel_mm
            yield (axis, way), index, middle_mm


def _marked(void: VoxelMask, index: Int[np.ndarray, "k 3"]) -> VoxelMask:
    """Which voxels are numbered so."""
    marked = np.zeros_like(void)
    marked[tuple(index.T)] = True
    return marked


def _along(void: VoxelMask, begins: VoxelMask, axis: int, way: int) -> VoxelMask:
    """What is empty from somewhere on, along an axis."""
    reached = begins & void
    slices = np.moveaxis(reached, axis, 0)[::way]
    empty = np.moveaxis(void, axis, 0)[::way]
    for k in range(1, len(slices)):
        slices[k] |= empty[k] & slices[k - 1]
    return reached


def _cells(
    points_mm: Points, low_mm: Float[np.ndarray, " 3"], voxel_mm: float, shape: tuple[int, ...]
) -> tuple[Int[np.ndarray, "n 3"], Mask]:
    """Voxel of each point, and whether it lies in the box."""
    index = cells_of(points_mm, low_mm, voxel_mm)
    return index, np.asarray(((index >= 0) & (index < np.array(shape))).all(axis=1))
