"""Views of a merged cloud, told apart by the order of its points.

A scanner writes its points as it takes them, and a merged cloud has one scan after the other, as
long as nobody mixed or thinned it. A view passes each place once. So two points of a place that
follow each other closely in the order are of one view, and two that lie far apart in it are of two:
each such pair votes against a boundary between them, or for one. The views are the runs of the
order that contradict the fewest votes. What "closely" is, the rows of the scanner decide; of all
distances the one is taken at which the fewest votes are contradicted. Where there is none at which
they agree, points were mixed, and nothing is known of views.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Int

from amrepair.arrays import Numbers, Points
from amrepair.frames import cells_of, diagonal
from amrepair.observe import order_kernels as kernels
from amrepair.observe.options import DEFAULT_ORDER, OrderOptions
from amrepair.scans import Scan


def views_of(scan: Scan, options: OrderOptions = DEFAULT_ORDER) -> Numbers | None:
    """(n,) which view saw each point, from 0: as the scan says, else by the order of its points.

    None where nobody knows, or all are of one.
    """
    if _says(scan):
        return scan.view_index
    return views_in_order(scan.points_mm, options)


def views_from(scan: Scan) -> str:
    """What `views_of` tells views apart by, in words."""
    return "its sensors" if _says(scan) else "the order of its points"


def _says(scan: Scan) -> bool:
    return scan.grids is not None or scan.sensor_index is not None


def views_in_order(points_mm: Points, options: OrderOptions = DEFAULT_ORDER) -> Numbers | None:
    """(n,) which view saw each point, from 0; None where their order does not tell of several.

    Parameters
    ----------
    points_mm
        (n, 3) in the order in which they were taken, in any frame.
    """
    step = -(-len(points_mm) // options.most_points)
    some = points_mm[::step]
    grids = [_cells(some, aside, options) for aside in (0.0, 0.5)]
    first, last, places = _pairs([_key(cells) for cells in grids])
    found: list[tuple[float, Numbers]] = []
    for apart in _distances(len(some)):
        far = int(np.count_nonzero(last - first > apart))
        if far < options.least_again * places:
            break
        if far > options.most_apart * len(first):
            continue
        begins, contradicted = _runs(first, last, apart, len(some), options)
        if len(begins) > 1 and contradicted <= options.most_contradicted * far:
            found.append((contradicted / far, begins))
    for _, begins in sorted(found, key=lambda one: one[0]):
        view = np.searchsorted(begins, np.arange(len(some)), side="right") - 1
        # neither rows of a single view nor blocks of one cloud
        if (
            _wide(grids[0], view) >= options.least_wide
            and _side_by_side(some, grids[0], view) <= options.most_beside
        ):
            return np.asarray(np.repeat(view, step)[: len(points_mm)], np.int64)
    return None


def _cells(points_mm: Points, aside: float, options: OrderOptions) -> Int[np.ndarray, "n 3"]:
    """(n, 3) the place of each point, in a grid that begins so many cells before them."""
    low_mm = points_mm.min(axis=0)
    across = min(options.most_across, np.sqrt(len(points_mm) / options.points_across))
    cell_mm = max(diagonal(points_mm) / across, np.finfo(float).tiny)
    return cells_of(points_mm, low_mm - aside * cell_mm, cell_mm)


def _key(cells: Int[np.ndarray, "n 3"]) -> Numbers:
    return np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))


def _wide(cells: Int[np.ndarray, "n 3"], view: Numbers) -> float:
    """How many cells wide the median view is: its cells over its length in cells."""
    place = _key(cells)
    places = int(place.max()) + 1
    filled = np.bincount(np.unique(place + view * places) // places)
    runs = np.split(cells.astype(float), np.flatnonzero(np.diff(view)) + 1)
    return float(np.median(filled / [max(diagonal(run), 1.0) for run in runs]))


def _side_by_side(points_mm: Points, cells: Int[np.ndarray, "n 3"], view: Numbers) -> float:
    """How far apart views lie in a cell: near 1 where they see the same, several side by side.

    The variance between the views' means in a cell over that within views (Fisher's F), pooled over
    the cells that several see.
    """
    views = int(view.max()) + 1
    seen, of = np.unique(_key(cells) * views + view, return_inverse=True)
    place = np.unique(seen // views, return_inverse=True)[1]
    count, every = np.bincount(of), np.bincount(place[of])
    seen_by = np.bincount(place)
    several = seen_by > 1
    between_mm2 = within_mm2 = 0.0
    for along_mm in points_mm.T:
        mean_mm = np.bincount(of, along_mm) / count
        off_mm = mean_mm - (np.bincount(place, count * mean_mm) / every)[place]
        between_mm2 += float(np.bincount(place, count * off_mm**2)[several].sum())
        apart_mm = (along_mm - mean_mm[of])[several[place[of]]]
        within_mm2 += float(apart_mm @ apart_mm)
    between_mm2 /= max(int((seen_by[several] - 1).sum()), 1)
    within_mm2 /= max(int((every[several] - seen_by[several]).sum()), 1)
    return between_mm2 / max(within_mm2, np.finfo(float).tiny)


def _pairs(
    grids: Sequence[Numbers],
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], int]:
    """(k,) points of one place that follow each other in the order, twice; how many places.

    Places are cells of two grids, half a cell apart: else the rows of a scanner that lie along a
    grid would end where its cells do.
    """
    first, last, places = [], [], 0
    for place in grids:
        order = np.argsort(place, kind="stable")
        same = place[order][1:] == place[order][:-1]
        first.append(order[:-1][same])
        last.append(order[1:][same])
        places += len(order) - int(same.sum())
    return np.concatenate(first), np.concatenate(last), places


def _distances(points: int) -> Iterator[int]:
    """Powers of two up to half the order."""
    apart = 1
    while 2 * apart < points:
        yield apart
        apart *= 2


def _runs(
    first: Int[np.ndarray, " k"],
    last: Int[np.ndarray, " k"],
    apart: int,
    points: int,
    options: OrderOptions,
) -> tuple[Int[np.ndarray, " v"], int]:
    """(v,) the first point of each run; how many votes these runs contradict."""
    parts = min(options.most_parts, points)
    begins, parted = kernels.weakest(first, last, apart, points, parts)
    within = kernels.together(first, last, apart, begins, points)
    cost = parted + options.least_told * within[0, -1]
    cost[0] = 0.0
    chosen = kernels.least_contradicted(within, cost)
    ends = np.append(chosen[1:], parts)
    return begins[chosen], int(within[chosen, ends].sum() + parted[chosen].sum())
