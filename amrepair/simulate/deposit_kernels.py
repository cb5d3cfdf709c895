# mypy: disable-error-code="no-untyped-def"
"""The bead model: plastic under a moving nozzle finds its place among the columns.

Per short step of the path the nozzle's flat planes off what stands a little above it, and that
and the volume pushed out (1) level the columns under the nozzle's bore, lowest first, up to the
nozzle's height; (2) what is left fills further columns in order of distance. A strand is as wide
as its section says: where no neighbour is, the columns that its edges cross get their share of the
layer, after the others (`edge_span`); else a wall of a few lines would be laid wider than its
plastic suffices for, and sink. What finds no room rides along with the nozzle and, once it is more
than `carry_limit`, (3) is pressed into the voids right under the strand, (4) spreads farther, (5)
rises as a ridge around the nozzle's flat. Volume is conserved to rounding.
A groove below the layer that is narrower than `bridges` columns is not filled without pressure:
the strand spans it and bulges in by a meniscus, and a void stays. So a layer with less plastic
than fills it stands at the nozzle's height all the same, and what it lacks lies between its beads;
one with as much as fills it leaves no voids.
A strand that nothing holds comes down before it is laid (`strand_kernels`).
The step positions are dithered over one column (a low-discrepancy sequence from the segment's own
coordinates), so that a wall's mean position does not depend on where it falls in the grid.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from amrepair.simulate.columns_kernels import FRESH, Stacks, grown, insert, surface_below
from amrepair.simulate.strand_kernels import (
    AT_BOTH,
    AT_END,
    AT_START,
    NO_ANCHOR,
    StandingColumns,
    drop_of,
    groove_columns,
    highest_below,
    is_held,
    lifted,
    run_ahead,
    strand_reach,
)
from gcode.compiled import njit

# Entries of `state`, floats: what the nozzle carries along, and where it last was.
CARRY, LAST_X, LAST_Y, LAST_Z, LOST, LAST_T = 0, 1, 2, 3, 4, 5
# Whether the last step was held, and the stretch without hold that it belongs to: how far it has
# come, how long it is (0: none), which of its ends are held.
HELD, RUN_DONE, RUN_LENGTH, RUN_KIND = 6, 7, 8, 9
LAST_GAP = 10  # how deep below the nozzle the last strand reached
LAID_Z, LAYER = 11, 12  # height of the layer that is being laid, and its number
FREE_SPREAD = 13  # how far from its axis a strand spreads without pressure, columns
STATE_SIZE = 14
NEW_LAYER_MM = 0.03  # strands that differ by less in height are of one layer
# Additive recurrence of the plastic number: the 2-D low-discrepancy sequence R2 (M. Roberts, 2018)
R2_X, R2_Y = 0.7548776662466927, 0.5698402909980532
LEAST_COLUMN_MM = 1e-9  # mm of column: less than this waits for the next step
RIDGE_STEP_MM = 0.05  # a ridge grows evenly, by this much at a time
MOST_RIDGE_STEPS = 4000
# A void lower than this is filled: fewer voids, and the top sinks by no more than this over one.
LEAST_VOID_MM = 0.03
MENISCUS = np.pi / 8  # mean depth of half a circle over a groove, in groove widths
LEAST_SPILL_MM = 0.005  # what stands less above the nozzle is not planed off
# With more plastic than so much of what its layer has room for, a strand hangs where it may.
THICK_LAYERS = 1.1
FREE_COLUMNS = 0.5  # a column that the strand's edge crosses is its own
NARROWEST_BORES = 0.45  # half width: with less plastic a strand is lower, not narrower
BESIDE_COLUMNS = 1.5  # from a column at a strand's edge to what lies beside the strand
PRESSED_SHARE = 0.25  # of what rides along before it rises: from here on it is pressed into voids
OPEN_LAYERS = 1.5  # a void is under the strand if its roof is no more than this below the nozzle


class Bead(NamedTuple):
    """What a step lays: number of its layer, thickness, how deep below it fills, mm.

    `hangs`: how thick it is where nothing is that near below. A bridge's strand has more plastic
    than its layer has room for, and nothing keeps that from hanging lower.
    """

    layer: Any
    thickness: Any
    gap_limit: Any
    hangs: Any


class Room(NamedTuple):
    """Working room of a step: floors, what an edge is sunk by, columns; the strand's axis; window.

    `axis` is as `share_of` says; `window` (4,) holds the rows and columns touched so far.
    """

    floors: Any
    sunk: Any
    chosen: Any
    axis: Any
    window: Any


# The common cases are told twice, inline: a call with arrays costs more than the work itself, and
# so does a record with arrays: kernels of a column take the arrays, those of a step take records.
@njit(cache=True, nogil=True, inline="always")
def surface_under(hi, lo, nxt, pool, pool_next, iy, ix, z):
    """As `surface_below`, the topmost interval first."""
    surface = hi[iy, ix]
    if surface > z:
        surface = z
        if lo[iy, ix] >= z:
            surface = surface_below(hi, lo, nxt, pool, pool_next, iy, ix, z)
    return surface


@njit(cache=True, nogil=True, inline="always")
def stack(hi, lo, nxt, pool, pool_next, meta, before, stamp, layer, iy, ix, bottom, level):
    """As `insert`, for plastic that begins on the topmost solid; notes what the layer found."""
    if stamp[iy, ix] != layer:
        stamp[iy, ix] = layer
        before[iy, ix] = hi[iy, ix]
    if bottom == hi[iy, ix] and (bottom > lo[iy, ix] or bottom == 0.0):
        hi[iy, ix] = level
    else:
        insert(hi, lo, nxt, pool, pool_next, meta, iy, ix, bottom, level)


@njit(cache=True, nogil=True, inline="always")
def floor_under(
    hi, lo, nxt, pool, pool_next, before, stamp, bead, iy, ix, z, bridges, cell
):  # fmt: skip
    """Where plastic coming from height z begins to stack: on what lies below, or hanging."""
    surface = surface_under(hi, lo, nxt, pool, pool_next, iy, ix, z)
    underside = z - bead.thickness
    if z - surface > bead.gap_limit + LEAST_COLUMN_MM:
        surface = z - bead.hangs
    elif underside - surface > LEAST_VOID_MM:
        across = groove_columns(
            hi, before, stamp, bead.layer, iy, ix, underside - LEAST_VOID_MM, bridges
        )
        if across > 0:
            # a column that is low by a share of the layer is open over that share of its width
            open_share = min(1.0, (underside - surface) / bead.thickness)
            spanned = underside - MENISCUS * across * cell * open_share**2
            if spanned > surface + LEAST_VOID_MM:
                surface = spanned
    return surface


@njit(cache=True, nogil=True, inline="always")
def share_of(axis, iy, ix):
    """Share of a column that lies within a strand's width; above 1 well inside, below 0 beside it.

    `axis` is (x, y, across it x, y, half width, half the bore) of the strand in columns, which the
    dither leaves alone.
    """
    return axis[4] + 0.5 - abs((ix + 0.5 - axis[0]) * axis[2] + (iy + 0.5 - axis[1]) * axis[3])


@njit(cache=True, nogil=True, inline="always")
def edge_span(hi, lo, nxt, pool, pool_next, before, stamp, bead, axis, iy, ix, z):
    """From where to where a strand's edge fills a column; (0, inf): it has no edge there.

    Plastic is as wide as its section says where nothing lies beside it: the column that its edge
    crosses gets its share of the layer, on what lies not far below, or hanging. Towards a
    neighbour it has no edge: it fills the groove between them.
    """
    across = (ix + 0.5 - axis[0]) * axis[2] + (iy + 0.5 - axis[1]) * axis[3]
    away = BESIDE_COLUMNS if across > 0.0 else -BESIDE_COLUMNS
    x = int(np.floor(ix + 0.5 + away * axis[2]))
    y = int(np.floor(iy + 0.5 + away * axis[3]))
    beside = hi[y, x] if 0 <= x < hi.shape[1] and 0 <= y < hi.shape[0] else 0.0
    bottom, top = 0.0, np.inf
    if beside < z - 0.5 * bead.thickness:
        floor = before[iy, ix]
        if stamp[iy, ix] != bead.layer or floor > z:
            floor = surface_under(hi, lo, nxt, pool, pool_next, iy, ix, z)
        underside = z - bead.thickness - LEAST_VOID_MM
        if floor >= underside or beside < underside:
            deep = max(share_of(axis, iy, ix), 0.0) * bead.thickness
            bottom = floor if z - floor <= bead.gap_limit else z - deep
            top = min(z, bottom + deep)
    return bottom, top


@njit(inner=True, cache=True, nogil=True)
def planed(hi, lo, near, row, count, cx, cy, z, most):
    """What the nozzle's flat takes off columns that stand above z by up to `most`, mm of column."""
    ny, nx = hi.shape
    taken = 0.0
    for k in range(count):
        iy, ix = cy + near[row, k, 0], cx + near[row, k, 1]
        if iy < 0 or ix < 0 or iy >= ny or ix >= nx:
            continue
        over = hi[iy, ix] - z
        if LEAST_SPILL_MM < over <= most and lo[iy, ix] < z:
            hi[iy, ix] = z
            taken += over
    return taken


@njit(inner=True, cache=True, nogil=True)
def pressed(hi, lo, nxt, pool, pool_next, meta, near, row, count, cx, cy, z, amount, thickness):
    """Press plastic into the voids right under what was just laid; returns what finds no room."""
    ny, nx = hi.shape
    for k in range(count):
        if amount <= LEAST_COLUMN_MM:
            break
        iy, ix = cy + near[row, k, 0], cx + near[row, k, 1]
        if iy < 0 or ix < 0 or iy >= ny or ix >= nx:
            continue
        roof = lo[iy, ix]
        if (
            roof <= 0.0
            or roof >= z
            or hi[iy, ix] < z - LEAST_COLUMN_MM
            or z - roof > OPEN_LAYERS * thickness
        ):
            continue
        node = nxt[iy, ix]
        floor = pool[node, 1] if node != 0 else 0.0
        deep = roof - floor
        if deep <= LEAST_COLUMN_MM or deep > thickness:
            continue
        fill = min(amount, deep)
        insert(hi, lo, nxt, pool, pool_next, meta, iy, ix, floor, floor + fill)
        amount -= fill
    return amount


@njit(inner=True, cache=True, nogil=True)
def level_of(floors, count, amount, z):
    """Level to which `amount` (mm of column) fills the first `count` floors, sorted rising."""
    used = 0.0
    level = floors[0]
    for k in range(1, count + 1):
        following = z if k == count else min(floors[k], z)
        rise = (following - level) * k
        if used + rise >= amount:
            return level + (amount - used) / k
        used += rise
        level = following
    return z


@njit(inner=True, cache=True, nogil=True)
def lay(world, head, bead, room, state, x, y, z, amount, flush):
    """One step: place `amount` (mm of column) from the nozzle at (x, y, z)."""
    (hi, lo, nxt, pool, pool_next, meta), before, stamp = world
    near, counts, phases, cell = head.near, head.counts, head.phases, head.grid[2]
    floors, sunk, chosen, axis, window = room
    bridges, carry_limit = head.bridges, head.carry_limit
    ny, nx = hi.shape
    gx = (x - head.grid[0]) / cell
    gy = (y - head.grid[1]) / cell
    cx, cy = int(np.floor(gx)), int(np.floor(gy))
    amount += state[CARRY]
    if cx < 0 or cy < 0 or cx >= nx or cy >= ny:
        state[LOST] += amount
        state[CARRY] = 0.0
        return
    phase = int((gy - cy) * phases) * phases + int((gx - cx) * phases)
    bore, reach = counts[phase, 0], counts[phase, 1]
    flat, spread = counts[phase, 2], counts[phase, 3]
    if head.planes > 0.0:
        amount += planed(hi, lo, near, phase, flat, cx, cy, z, head.planes * bead.thickness)
    found = 0
    capacity = 0.0
    # the corners of its edges on this step, give or take the dither
    farthest = axis[5] ** 2 + (axis[4] + 1.0) ** 2
    for k in range(reach):  # under the bore, and at the strand's edges; kept sorted by floor
        iy, ix = cy + near[phase, k, 0], cx + near[phase, k, 1]
        if iy < 0 or ix < 0 or iy >= ny or ix >= nx:
            continue
        share, top = share_of(axis, iy, ix), np.inf
        if k >= bore:
            if (ix + 0.5 - gx) ** 2 + (iy + 0.5 - gy) ** 2 > farthest:
                break
            if share >= 1.0 or share <= 0.0:
                continue
        if share < 1.0:
            bottom, top = edge_span(
                hi, lo, nxt, pool, pool_next, before, stamp, bead, axis, iy, ix, z
            )
        if top < np.inf:
            along = (iy + 0.5 - axis[1]) * axis[2] - (ix + 0.5 - axis[0]) * axis[3]
            if abs(along) > axis[5]:
                continue
            bottom = max(bottom, surface_under(hi, lo, nxt, pool, pool_next, iy, ix, z))
        elif k >= bore:
            continue
        else:
            top = z
            bottom = floor_under(
                hi, lo, nxt, pool, pool_next, before, stamp, bead, iy, ix, z, bridges, cell
            )
        if bottom >= top:
            continue
        bottom += z - top  # an edge is thin: the last to be filled
        at = found
        while at > 0 and floors[at - 1] > bottom:
            floors[at] = floors[at - 1]
            sunk[at] = sunk[at - 1]
            chosen[at, 0] = chosen[at - 1, 0]
            chosen[at, 1] = chosen[at - 1, 1]
            at -= 1
        floors[at] = bottom
        sunk[at] = z - top
        chosen[at, 0] = iy
        chosen[at, 1] = ix
        found += 1
        capacity += z - bottom
    if found > 0:
        level = z if capacity <= amount else level_of(floors, found, amount, z)
        for k in range(found):
            if floors[k] < level:
                stack(
                    hi, lo, nxt, pool, pool_next, meta, before, stamp, bead.layer, chosen[k, 0],
                    chosen[k, 1], floors[k] - sunk[k], level - sunk[k],
                )  # fmt: skip
        amount = amount - capacity if capacity <= amount else 0.0
    wide = False
    for k in range(bore, spread):
        iy, ix = cy + near[phase, k, 0], cx + near[phase, k, 1]
        if not wide and (k >= reach or np.hypot(ix + 0.5 - gx, iy + 0.5 - gy) > state[FREE_SPREAD]):
            wide = True  # the strand is as wide as it is meant to be: more takes pressure
            if flush or amount > PRESSED_SHARE * carry_limit:
                amount = pressed(
                    hi,
                    lo,
                    nxt,
                    pool,
                    pool_next,
                    meta,
                    near,
                    phase,
                    reach,
                    cx,
                    cy,
                    z,
                    amount,
                    bead.thickness,
                )
        if amount <= LEAST_COLUMN_MM or (k == reach and not flush and amount <= carry_limit):
            break
        if iy < 0 or ix < 0 or iy >= ny or ix >= nx:
            continue
        if not wide and share_of(axis, iy, ix) < 1.0:
            _, top = edge_span(hi, lo, nxt, pool, pool_next, before, stamp, bead, axis, iy, ix, z)
            if top < np.inf:
                continue  # it has its share
        bottom = floor_under(
            hi, lo, nxt, pool, pool_next, before, stamp, bead, iy, ix, z, bridges, cell
        )
        if bottom < z:
            level = min(z, bottom + amount)
            stack(
                hi, lo, nxt, pool, pool_next, meta, before, stamp, bead.layer, iy, ix, bottom, level
            )
            amount -= level - bottom
    ridge = 0
    while amount > LEAST_COLUMN_MM and (flush or amount > carry_limit) and ridge < MOST_RIDGE_STEPS:
        ridge += 1
        top = z + ridge * RIDGE_STEP_MM
        for k in range(flat, spread):
            iy, ix = cy + near[phase, k, 0], cx + near[phase, k, 1]
            if iy < 0 or ix < 0 or iy >= ny or ix >= nx:
                continue
            bottom = surface_under(hi, lo, nxt, pool, pool_next, iy, ix, top)
            if bottom < top:
                bottom = max(bottom, z - bead.thickness)
                level = min(top, bottom + amount)
                stack(
                    hi,
                    lo,
                    nxt,
                    pool,
                    pool_next,
                    meta,
                    before,
                    stamp,
                    bead.layer,
                    iy,
                    ix,
                    bottom,
                    level,
                )
                amount -= level - bottom
                if amount <= LEAST_COLUMN_MM:
                    break
        flush = True
    state[CARRY] = max(amount, 0.0)
    window[0] = min(window[0], cy)
    window[1] = max(window[1], cy)
    window[2] = min(window[2], cx)
    window[3] = max(window[3], cx)


@njit(inner=True, cache=True, nogil=True)
def flow_factor(regions, x, y, z):
    """Product of the flow factors of all defect regions that hold (x, y, z)."""
    factor = 1.0
    for r in range(len(regions)):
        if z <= regions[r, 6] or z > regions[r, 7]:
            continue
        dx, dy = x - regions[r, 0], y - regions[r, 1]
        u = (dx * regions[r, 2] + dy * regions[r, 3]) / regions[r, 4]
        v = (dy * regions[r, 2] - dx * regions[r, 3]) / regions[r, 5]
        if u * u + v * v <= 1.0:
            factor *= regions[r, 8]
    return factor


@njit(inner=True, cache=True, nogil=True)
def height_of_strand(world, head, path, state, s, k, x, y, z):
    """Height at which step k of segment s is laid, and how deep below that it fills columns.

    The height is the nozzle's, or lower where nothing holds the strand.
    """
    start, end, thickness = path.start, path.end, path.thickness[s]
    layer = int(state[LAYER])
    dx, dy = end[s, 0] - start[s, 0], end[s, 1] - start[s, 1]
    flat = np.sqrt(dx * dx + dy * dy)
    length = np.sqrt(flat * flat + (end[s, 2] - start[s, 2]) ** 2)
    reach = strand_reach(path.volume[s], length, thickness, head.swell)
    pools = max(reach, head.pools * thickness)
    flat = max(flat, 1e-9)
    if is_held(world, head, layer, x, y, z, dx / flat, dy / flat, thickness):
        state[HELD] = 1.0
        state[RUN_LENGTH] = 0.0
        return z, pools
    each = length / max(1, int(np.ceil(length / head.step_mm)))
    if state[RUN_LENGTH] <= 0.0:
        ahead, anchored = run_ahead(world, head, layer, path, s, k)
        state[RUN_LENGTH] = max(ahead, each)
        state[RUN_DONE] = 0.0
        state[RUN_KIND] = (AT_START if state[HELD] > 0.0 else NO_ANCHOR) + (
            AT_END if anchored else NO_ANCHOR
        )
    state[HELD] = 0.0
    done = state[RUN_DONE] + 0.5 * each
    state[RUN_DONE] += each
    drop = drop_of(int(state[RUN_KIND]), done, state[RUN_LENGTH], head.sag, head.droop)
    lies_on = highest_below(world, head, layer, x, y, z)
    if state[RUN_KIND] == AT_BOTH and z - drop > lies_on + reach:
        return z - drop, reach  # it hangs, as thick as it is
    return max(z - drop, min(z, lies_on + pools)), pools


@njit(cache=True, nogil=True)
def deposit(world, head, path, window, state):
    """Lay every segment in order; returns the pool and the volume pushed out, mm³."""
    start, end, volume, thickness = path.start, path.end, path.volume, path.thickness
    stacks, before, stamp = world
    hi, lo, nxt, pool, pool_next, meta = stacks
    grid = head.grid
    cell = grid[2]
    area = cell * cell
    pushed = 0.0
    most = head.near.shape[1]
    nodes = 4 * most + 64  # more of the pool than one step can take
    axis = np.zeros(6)
    axis[5] = 0.5 * head.beside / cell
    room = Room(np.empty(most), np.empty(most), np.empty((most, 2), np.int64), axis, window)
    least_half = NARROWEST_BORES * head.beside
    for s in range(len(volume)):
        chained = (
            volume[s] > 0.0
            and start[s, 0] == state[LAST_X]
            and start[s, 1] == state[LAST_Y]
            and start[s, 2] == state[LAST_Z]
        )
        if not chained:
            state[HELD] = 0.0
            state[RUN_LENGTH] = 0.0
        # what rounding leaves of it stays at the nozzle: after a travel it would hang in the air
        if not chained and state[CARRY] > LEAST_COLUMN_MM:
            pool, pool_next = grown(pool, pool_next, meta, nodes)
            world = StandingColumns(Stacks(hi, lo, nxt, pool, pool_next, meta), before, stamp)
            if s == 0:  # of the strand before nothing is known
                axis[4] = np.inf
            axis[0] = (state[LAST_X] - grid[0]) / cell
            axis[1] = (state[LAST_Y] - grid[1]) / cell
            bead = Bead(int(state[LAYER]), state[LAST_T], state[LAST_GAP], state[LAST_T])
            lay(
                world, head, bead, room, state, state[LAST_X], state[LAST_Y], state[LAST_Z], 0.0,
                True,
            )  # fmt: skip
        dx, dy, dz = end[s, 0] - start[s, 0], end[s, 1] - start[s, 1], end[s, 2] - start[s, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if volume[s] > 0.0:
            half = 0.5 * volume[s] / max(length * thickness[s], LEAST_COLUMN_MM)
            half = max(half, least_half)
            free = volume[s] / max(length, LEAST_COLUMN_MM) / head.beside  # as wide as the bore
            flat = max(np.sqrt(dx * dx + dy * dy), LEAST_COLUMN_MM)
            axis[2], axis[3] = -dy / flat, dx / flat
            steps = max(1, int(np.ceil(length / head.step_mm)))
            share = volume[s] / steps
            seed = np.abs(np.sin(12.9898 * start[s, 0] + 78.233 * start[s, 1]) * 43758.5453)
            jx, jy = seed % 1.0, (seed * 7.0) % 1.0
            for k in range(steps):
                t = (k + 0.5) / steps
                x, y = start[s, 0] + t * dx, start[s, 1] + t * dy
                z = start[s, 2] + t * dz
                amount = share
                if len(path.regions) > 0:
                    amount *= flow_factor(path.regions, x, y, z)
                jx = (jx + R2_X) % 1.0
                jy = (jy + R2_Y) % 1.0
                if amount <= 0.0 and state[CARRY] <= 0.0:
                    continue
                pushed += amount
                axis[0], axis[1] = (x - grid[0]) / cell, (y - grid[1]) / cell
                if abs(z - state[LAID_Z]) > NEW_LAYER_MM:
                    state[LAID_Z] = z
                    state[LAYER] += 1.0
                z -= lifted(head.thermal, x, y, z)
                if meta[FRESH] + nodes > len(pool_next):
                    pool, pool_next = grown(pool, pool_next, meta, nodes)
                    world = StandingColumns(
                        Stacks(hi, lo, nxt, pool, pool_next, meta), before, stamp
                    )
                laid_z, gap = height_of_strand(world, head, path, state, s, k, x, y, z)
                hangs, wide = thickness[s], half
                if free > THICK_LAYERS * thickness[s]:
                    below = highest_below(world, head, int(state[LAYER]), x, y, laid_z)
                    if laid_z - below > gap:
                        hangs, wide = free, 0.5 * head.beside
                axis[4] = wide / cell if flat > LEAST_COLUMN_MM else np.inf
                state[FREE_SPREAD] = wide / cell + FREE_COLUMNS
                bead = Bead(int(state[LAYER]), thickness[s], gap, hangs)
                lay(
                    world, head, bead, room, state, x + (jx - 0.5) * cell, y + (jy - 0.5) * cell,
                    laid_z, amount / area, amount <= 0.0,
                )  # fmt: skip
        state[LAST_X], state[LAST_Y], state[LAST_Z] = end[s, 0], end[s, 1], end[s, 2]
        state[LAST_T] = thickness[s]
        state[LAST_GAP] = head.pools * thickness[s]
    return pool, pool_next, pushed
