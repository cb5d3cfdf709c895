# mypy: disable-error-code="no-untyped-def"
"""Where a strand finds hold: on what lies below, beside its own kind, over a gap, or nowhere.

Looks at columns and moves nothing. A strand is *held* where enough of the nozzle's bore has solid
within one and a half layers, or where solid of the same level lies beside it. A stretch
that is not held hangs between two ends that are (a bridge, which sags as the square of its
length), droops from the one that is (a cantilever), or falls onto what lies below.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from amrepair.simulate.columns_kernels import Stacks, surface_below
from gcode.compiled import njit

HELD_LAYERS = 1.5  # as deep below the nozzle as a layer's own underside, and half as much again
HELD_SHARE = 0.15  # of the columns under the bore: an overhanging wall still lies on a sixth
SIDE_SHARE = 0.75  # of a layer that solid beside a strand must reach up to hold it
ON_SPOT_LAYERS = 4.0  # what is pushed out on one spot hangs down as a drop
LONGEST_MM = 150.0  # farther than this no end is looked for: nothing bridges so much
NO_ANCHOR, AT_START, AT_END, AT_BOTH = 0, 1, 2, 3


class StandingColumns(NamedTuple):
    """The columns, and what the layer that is being laid found in each it has touched.

    `before` (ny, nx) is the column's top before the layer whose number is in `stamp` (ny, nx).
    """

    stacks: Stacks
    before: Any
    stamp: Any


class Head(NamedTuple):
    """The nozzle and how its strands behave.

    `near` (phases², n, 2): columns around the nozzle by distance, for each place of its axis within
    a column; `counts` (phases², 4): how many lie under the bore, in its reach, under the flat, and
    where plastic spreads. `grid` is (origin x, y, cell), mm.
    """

    near: Any
    counts: Any
    phases: Any
    grid: Any
    step_mm: Any
    bridges: Any  # columns that a strand spans without pressure
    planes: Any  # layers that the flat planes off
    carry_limit: Any  # mm of column that ride along
    swell: Any  # of the die, as a ratio
    sag: Any  # of a bridge, per mm
    droop: Any  # of a cantilever, per mm
    beside: Any  # mm to a neighbour: the bore
    pools: Any  # layers that plastic pools over
    thermal: Any  # see `lifted`


class Path(NamedTuple):
    """Segments in order: ends (n, 3), plastic / mm³, thickness / mm; regions that change flow."""

    start: Any
    end: Any
    volume: Any
    thickness: Any
    regions: Any


@njit(cache=True, nogil=True, inline="always")
def reaches(hi, before, stamp, layer, iy, ix, level):
    """Whether a column was as high as `level` before the layer that is being laid."""
    if stamp[iy, ix] == layer:
        return before[iy, ix] >= level
    return hi[iy, ix] >= level


@njit(inner=True, cache=True, nogil=True)
def groove_columns(hi, before, stamp, layer, iy, ix, level, most):
    """Width, in columns, of a groove between solid that reaches `level`; 0: wider than `most`."""
    ny, nx = hi.shape
    best = 0
    for d in range(4):
        dy, dx = (1 if d == 3 else d - 1), (1 if d < 3 else 0)  # NE, E, SE, N
        width = most if dx * dy == 0 else int(most / 1.4142)
        ahead = 0
        for j in range(1, width + 1):
            y, x = iy + j * dy, ix + j * dx
            if y < 0 or x < 0 or y >= ny or x >= nx:
                break
            if reaches(hi, before, stamp, layer, y, x, level):
                ahead = j
                break
        if ahead == 0:
            continue
        for j in range(1, width - ahead + 2):
            y, x = iy - j * dy, ix - j * dx
            if y < 0 or x < 0 or y >= ny or x >= nx:
                break
            if reaches(hi, before, stamp, layer, y, x, level):
                if best == 0 or ahead + j - 1 < best:
                    best = ahead + j - 1
                break
    return best


@njit(inner=True, cache=True, nogil=True)
def found_below(hi, lo, nxt, pool, pool_next, before, stamp, layer, iy, ix, z):
    """Highest solid at or below z that the layer being laid has found: not the strand itself."""
    if stamp[iy, ix] == layer and before[iy, ix] <= z:
        return before[iy, ix]
    return surface_below(hi, lo, nxt, pool, pool_next, iy, ix, z)


@njit(inner=True, cache=True, nogil=True)
def is_held(world, head, layer, x, y, z, ux, uy, thickness):
    """Whether a strand at (x, y, z) that runs along (ux, uy) finds solid under or beside it."""
    (hi, lo, nxt, pool, pool_next, _), before, stamp = world
    near, counts, phases, grid = head.near, head.counts, head.phases, head.grid
    ny, nx = hi.shape
    gx, gy = (x - grid[0]) / grid[2], (y - grid[1]) / grid[2]
    cx, cy = int(np.floor(gx)), int(np.floor(gy))
    if cx < 0 or cy < 0 or cx >= nx or cy >= ny:
        return True
    phase = int((gy - cy) * phases) * phases + int((gx - cx) * phases)
    bore = counts[phase, 0]
    need = max(1, int(HELD_SHARE * bore + 0.5))
    for k in range(bore):
        iy, ix = cy + near[phase, k, 0], cx + near[phase, k, 1]
        if iy < 0 or ix < 0 or iy >= ny or ix >= nx:
            continue
        below = found_below(hi, lo, nxt, pool, pool_next, before, stamp, layer, iy, ix, z)
        if z - below <= HELD_LAYERS * thickness:
            need -= 1
            if need == 0:
                return True
    for side in (-1.0, 1.0):
        ix = int(np.floor(gx - side * uy * head.beside / grid[2]))
        iy = int(np.floor(gy + side * ux * head.beside / grid[2]))
        if iy < 0 or ix < 0 or iy >= ny or ix >= nx:
            continue
        below = surface_below(hi, lo, nxt, pool, pool_next, iy, ix, z)
        if below > z - (1.0 - SIDE_SHARE) * thickness:
            return True
    return False


@njit(inner=True, cache=True, nogil=True)
def run_ahead(world, head, layer, path, s, k):
    """From step k of segment s on: length to the next place that holds, and whether there is one.

    A stretch ends where the path is broken off, by a travel or with the motion itself.
    """
    start, end, volume = path.start, path.end, path.volume
    length = 0.0
    while True:
        dx, dy, dz = end[s, 0] - start[s, 0], end[s, 1] - start[s, 1], end[s, 2] - start[s, 2]
        long = np.sqrt(dx * dx + dy * dy + dz * dz)
        steps = max(1, int(np.ceil(long / head.step_mm)))
        flat = max(np.sqrt(dx * dx + dy * dy), 1e-9)
        for m in range(k, steps):
            t = (m + 0.5) / steps
            x, y = start[s, 0] + t * dx, start[s, 1] + t * dy
            z = start[s, 2] + t * dz
            lifted_z = z - lifted(head.thermal, x, y, z)
            if is_held(world, head, layer, x, y, lifted_z, dx / flat, dy / flat, path.thickness[s]):
                return length, True
            length += long / steps
            if length > LONGEST_MM:
                return length, False
        following = s + 1
        if (
            following >= len(volume)
            or volume[following] <= 0.0
            or start[following, 0] != end[s, 0]
            or start[following, 1] != end[s, 1]
            or start[following, 2] != end[s, 2]
        ):
            return length, False
        s, k = following, 0


@njit(cache=True, nogil=True, inline="always")
def lifted(thermal, x, y, z):
    """How far the part has curled up at (x, y) when the nozzle is at height z.

    `thermal` is (middle x, y, curl / mm, height held / mm, share of the curl or, below 0, as the
    height has it).
    """
    if thermal[2] == 0.0:
        return 0.0
    share = thermal[4] if thermal[4] >= 0.0 else 1.0 - np.exp(-z / thermal[3])
    return thermal[2] * share * ((x - thermal[0]) ** 2 + (y - thermal[1]) ** 2)


@njit(cache=True, nogil=True, inline="always")
def strand_reach(volume, length, thickness, swell):
    """How deep below the nozzle a strand still touches: its free diameter, die swell included."""
    if length <= 0.0:
        return ON_SPOT_LAYERS * thickness
    diameter = 2.0 * np.sqrt(volume / length / np.pi)
    return max(HELD_LAYERS * thickness, swell * diameter)


@njit(inner=True, cache=True, nogil=True)
def drop_of(kind, done, length, sag, droop):
    """How far a strand that is not held comes down, `done` mm after the stretch begins."""
    if kind == AT_BOTH:
        return 4.0 * sag * done * max(length - done, 0.0)  # parabola, sag · length² in the middle
    if kind == AT_START:
        return droop * done * done
    if kind == AT_END:
        return droop * (length - done) ** 2
    return np.inf


@njit(inner=True, cache=True, nogil=True)
def highest_below(world, head, layer, x, y, z):
    """Highest solid under the bore that the layer has found, at or below z; 0 is the bed."""
    (hi, lo, nxt, pool, pool_next, _), before, stamp = world
    near, counts, phases, grid = head.near, head.counts, head.phases, head.grid
    ny, nx = hi.shape
    gx, gy = (x - grid[0]) / grid[2], (y - grid[1]) / grid[2]
    cx, cy = int(np.floor(gx)), int(np.floor(gy))
    phase = int((gy - cy) * phases) * phases + int((gx - cx) * phases)
    best = 0.0
    for k in range(counts[phase, 0]):
        iy, ix = cy + near[phase, k, 0], cx + near[phase, k, 1]
        if 0 <= iy < ny and 0 <= ix < nx:
            below = found_below(hi, lo, nxt, pool, pool_next, before, stamp, layer, iy, ix, z)
            best = max(best, below)
    return best
