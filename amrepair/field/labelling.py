"""What it costs to call voxels solid or empty, and which way broken surface must face for that."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from amrepair.arrays import Mask, Numbers, Points, Values
from amrepair.field.minimum_cut import Facets, MinimumCut
from amrepair.field.near import has_near, nearest_within
from amrepair.field.options import OccupancyOptions
from amrepair.field.space import Broken, ScannedSpace, VoxelGrid, feet_on
from amrepair.frames import unit_vectors

# So often at most ways are tried again for what faces no way yet.
MOST_ROUNDS = 3
# Any surface faces one of the axes by 1/√3 at least.
LEAST_FACING = 0.57


@dataclass(frozen=True, slots=True)
class WatchedSurface:
    """Places on surface that is there or should be, and whether the scan saw them.

    Attributes
    ----------
    outward, seen, area_mm2
        Unit normals of the places, whether each was seen, and the area that it stands for.
    """

    outward: Points
    seen: Mask
    area_mm2: Values

    def and_broken(
        self, broken: Broken, side: Float[np.ndarray, " q"], spacing_mm: float
    ) -> WatchedSurface:
        """With the scanned surface that is not the template's, where its open side is known."""
        known = side != 0
        outward = side[known, None] * broken.plane[known]
        return WatchedSurface(
            np.concatenate([self.outward, outward]),
            np.append(self.seen, np.ones(len(outward), bool)),
            np.append(self.area_mm2, np.full(len(outward), spacing_mm**2)),
        )


@dataclass(frozen=True, slots=True)
class OpenSides:
    """Voxels ahead of broken surface and behind it, along its planes' normals.

    Surface has solid on one side and nothing on the other. A place with the same on both is a
    stray, at its price. A cut cannot say "one side or the other", but it can be told which.

    Attributes
    ----------
    plane
        (q, 3) unit normals of the places' planes; nobody knows which way they look.
    ahead, behind
        (q,) number of the voxel on each side; −1 is air.
    price
        Of a stray, nats.
    """

    plane: Points
    ahead: Numbers
    behind: Numbers
    price: float

    @classmethod
    def of(cls, scan: ScannedSpace, grid: VoxelGrid) -> OpenSides:
        """Of broken surface, a voxel's edge ahead and behind."""
        broken, options = scan.broken, scan.options
        ahead, behind = (
            grid.numbers_at(broken.place_mm + way * grid.voxel_mm * broken.plane)
            for way in (1.0, -1.0)
        )
        # of a wide facet's many places together no more is known than of a facet that nobody saw
        most = -np.log1p(-options.largest_cover) / scan.points_on_facet(grid.voxel_mm)
        return cls(broken.plane, ahead, behind, float(min(-np.log(options.stray), most)))

    def proposals(self) -> Iterator[Float[np.ndarray, " q"]]:
        """(q,) sides that may be open, along each axis and against it; 0 of those across it."""
        for axis in range(3):
            along = self.plane[:, axis]
            side = np.where(np.abs(along) > LEAST_FACING, np.sign(along), 0.0)
            yield from (side, -side)

    def told(self, side: Float[np.ndarray, " q"], count: int) -> Values:
        """(v,) what places say of the voxels ahead of them and behind, if such sides are open."""
        told = np.zeros(count)
        for beside, solid in ((self.ahead, -side), (self.behind, side)):
            at = beside >= 0
            told += self.price * np.bincount(beside[at], solid[at], minlength=count)
        return told


@dataclass(frozen=True, slots=True)
class Labelling:
    """The search for the most probable labelling of a grid of voxels as solid or empty.

    Attributes
    ----------
    scan, grid, facets
        The scan around broken surface, the voxels, and where two of them meet.
    watched
        The template's surface, by which it is told how much was seen of what faces a way.
    unexplained
        (k,) how little the scan's points explain a facet, whichever way broken surface faces:
        0 where points lie on it, 1 where none is near.
    beside
        (v,) how many points of the template's surface lie at each voxel: `points_beside`.
    """

    scan: ScannedSpace
    grid: VoxelGrid
    facets: Facets
    watched: WatchedSurface
    unexplained: Values
    beside: Float[np.ndarray, " v"]

    def empty(self) -> Mask:
        """(v,) what is empty by the cheapest of the labellings that are tried.

        A first one says which way broken surface faces, but not of all: it costs nothing to leave
        some within what is solid, or in mid-air. If that is more than lies around a bead, ways are
        tried, until what is left of it is less or no way is cheaper.
        """
        scan, sides = self.scan, OpenSides.of(self.scan, self.grid)
        least = np.pi * scan.options.bead_mm**2 / scan.spacing_mm**2
        told = unknown = np.zeros(len(sides.ahead))
        first = MinimumCut.of(self.facets, self._nats(unknown, unknown), self._told())
        nats, empty = self._facing(told, self._open_side(first.empty), first, sides)
        for _ in range(MOST_ROUNDS):
            known, before_nats, best = self._open_side(empty), nats, told
            for proposed in sides.proposals():
                if np.count_nonzero(proposed[known == 0]) < least:
                    continue
                # what the labelling before took for the way of the others may be as wrong
                tried = np.where(proposed != 0, proposed, told)
                cost, labels = self._facing(tried, known, first, sides)
                if cost < nats:
                    nats, empty, best = cost, labels, tried
            if nats == before_nats:
                break
            told = best
        return empty

    def _told(self) -> Float[np.ndarray, " v"]:
        """(v,) what is known of each voxel by itself, nats: positive solid, negative empty.

        As designed, a little; behind a point on the template's surface solid and before it empty,
        but for strays; and beyond the box as designed.
        """
        scan, grid, inside = self.scan, self.grid, self.grid.is_inside
        deep_mm = scan.options.deep_extents * float(np.ptp(scan.template.bounds_mm, axis=0).max())
        facet = scan.points_on_facet(grid.voxel_mm)
        told = np.where(inside, 1.0, -1.0) * grid.voxel_mm / deep_mm
        told -= np.log(scan.options.stray) * self.beside
        for axis in range(3):
            for end in (0, -1):
                face = np.take(grid.number, end, axis=axis)
                outer = (-1, grid.number.shape[axis])[end]
                at = np.insert(np.argwhere(face >= 0), axis, outer, axis=1)
                beyond = scan.template.distance(grid.low_mm + (at + 0.5) * grid.voxel_mm) < 0
                face = face[face >= 0]
                same = beyond == inside[face]  # else the template's surface lies between
                told[face[same]] += np.where(beyond[same], facet, -facet)
        return told

    def _open_side(self, empty: Mask) -> Float[np.ndarray, " q"]:
        """(q,) on which side of broken surface space is empty, 1 ahead and −1 behind; else 0."""
        return np.asarray(np.sign(self.grid.labelled(empty).open_side(self.scan.broken)))

    def _facing(
        self,
        told: Float[np.ndarray, " q"],
        known: Float[np.ndarray, " q"],
        first: MinimumCut,
        sides: OpenSides,
    ) -> tuple[float, Mask]:
        """Cost and labels of the cheapest labelling if broken surface faces so.

        Parameters
        ----------
        told
            (q,) open sides that are tried: the places say that space is solid behind them and
            empty ahead.
        known
            (q,) open sides by the labelling before: these places count as surface that was seen.
        """
        nats = self._nats(told, np.where(told != 0, told, known))
        cut = first.dearer(nats, first.told + sides.told(told, len(first.told)))
        strays = np.count_nonzero(self._open_side(cut.empty) == 0)
        alone = float(first.told[cut.empty].sum())
        return cut.surface_nats(cut.empty) + alone + sides.price * strays, cut.empty

    def _nats(
        self, side: Float[np.ndarray, " q"], cover: Float[np.ndarray, " q"]
    ) -> Float[np.ndarray, "k 2"]:
        """What facets cost if broken surface is open on such sides, and seen on others."""
        scan, grid = self.scan, self.grid
        unexplained = _unexplained_facing(self.unexplained, scan, self.facets, grid.voxel_mm, side)
        watched = self.watched.and_broken(scan.broken, cover, scan.spacing_mm)
        return _nats(self.facets, unexplained, watched, scan, grid)


def _nats(
    facets: Facets,
    unexplained: Float[np.ndarray, "k 2"],
    watched: WatchedSurface,
    scan: ScannedSpace,
    grid: VoxelGrid,
) -> Float[np.ndarray, "k 2"]:
    """What facets cost that the scan does not explain, by which of their voxels is solid.

    It saw of all surface that faces this way such a share: as probably it would have seen this,
    with as many points as its area holds at the scan's density.
    """
    ways = np.stack([np.eye(3), -np.eye(3)], axis=1).reshape(-1, 3)
    options, area_mm2 = scan.options, watched.area_mm2
    cover = cover_of(ways, watched.outward, area_mm2, watched.seen * area_mm2, options)
    points = scan.points_on_facet(grid.voxel_mm)
    chance = np.minimum(cover, options.largest_cover) * (1.0 - np.exp(-points))
    return np.asarray(-np.log1p(-chance).reshape(3, 2)[facets.axis] * unexplained)


def cover_of(
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


def unexplained(scan: ScannedSpace, facets: Facets, voxel_mm: float) -> Values:
    """(k,) 0 where scanned points lie on a facet, 1 where none does.

    On the template's surface its own points count, elsewhere those of what is broken.
    """
    share = np.ones(len(facets.one))
    on, off = np.flatnonzero(facets.on_template), np.flatnonzero(~facets.on_template)
    share[on] = ~scan.sees(feet_on(scan.template, facets.middle_mm[on])[0])
    share[off] = _farness(facets.middle_mm[off], scan.broken.place_mm, scan.width_mm(voxel_mm))
    return share


def _unexplained_facing(
    share: Values,
    scan: ScannedSpace,
    facets: Facets,
    voxel_mm: float,
    side: Float[np.ndarray, " q"],
) -> Float[np.ndarray, "n 2"]:
    """The same where it is known which way some points face, by which of its voxels is solid.

    Nobody sees surface from the solid's side: a point explains no facet that faces away from its
    open side.
    """
    both = np.stack([share, share], axis=1)
    outward, width_mm = side[:, None] * scan.broken.plane, scan.width_mm(voxel_mm)
    for axis in range(3):
        near = np.flatnonzero(~facets.on_template & (facets.axis == axis) & (share < 1.0))
        for solid, way in ((0, 1.0), (1, -1.0)):
            explains = way * outward[:, axis] > -LEAST_FACING
            if not explains.all():  # else it is as little explained as by all of them
                places_mm = scan.broken.place_mm[explains]
                both[near, solid] = _farness(facets.middle_mm[near], places_mm, width_mm)
    return both


def _farness(
    middle_mm: Float[np.ndarray, "m 3"], places_mm: Points, width_mm: float
) -> Float[np.ndarray, " m"]:
    """How much less than surely a facet is one of the places' surface: 0 at one, 1 far off."""
    far = np.ones(len(middle_mm))
    nearest = nearest_within(middle_mm, places_mm, 1.4 * width_mm)
    found = nearest >= 0
    apart_mm = np.linalg.norm(middle_mm[found] - places_mm[nearest[found]], axis=1)
    far[found] = -np.expm1(-((apart_mm / width_mm) ** 4))
    return far


def points_beside(scan: ScannedSpace, grid: VoxelGrid) -> Float[np.ndarray, " v"]:
    """(v,) how many points of the template's surface lie at each voxel: negative of those outside.

    Points within a voxel of broken surface tell nothing: voxels there are solid in part.
    """
    inside = grid.is_inside
    beside = np.zeros(len(inside))
    on_mm = scan.on_mm[~has_near(scan.on_mm, scan.broken.place_mm, grid.voxel_mm)]
    f_mm, gradient = scan.template.distance_and_gradient(on_mm)
    outward = unit_vectors(gradient)
    for way in (-0.5, 0.5):
        number = grid.numbers_at(on_mm + (way * grid.voxel_mm - f_mm)[:, None] * outward)
        number = number[number >= 0]
        number = number[inside[number] == (way < 0)]
        beside -= np.sign(way) * np.bincount(number, minlength=len(beside))
    return beside
