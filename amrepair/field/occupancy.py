"""Occupancy: which space around broken surface is solid, as the most probable labelling of voxels.

Where solid meets empty there is surface. Along points of the scan it costs nothing; elsewhere as
much as it is improbable that nobody saw it. The cheapest labelling is a minimum cut (Hornung &
Kobbelt 2006; Labatut, Pons & Keriven 2009). It needs neither rays nor normals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy import fft, ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree

from amrepair.arrays import Mask, Points, VoxelMask
from amrepair.field.groups import area_per_point
from amrepair.field.labelling import (
    LEAST_FACING,
    Labelling,
    WatchedSurface,
    cover_of,
    points_beside,
    unexplained,
)
from amrepair.field.minimum_cut import facets_of
from amrepair.field.near import has_near
from amrepair.field.one_view import in_view_from, is_in_view, ways_of_view, ways_past
from amrepair.field.options import OccupancyOptions
from amrepair.field.space import (
    Broken,
    Occupancy,
    ScannedSpace,
    VoxelGrid,
    box_about,
    feet_on,
    grid_over,
    voxels_at,
)
from amrepair.frames import in_box, spread_directions
from amrepair.template.port import Template

# Ways that surface can face, 9° apart.
FACED_WAYS = 500


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
    scan = ScannedSpace(template, broken, on_mm, spacing_mm, options)
    bare = ~has_near(places_mm, on_mm, options.gap_spacings * spacing_mm)
    box_mm = box_about(scan, places_mm[bare])
    grid = grid_over(scan, box_mm)
    seen = scan.sees(places_mm)
    watched = WatchedSurface(normals, seen, np.full(len(seen), area_per_point(places_mm)))
    scan = replace(scan, on_mm=on_mm[in_box(on_mm, *box_mm)])
    facets = facets_of(grid)
    beside = points_beside(scan, grid)
    sought = Labelling(
        scan, grid, facets, watched, unexplained(scan, facets, grid.voxel_mm), beside
    )
    solid = grid.labelled(sought.empty()).solid
    found = _as_seen(solid, scan, grid)
    found &= ~_held_by_strays(found, beside, scan, grid)
    found |= _guessed(found, (*surface, seen), replace(scan, on_mm=on_mm), grid)
    return Occupancy(grid.low_mm, grid.voxel_mm, found, grid.f_mm < 0)


def _hidden(normals: Points, seen: Mask, gone: Mask, options: OccupancyOptions) -> Mask:
    """Places that nobody saw, where most surface that faces as they do was not seen either.

    What is known to be `gone` counts for neither.
    """
    ways = spread_directions(FACED_WAYS)
    of = cKDTree(ways).query(normals)[1]
    every, looked = (np.bincount(of, which, FACED_WAYS) for which in (~gone, seen & ~gone))
    cover = cover_of(ways, ways, every.astype(np.float64), looked, options)
    return np.asarray(~seen & ~gone & (cover[of] < options.hidden_cover))


def _as_seen(solid: VoxelMask, scan: ScannedSpace, grid: VoxelGrid) -> VoxelMask:
    """The same, but as designed where too little that is broken bounds what differs.

    What hides a part of the surface hides all of it at once, so that no number of unseen places is
    evidence of a void. A void that takes an area M of the template's surface has a broken edge: if
    it goes right through, around M/2, at least as long as a circle's and a bead thick. Where it
    meets what stands in less than that, as half of a frame does, that much was broken.
    """
    found, designed = solid.copy(), grid.f_mm < 0
    index, ok = voxels_at(scan.broken.place_mm, grid.low_mm, grid.voxel_mm, solid.shape)
    at = tuple(index[ok].T)
    cross = ndimage.generate_binary_structure(3, 1)
    for differs in (designed & ~solid, solid & ~designed):
        # of a wall hardly thicker than a voxel some touch only along edges and at corners
        groups, count = ndimage.label(differs, structure=np.ones((3, 3, 3), bool))
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
            ends = np.zeros(solid.shape, np.int64)
            for _, index, _ in _facets_toward(differs, designed & solid, grid):
                ends[tuple(index.T)] += 1
            end_mm2 = np.bincount(groups[differs], ends[differs], count + 1) * grid.voxel_mm**2
            least_mm2 = scan.options.least_seen * np.minimum(
                scan.options.bead_mm * around_mm, end_mm2
            )
        alone = differs & ~((broken_mm2 > 0) & (broken_mm2 >= least_mm2))[groups]
        found[alone] = designed[alone]
    return found


def _held_by_strays(
    solid: VoxelMask, beside: Float[np.ndarray, " v"], scan: ScannedSpace, grid: VoxelGrid
) -> VoxelMask:
    """Lumps in the template that hang together with nothing else, and are no larger than a stray.

    Where a part is gone some points stray to where its surface was. Each holds a voxel, but makes
    no surface: on that half as many points as expected lie at least.
    """
    points = np.zeros(solid.shape)
    points[grid.number >= 0] = beside
    few = 0.5 * scan.points_on_facet(grid.voxel_mm)
    every = np.ones((3, 3, 3), bool)
    stray = ndimage.binary_dilation((points > 0) & (points < few), every)
    lump, count = ndimage.label((grid.f_mm < 0) & solid, every)
    larger = np.zeros(count + 1, bool)
    larger[lump[~stray]] = True
    for axis in range(3):  # beyond the box it may go on
        larger[np.take(lump, (0, -1), axis=axis)] = True
    return ~larger[lump] & (lump > 0)


def _guessed(
    solid: VoxelMask, surface: tuple[Points, Points, Mask], scan: ScannedSpace, grid: VoxelGrid
) -> VoxelMask:
    """What is said to be empty, though its end nearest by was not scanned and nobody looked in.

    The cheapest labelling ends a void at the smallest surface that closes it: a dent at the rim of
    a dome that nobody saw would take the dome along. What an end hides is no deeper than it is
    wide.

    Parameters
    ----------
    surface
        Places on the template, outward unit normals, and whether they were seen.
    """
    designed = grid.f_mm < 0
    void = designed & ~solid
    ends, scanned = np.zeros_like(void), {}
    width_mm = scan.width_mm(grid.voxel_mm)
    facets = list(_facets_toward(void, designed & solid, grid))
    for side, index, middle_mm in facets:
        ends |= _marked(void, index)
        scanned[side] = _marked(void, index[_is_scanned(middle_mm, width_mm, scan)])
    if not ends.any():
        return np.zeros_like(void)
    edge_mm = 1.5 * scan.options.seen_spacings * scan.spacing_mm
    ways = ways_of_view(scan.template, surface, edge_mm, scan.options.one_view)
    if len(ways):
        ways = ways_past(ways, void, scan, grid)
    if len(ways):
        hull = _hull_of(scan)
        in_view = _in_one_view(void, ways, hull, scan, grid)
        in_view |= _looked_into(void, facets, scanned, surface, ways, hull, scan, grid)
        return void & ~in_view
    (box,) = ndimage.find_objects(void.astype(np.int8))
    # a gap in what was scanned of an end, no wider than points are asked for, is chance
    across = 2 * math.ceil(width_mm / grid.voxel_mm) + 1
    known, every = (
        ndimage.uniform_filter(one[box].astype(np.float32), across, mode="constant")
        for one in (np.logical_or.reduce([*scanned.values()]), ends)
    )
    guess = ends[box] & (known < 0.5 * every)
    if not guess.any():
        return np.zeros_like(void)
    to_known, to_guess = (
        ndimage.distance_transform_edt(~one) if one.any() else np.full(one.shape, np.inf)
        for one in (ends[box] & ~guess, guess)
    )
    guessed = void.copy()
    # past the border of what was scanned of an end both are as near, as far as its points tell it
    guessed[box] &= to_guess < to_known + width_mm / grid.voxel_mm
    if guessed.any():
        least = np.float32(scan.options.unscanned_share)
        guessed[box] &= _as_it_looks(guess - least * ends[box]) > 0
    if guessed.any():
        hull = _hull_of(scan)
        guessed &= ~_looked_into(void, facets, scanned, surface, ways, hull, scan, grid)
    return guessed


def _as_it_looks(weight: Float[np.ndarray, "x y z"]) -> Float[np.ndarray, "x y z"]:
    """Sum of all weights at 1/r³: of a plane's that is their share of what is seen of it.

    For of a plane at a height h an area appears h/r³ large, and h is the same for all.
    """
    shape = [fft.next_fast_len(2 * n - 1, real=True) for n in weight.shape]
    x, y, z = (np.minimum(np.arange(n), n - np.arange(n)).astype(np.float32) ** 2 for n in shape)
    square = 0.25 + x[:, None, None] + y[:, None] + z  # an end lies half a voxel beyond its middle
    sums = fft.irfftn(fft.rfftn(weight, shape) * fft.rfftn(square ** np.float32(-1.5)), shape)
    return np.asarray(sums[tuple(map(slice, weight.shape))])


def _is_scanned(end_mm: Points, width_mm: float, scan: ScannedSpace) -> Mask:
    """(n,) whether a void's ends were scanned, as broken surface or as the back of a film."""
    broken = has_near(end_mm, scan.broken.place_mm, width_mm)
    # a film's inner side may be told from the template's surface by no point
    feet_mm, _ = feet_on(scan.template, end_mm)
    film = np.linalg.norm(end_mm - feet_mm, axis=1) < width_mm
    return np.asarray(broken | (film & scan.sees(feet_mm)))


def _in_one_view(
    void: VoxelMask,
    ways: Float[np.ndarray, "k 3"],
    hull: Float[np.ndarray, "h 4"],
    scan: ScannedSpace,
    grid: VoxelGrid,
) -> VoxelMask:
    """What is empty and in view, as far as to an end that was scanned, from most of the ways.

    Through a face that a way grazes nobody knows what would have been seen: it says nothing.
    """
    width_mm = scan.width_mm(grid.voxel_mm)
    known_from, told_from = np.zeros(void.shape, np.int64), np.zeros(void.shape, np.int64)
    options = scan.options
    for way in ways:
        index, mouth_mm, end_mm, through = in_view_from(way, void, scan, grid)
        # where nothing was scanned behind it the scanner's view may have ended
        known = through & _amid(mouth_mm, hull, options.hole_mm)
        known |= _is_scanned(end_mm, width_mm, scan)
        told = feet_on(scan.template, mouth_mm)[1] @ way > options.one_view.least_facing
        known_from[tuple(index[known & told].T)] += 1
        told_from += 1
        told_from[tuple(index[known & ~told].T)] -= 1
    return (known_from > 0) & (2 * known_from >= told_from)


def _looked_into(
    void: VoxelMask,
    facets: list[tuple[tuple[int, int], Int[np.ndarray, "j 3"], Float[np.ndarray, "j 3"]]],
    scanned: dict[tuple[int, int], VoxelMask],
    surface: tuple[Points, Points, Mask],
    ways: Float[np.ndarray, "k 3"],
    hull: Float[np.ndarray, "h 4"],
    scan: ScannedSpace,
    grid: VoxelGrid,
) -> VoxelMask:
    """What is empty straight below template surface that would have been seen, were it there, as
    far as to an end that was scanned (by axis and way), or right through.

    What hides a part of the surface ends not just where its faces meet: what lies beside hidden
    surface, and does not face away from it, may be hidden, too. Nor would surface have been seen
    beyond all that was: there the scanner's view may have ended.

    Parameters
    ----------
    facets
        Where the void ends at what stands, as `_facets_toward` tells it.
    """
    places_mm, normals, seen = surface
    within_mm = scan.options.seen_spacings * scan.spacing_mm + grid.voxel_mm
    mouths, looked = {}, np.zeros_like(void)
    sides = list(_facets_toward(void, grid.f_mm >= 0, grid))
    gone = np.zeros_like(seen)
    if not len(ways):  # one view looked its own way, not straight down
        gone = _seen_through(void, facets, sides, surface, within_mm, scan, grid)
    hidden = _hidden(normals, seen, gone, scan.options)
    for (axis, way), index, middle_mm in sides:
        toward = hidden & (way * normals[:, axis] > -scan.options.way_cosine)
        known = way * feet_on(scan.template, middle_mm)[1][:, axis] > LEAST_FACING
        known &= ~has_near(middle_mm, places_mm[toward], within_mm)
        known[known] = _amid(middle_mm[known], hull, scan.options.hole_mm)
        if len(ways):
            known[known] = is_in_view(scan.template, middle_mm[known], ways, scan.options.one_view)
        mouths[axis, way] = _marked(void, index), _marked(void, index[known])
    for (axis, way), (_, known) in mouths.items():
        through, _ = mouths[axis, -way]
        found = through | scanned[axis, -way]
        looked |= _along(void, known, axis, -way) & _along(void, found, axis, way)
    return looked


def _seen_through(
    void: VoxelMask,
    facets: list[tuple[tuple[int, int], Int[np.ndarray, "j 3"], Float[np.ndarray, "j 3"]]],
    sides: list[tuple[tuple[int, int], Int[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]],
    surface: tuple[Points, Points, Mask],
    within_mm: float,
    scan: ScannedSpace,
    grid: VoxelGrid,
) -> Mask:
    """(m,) places straight over broken surface that faces them, a void between: they are gone."""
    places_mm, normals, seen = surface
    gone, mouths = np.zeros_like(seen), {side: (index, at_mm) for side, index, at_mm in sides}
    faced, width_mm = np.abs(scan.broken.plane) > LEAST_FACING, scan.width_mm(grid.voxel_mm)
    for (axis, way), index, middle_mm in facets:
        told = has_near(middle_mm, scan.broken.place_mm[faced[:, axis]], width_mm)
        over = _along(void, _marked(void, index[told]), axis, -way)
        mouth, mouth_mm = mouths[axis, -way]
        facing = np.flatnonzero(-way * normals[:, axis] > LEAST_FACING)
        gone[facing] |= has_near(places_mm[facing], mouth_mm[over[tuple(mouth.T)]], within_mm)
    return gone


def _amid(points_mm: Points, hull: Float[np.ndarray, "h 4"], beyond_mm: float) -> Mask:
    """Which points lie in a convex hull, by the planes of its faces, or hardly beyond it."""
    amid = np.ones(len(points_mm), bool)
    for face in hull:
        amid[amid] = points_mm[amid] @ face[:3] + face[3] < beyond_mm
    return amid


def _hull_of(scan: ScannedSpace) -> Float[np.ndarray, "h 4"]:
    """Planes of the faces of what holds all scanned points: outward unit normals, and offsets.

    A hull of none, if they lie in a plane.
    """
    try:
        return np.asarray(ConvexHull(np.concatenate([scan.on_mm, scan.broken.place_mm])).equations)
    except QhullError:
        return np.array([[0.0, 0.0, 0.0, np.inf]])


def _facets_toward(
    void: VoxelMask, beside: VoxelMask, grid: VoxelGrid
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
