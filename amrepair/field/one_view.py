"""One view: from which way a bare cloud was seen, if from one, and what of a void lies in view.

Whoever scanned from one way saw what faces that way and has no part of the template before it.
So the share of the template's surface that was seen tells the way, and whether it was one.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from amrepair.arrays import Mask, Points, Vector, VoxelMask
from amrepair.field.near import has_near
from amrepair.field.options import OneViewOptions
from amrepair.field.space import ScannedSpace, VoxelGrid, feet_on, voxels_at
from amrepair.frames import diagonal, spread_directions, unit_vectors
from amrepair.template.port import Template

# A line that grazes a voxel which is solid in part is not blocked by it: half voxels.
SOLID_STEPS = 2
WALL_STEPS = 3


def ways_of_view(
    template: Template,
    surface: tuple[Points, Points, Mask],
    edge_mm: float,
    options: OneViewOptions,
) -> Float[np.ndarray, "k 3"]:
    """(k, 3) unit vectors to where all may have been seen from; none if it was from more sides.

    Parameters
    ----------
    surface
        Places evenly spread on the template's surface, outward unit normals, and which were seen.
    edge_mm
        Beside what was seen, places that lie no farther off count as seen, too.
    """
    step = len(surface[0]) // options.places + 1
    places_mm, normals, seen = (one[::step] for one in surface)
    if not seen.any() or seen.all():
        return np.zeros((0, 3))
    ways = spread_directions(options.ways)
    facing = normals @ ways.T > options.least_facing
    ways = ways[np.argsort(-_told(facing, seen))[: options.tried]]
    told = _told(_in_view(template, places_mm, normals, ways, options), seen)
    if told.max() <= 0.0:
        return np.zeros((0, 3))
    for within in options.finer_rad:
        # of many ways that are as good the one amid them
        best = ways[told >= options.as_good * told.max()].mean(axis=0)
        finer = unit_vectors(best + within * spread_directions(options.finer_ways))
        ways = np.concatenate([ways, finer])
        told = np.append(told, _told(_in_view(template, places_mm, normals, finer, options), seen))
    good = told >= options.as_good * told.max()
    even = good[: options.tried]
    good[options.tried :] &= even.sum() < options.enough_ways  # else those, spread evenly, will do
    places_mm, normals, seen = surface
    in_view = _in_view(template, places_mm, normals, ways[[np.argmax(told)]], options)[:, 0]
    hidden = ~in_view & ~has_near(places_mm, places_mm[in_view], edge_mm)
    if not hidden.any() or seen[hidden].mean() > options.most_hidden_seen:
        return np.zeros((0, 3))
    return ways[good]


def _told(in_view: Bool[np.ndarray, "n k"], seen: Mask) -> Float[np.ndarray, " k"]:
    """How much what is in view tells of what was seen: mutual information, nats a place.

    Negative where less was seen of what is in view than of the rest: it is the way from behind.
    """
    both = np.stack([one.astype(np.float64) @ in_view for one in (~seen, seen)]) / len(seen)
    view = in_view.mean(axis=0)
    joint = np.stack([np.array([[1.0 - seen.mean()], [seen.mean()]]) - both, both], axis=1)
    alone = joint.sum(axis=0, keepdims=True) * joint.sum(axis=1, keepdims=True)
    told = (joint * np.log(np.where(joint > 0, joint / np.maximum(alone, 1e-12), 1.0))).sum((0, 1))
    return np.where(both[1] >= view * seen.mean(), told, -told)


def _in_view(
    template: Template,
    places_mm: Points,
    normals: Points,
    ways: Float[np.ndarray, "k 3"],
    options: OneViewOptions,
) -> Bool[np.ndarray, "n k"]:
    """Which places face each way, with nothing of the template before them."""
    free = normals @ ways.T > options.least_facing
    place, way = np.nonzero(free)
    start_mm = places_mm[place] + options.off_mm * normals[place]
    free[place, way] = is_free(template, start_mm, ways[way], options)
    return free


def is_free(template: Template, points_mm: Points, toward: Points, options: OneViewOptions) -> Mask:
    """Whether a line from each point leaves the template behind: no step longer than it is far off.

    Each step is as long as nothing of the template is near (sphere tracing, Hart 1996). A line that
    has left the template's box, and goes on away from it, has left it for good.
    """
    free = np.ones(len(points_mm), bool)
    low_mm, high_mm = template.bounds_mm
    most_mm = diagonal(template.bounds_mm)
    going, gone_mm = np.arange(len(points_mm)), np.zeros(len(points_mm))
    while len(going):
        way = toward[going]
        at_mm = points_mm[going] + gone_mm[going, None] * way
        left = (at_mm < low_mm) & (way <= 0) | (at_mm > high_mm) & (way >= 0)
        within = ~left.any(axis=1)
        going, at_mm = going[within], at_mm[within]
        if not len(going):
            break
        f_mm = template.distance(at_mm)
        free[going[f_mm < 0]] = False
        gone_mm[going] += np.maximum(f_mm, options.off_mm)
        going = going[(f_mm >= 0) & (f_mm < most_mm) & (gone_mm[going] < most_mm)]
    return free


def is_in_view(
    template: Template, points_mm: Points, ways: Float[np.ndarray, "k 3"], options: OneViewOptions
) -> Mask:
    """Which places near the template's surface are in view from most of the ways."""
    feet_mm, outward = feet_on(template, points_mm)
    return np.asarray(_in_view(template, feet_mm, outward, ways, options).mean(axis=1) >= 0.5)


def ways_past(
    ways: Float[np.ndarray, "k 3"], void: VoxelMask, scan: ScannedSpace, grid: VoxelGrid
) -> Float[np.ndarray, "m 3"]:
    """Those of the ways from which most of what is broken can be seen past what stands.

    None where that is less than half of it from any of them: it was seen from elsewhere. What is
    left of a print that stopped early shows the template's underside and a break that faces up.
    """
    broken_mm, options = scan.broken.place_mm, scan.options.one_view
    some_mm = broken_mm[:: len(broken_mm) // options.places + 1]
    no_wall = np.zeros_like(void)
    share = np.array([_toward(way, void, no_wall, grid, some_mm)[0].mean() for way in ways])
    if share.max() < options.least_past:
        return np.zeros((0, 3))
    return ways[share >= options.as_good * share.max()]


def in_view_from(
    way: Vector, void: VoxelMask, scan: ScannedSpace, grid: VoxelGrid
) -> tuple[Int[np.ndarray, "n 3"], Points, Points, Mask]:
    """Empty voxels that lie in view from a way, and where their lines of sight leave the void.

    A line ends at scanned surface that it meets squarely, whatever the labels say of what is
    behind.

    Returns
    -------
    index
        (n, 3) the voxels.
    mouth_mm, end_mm
        (n, 3) where the line leaves the void toward the scanner, and where it ends or leaves it on
        the other side.
    through
        (n,) whether it goes on in air there, and does not end at something solid.
    """
    broken, options = scan.broken, scan.options.one_view
    squarely = np.abs(broken.plane @ way) > options.squarely
    index, ok = voxels_at(broken.place_mm[squarely], grid.low_mm, grid.voxel_mm, void.shape)
    wall = np.zeros_like(void)
    wall[tuple(index[ok].T)] = True
    every = np.argwhere(void)
    middle_mm = grid.low_mm + (every + 0.5) * grid.voxel_mm
    free, mouth_mm = _toward(way, void, wall, grid, middle_mm)
    out_mm = _out_of_box(mouth_mm[free] + options.off_mm * way, way, grid)
    free[free] = is_free(scan.template, out_mm, np.broadcast_to(way, out_mm.shape), options)
    through, end_mm = _away(-way, void, wall, grid, middle_mm[free])
    return every[free], mouth_mm[free], end_mm, through


def _toward(
    way: Vector, void: VoxelMask, wall: VoxelMask, grid: VoxelGrid, from_mm: Points
) -> tuple[Mask, Points]:
    """Which lines meet nothing solid in the box, and where each first leaves the void."""
    solid = (grid.f_mm < 0) & ~void
    free, left_mm = np.ones(len(from_mm), bool), from_mm.copy()
    hits, going = np.zeros(len(from_mm), np.int64), np.arange(len(from_mm))
    within = np.ones(len(from_mm), bool)
    step, step_mm = 0, 0.5 * grid.voxel_mm
    while len(going):
        step += 1
        at_mm = from_mm[going] + step * step_mm * way
        index, ok = voxels_at(at_mm, grid.low_mm, grid.voxel_mm, void.shape)
        at = tuple(index[ok].T)
        first = within[going]
        first[ok] &= ~void[at]
        left_mm[going[first]] = at_mm[first]
        within[going[first]] = False
        # what lies at a wall or just in it is not behind it
        hits[going[ok]] += solid[at] | (wall[at] & (step > WALL_STEPS))
        free[going] = hits[going] < SOLID_STEPS
        going = going[ok & free[going]]
    return free, left_mm


def _away(
    way: Vector, void: VoxelMask, wall: VoxelMask, grid: VoxelGrid, from_mm: Points
) -> tuple[Mask, Points]:
    """Which lines leave the void into air, and where each leaves it or meets scanned surface."""
    air = grid.f_mm >= 0
    through, end_mm = np.zeros(len(from_mm), bool), from_mm.copy()
    going, step = np.arange(len(from_mm)), 0
    while len(going):
        step += 1
        end_mm[going] = from_mm[going] + 0.5 * step * grid.voxel_mm * way
        index, ok = voxels_at(end_mm[going], grid.low_mm, grid.voxel_mm, void.shape)
        at = tuple(index[ok].T)
        through[going] = True
        through[going[ok]] = air[at]
        on = ok.copy()
        on[ok] = void[at] & ~wall[at]
        going = going[on]
    return through, end_mm


def _out_of_box(from_mm: Points, way: Vector, grid: VoxelGrid) -> Points:
    """Where lines leave the box of the voxels."""
    high_mm = grid.low_mm + np.array(grid.f_mm.shape) * grid.voxel_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        along_mm = np.where(way > 0, high_mm - from_mm, grid.low_mm - from_mm) / way
    along_mm = np.where(np.abs(way) < 1e-9, np.inf, along_mm).min(axis=1)
    return np.asarray(from_mm + np.maximum(along_mm, 0.0)[:, None] * way)
