"""Where to touch: the few places that tell most of what a layer lacks, or has too much of.

First, before anything is known: a defect is as likely wherever plastic is laid, and costs as much
plastic as it takes away. What no touch meets lies in a disc without a touch, so the best design
leaves the least plastic in the largest such disc: that is a minimax distance design (Johnson, Moore
and Ylvisaker 1990) with distances weighted by the root of the plastic laid on an area. Farthest
points are within a factor of two of it (Gonzalez 1985), and come near to it once each is moved,
again and again, to the middle of what is nearest to it (Lloyd 1982). Places felt at earlier looks
count as well, the less the more layers lie between: what lasts over layers is met sooner or later
wherever it is.

Then, around a touch that is off: defects hang together, so the places least certain are those next
to touches that are off and to none that is not: a hexagonal lattice grown from them, whose touches
just cover the area between them, beginning at the farthest off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree

from amrepair.arrays import ColumnMask, HeightMap, Mask, PlanePoints, Values
from amrepair.errors import ScannerError
from amrepair.loop.locate import BESIDE_THE_PART, of_roles
from amrepair.loop.looks import Stop
from gcode.profiles import PrintSetup
from gcode.reader import Job
from gcode.slicing.reach import Reach
from gcode.surfaces import HeightField
from gcode.surfaces.lines import columns_around, heights_by_lines

CENTRED = 12
"""Steps towards the middle of a cell: to a twelfth of its radius."""
EVENED = 12
"""Times that places are moved to the middle of what is theirs; more move them by no cell."""
HEXAGON = np.array([[np.cos(a), np.sin(a)] for a in np.arange(6) * np.pi / 3])


@dataclass(frozen=True, slots=True)
class ProbeOptions:
    """How many touches, where they may be, and how far one speaks.

    Attributes
    ----------
    most
        Touches at one look, at most: some minutes.
    first
        Of them before anything is known.
    repeats
        Of the first place, to measure the probe's noise: its standard deviation to a third.
    fade_mm
        A touch of an earlier look counts as so much farther away for each layer between.
    cell_mm
        Edge of a cell of the grid that places are chosen on.
    candidate_mm
        First places are chosen of cells so far apart.
    flat_mm
        Of one flat: digits of the text, and what the nozzle's own flat evens out.
    least_cover
        Of the tip's flat that rests on planned beads: a single line of open infill is as much.
    around_mm
        Plastic is weighed over so far around: some beads.
    lattice_ratio
        Of the pitch of a lattice that just covers: nearer to a touch none is added.
    prior_touches
        The profile's noise counts as so many touches beside those that measure it.
    sure_sigmas
        A touch is off beyond so many standard deviations of one.
    """

    most: int = 60
    first: int = 40
    repeats: int = 3
    fade_mm: float = 1.0
    cell_mm: float = 0.25
    candidate_mm: float = 0.75
    flat_mm: float = 0.02
    least_cover: float = 0.4
    around_mm: float = 2.0
    lattice_ratio: float = 0.6
    prior_touches: int = 4
    sure_sigmas: float = 4.0


DEFAULT_TOUCHES = ProbeOptions()
"""What a probe is told where nobody says otherwise."""


@dataclass(frozen=True, slots=True)
class Flats:
    """What of a job can be felt: its tops on a grid, build frame.

    Attributes
    ----------
    origin_mm
        (2,) corner of cell [0, 0].
    top_mm
        (ny, nx) planned height of what the job laid there, −inf where nothing.
    worth_mm
        (ny, nx) plastic laid on an area, mm³ on mm², some beads around.
    may
        (ny, nx) where the tip rests on a flat, and the head is clear of all that stands there.
    options
        The grid's cell, and what else places go by.
    """

    origin_mm: Float[np.ndarray, " 2"]
    top_mm: HeightMap
    worth_mm: HeightMap
    may: ColumnMask
    options: ProbeOptions = DEFAULT_TOUCHES

    def xy_mm(self, rows: np.ndarray, columns: np.ndarray) -> Float[np.ndarray, "k 2"]:
        """(k, 2) middles of cells."""
        return self.origin_mm + (np.column_stack([columns, rows]) + 0.5) * self.options.cell_mm

    def at(self, xy_mm: Float[np.ndarray, "k 2"]) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the cells that hold places; the nearest where they lie outside."""
        index = np.floor((xy_mm - self.origin_mm) / self.options.cell_mm).astype(np.int64)
        ny, nx = self.top_mm.shape
        return np.clip(index[:, 1], 0, ny - 1), np.clip(index[:, 0], 0, nx - 1)


def flats_of(
    job: Job,
    stop: Stop,
    setup: PrintSetup,
    standing: HeightField,
    options: ProbeOptions = DEFAULT_TOUCHES,
) -> Flats:
    """The last layer of a stop, or all tops of the finished part.

    Raises
    ------
    ScannerError
        If nothing of it can be touched.
    """
    beads, probe = job.beads, setup.printer.feeler
    pick = (beads.line < stop.line) & (beads.layer >= 0) & ~of_roles(beads, BESIDE_THE_PART)
    pick &= job.laid_in(job.turn_at(stop.line))
    if stop.layer_index is not None:
        pick &= beads.layer == stop.layer_index
    if not pick.any():
        raise ScannerError(f"the probe has nothing to touch at {stop.label}: no bead lies there")
    start, end = beads.start_mm[pick], beads.end_mm[pick]
    half_mm = 0.5 * beads.width_mm[pick]
    rim_mm = float(half_mm.max()) + options.around_mm
    low, shape = columns_around(start, end, rim_mm, options.cell_mm)
    top_mm = heights_by_lines(
        start, end, half_mm, end[:, 2], low_mm=low, cell_mm=options.cell_mm, shape=shape
    )
    laid = np.isfinite(top_mm)
    tip = _disc(probe.tip_radius_mm, options.cell_mm)
    highest = ndimage.maximum_filter(np.where(laid, top_mm, -np.inf), footprint=tip)
    level = laid & (top_mm > highest - options.flat_mm)
    cover = ndimage.convolve(level.astype(float), tip / tip.sum(), mode="constant")
    layer_mm = float(np.median(beads.height_mm[pick]))
    worth_mm, may = layer_mm * _density(laid, options), level & (cover >= options.least_cover)
    flats = Flats(low, top_mm, worth_mm, may, options)
    flats.may[flats.may] = _clear(flats, setup, standing)
    if not flats.may.any():
        raise ScannerError(
            f"the probe has nothing to touch at {stop.label}: no flat is as wide as its tip, or "
            "the head would hit what stands beside it"
        )
    return flats


def first_places(
    flats: Flats, count: int, earlier_mm: Float[np.ndarray, "e 3"]
) -> Float[np.ndarray, "k 2"]:
    """(k, 2) farthest places, weighted; `earlier_mm`: places felt before, and what they fade by."""
    step = round(flats.options.candidate_mm / flats.options.cell_mm)
    rows, columns = np.nonzero(flats.may)
    some = (rows % step == 0) & (columns % step == 0)
    rows, columns = (rows[some], columns[some]) if some.any() else (rows, columns)
    places, weight = flats.xy_mm(rows, columns), np.sqrt(flats.worth_mm[rows, columns])
    count = min(count, len(places))
    fixed, fade = earlier_mm[:, :2], earlier_mm[:, 2]
    before = np.full(len(places), np.inf)
    if len(fixed):
        before = (np.linalg.norm(places[:, None] - fixed, axis=2) + fade).min(axis=1)
    nearest = before.copy()
    chosen = np.zeros(count, np.int64)
    for k in range(count):
        # the first of all is in the midst of what is laid
        far = np.isfinite(nearest).all()
        chosen[k] = (
            np.argmax(weight * nearest) if far else _nearest(places, _middle(places, weight))
        )
        nearest = np.minimum(nearest, np.linalg.norm(places - places[chosen[k]], axis=1))
    best = (np.inf, chosen.copy())
    for _ in range(EVENED):
        away = np.linalg.norm(places[:, None] - places[chosen], axis=2)
        owner = away.argmin(axis=1)
        owner[before < away.min(axis=1)] = count  # what was felt before speaks for itself
        for k in range(count):
            own = owner == k
            if own.any():
                chosen[k] = _nearest(places, _middle(places[own], weight[own]))
        away = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1)
        worst = float((weight * np.minimum(away, before)).max())
        if worst < best[0]:
            best = (worst, chosen.copy())
    return _short_way(places[np.unique(best[1])])


def _middle(
    places_mm: Float[np.ndarray, "k 2"], weight: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " 2"]:
    """(2,) from where the farthest, weighted, is nearest (Bădoiu and Clarkson 2003)."""
    middle = np.average(places_mm, axis=0, weights=weight)
    for k in range(1, CENTRED + 1):
        farthest = int(np.argmax(weight * np.linalg.norm(places_mm - middle, axis=1)))
        middle += (places_mm[farthest] - middle) / (k + 1)
    return np.asarray(middle)


def _nearest(places_mm: Float[np.ndarray, "k 2"], to_mm: Float[np.ndarray, " 2"]) -> int:
    return int(np.argmin(np.linalg.norm(places_mm - to_mm, axis=1)))


def next_places(
    flats: Flats,
    touched_mm: PlanePoints,
    off_mm: Values,
    is_off: Mask,
    *,
    reach_mm: float,
    most: int,
) -> Float[np.ndarray, "k 2"]:
    """(k, 2) places beside touches that are off, as far from all others as touches reach.

    Parameters
    ----------
    off_mm
        By how much each touch is off, to its magnitude.
    """
    if not is_off.any() or most <= 0:
        return np.zeros((0, 2))
    pitch_mm = np.sqrt(3.0) * reach_mm
    felt = cKDTree(touched_mm)
    found: list[np.ndarray] = []
    for k in np.flatnonzero(is_off)[np.argsort(-np.abs(off_mm[is_off]), kind="stable")]:
        around = touched_mm[k] + pitch_mm * HEXAGON
        rows, columns = flats.at(around)
        for place in around[flats.may[rows, columns]]:
            near_mm = felt.query(place)[0]
            if found:
                near_mm = min(near_mm, np.linalg.norm(np.array(found) - place, axis=1).min())
            if near_mm > flats.options.lattice_ratio * pitch_mm:
                found.append(place)
    return _short_way(np.array(found[:most]).reshape(-1, 2))


def _clear(flats: Flats, setup: PrintSetup, standing: HeightField) -> Bool[np.ndarray, " k"]:
    """(k,) of the places that may be touched: whether the head is clear of what stands there."""
    rows, columns = np.nonzero(flats.may)
    tops_mm = flats.top_mm[rows, columns]
    probe, flat_mm = setup.printer.feeler, flats.options.flat_mm
    clear = tops_mm - probe.offset_mm[2] >= standing.top_mm - flat_mm  # nothing is higher
    if clear.all():
        return clear
    tip_mm = np.column_stack([flats.xy_mm(rows, columns), tops_mm]) - probe.offset_mm
    ask = np.flatnonzero(~clear)
    low, high = tip_mm[ask].min(axis=0), tip_mm[ask].max(axis=0)
    window = (low[0] - 1.0, low[1] - 1.0, high[0] + 1.0, high[1] + 1.0)
    reach = Reach(standing, setup.printer, lowest_tip_mm=float(low[2]), window_mm=window)
    index = np.floor((tip_mm[ask, :2] - reach.field.origin_mm) / reach.cell_mm).astype(np.int64)
    least_mm = np.max([one.least_tip_mm for one in reach.obstacles], axis=0)
    iy, ix = (np.clip(index[:, k], 0, reach.shape[1 - k] - 1) for k in (1, 0))
    clear[ask] = least_mm[iy, ix] <= tip_mm[ask, 2] + flat_mm
    return clear


def _density(laid: ColumnMask, options: ProbeOptions) -> HeightMap:
    """(ny, nx) how much of the area around is laid, of what lies within the layer's outline."""
    wide = 2 * round(options.around_mm / options.cell_mm) + 1
    within = ndimage.minimum_filter(ndimage.maximum_filter(laid, wide), wide) | laid
    full, share = (ndimage.uniform_filter(a.astype(float), wide) for a in (within, laid))
    return np.asarray(share / np.maximum(full, 1e-9))


def _disc(radius_mm: float, cell_mm: float) -> Bool[np.ndarray, "d d"]:
    half = int(np.ceil(radius_mm / cell_mm))
    y, x = np.mgrid[-half : half + 1, -half : half + 1] * cell_mm
    return np.asarray(np.hypot(x, y) <= radius_mm + 1e-9)


def _short_way(places_mm: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k 2"]:
    """The same places, each followed by the nearest that is left; the first stays the first."""
    if len(places_mm) < 3:
        return places_mm
    left, order = list(range(1, len(places_mm))), [0]
    while left:
        away = np.linalg.norm(places_mm[left] - places_mm[order[-1]], axis=1)
        order.append(left.pop(int(np.argmin(away))))
    return places_mm[order]
