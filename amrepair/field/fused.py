"""Surfels: the scan condensed to occupied cells, so that noise averages out before any decision.

A surfel is the mean of the points in one cell: place, deviation, count. It knows its neighbours,
and so a bead-sized average and a local plane. It decides nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from amrepair.field import fused_kernels as kernels
from amrepair.field.options import USUAL_SURFELS, SurfelOptions
from amrepair.scans import Scan

# A grid of so many cells is counted in place; points of a larger one are sorted.
MOST_COUNTED_CELLS = 16_000_000
# Columns of a neighbour table: the cells before and behind along each axis.
CELLS_BEFORE_AND_BEHIND = ((4, 22), (10, 16), (12, 14))


@dataclass(frozen=True)
class Surfels:
    """Occupied cells of a scan, template frame.

    Attributes
    ----------
    cell_mm
        Edge of a cell, about twice the point spacing.
    spacing_mm
        Mean distance between neighbouring points, estimated.
    place_mm
        (s, 3) mean of the points in each cell.
    deviation_mm
        (s,) mean f of the points in each cell.
    count
        (s,) points in each cell.
    wide_deviation_mm
        (s,) the mean f over the cell and its 26 neighbours: a bead-sized window.
    spread_mm
        Robust standard deviation of f within a cell: the noise as the scan shows it.
    table
        (s, 27) neighbours, −1 where empty.
    of_point
        (n,) the surfel of each point, −1 for points left out.
    point_deviation_mm
        (n,) deviation of each point.
    """

    cell_mm: float
    spacing_mm: float
    place_mm: Float[np.ndarray, "s 3"]
    deviation_mm: Float[np.ndarray, " s"]
    count: Int[np.ndarray, " s"]
    wide_deviation_mm: Float[np.ndarray, " s"]
    spread_mm: float
    table: Int[np.ndarray, "s 27"]
    of_point: Int[np.ndarray, " n"]
    moments: Float[np.ndarray, "s 11"]
    order: Int[np.ndarray, " kept"]
    start: Int[np.ndarray, " s1"]
    point_deviation_mm: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.place_mm)

    @cached_property
    def tree(self) -> cKDTree:
        """Of the places; made when first asked for, as at a clean layer few are."""
        return cKDTree(self.place_mm, compact_nodes=False, balanced_tree=False)

    def planes(self, which: Int[np.ndarray, " q"]) -> Float[np.ndarray, "q 3"]:
        """(q, 3) unit normals (either sign) of the planes through each cell and its neighbours."""
        sums = kernels.neighbour_sums(self.table[which], self.moments)
        n = sums[:, 10]
        mean = sums[:, :3] / n[:, None]
        xx, yy, zz, xy, xz, yz = (sums[:, 4:10] / n[:, None]).T
        second = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
        covariance = second - mean[:, :, None] * mean[:, None, :]
        return np.asarray(np.linalg.eigh(covariance)[1][:, :, 0])

    def halves_joined(
        self, which: Int[np.ndarray, " q"], normal: Float[np.ndarray, "q 3"]
    ) -> Surfels:
        """The same where a cell's end that lies in the surface does not part it in two.

        Each of the cells in `which` is moved along its normal onto the mean of what the cells
        before and behind it hold of the same surface, as if it had been laid around that.
        """
        place = self.place_mm.copy()
        axis = np.abs(normal).argmax(axis=1)
        beside = self.table[
            which[:, None], np.array(CELLS_BEFORE_AND_BEHIND)[axis]
        ]  # (q, 2), −1 where empty
        apart_mm = ((self.place_mm[beside] - place[which, None]) * normal[:, None]).sum(axis=2)
        same = (beside >= 0) & (np.abs(apart_mm) < 0.5 * self.cell_mm)
        count = np.where(same, self.count[beside], 0)
        moved_mm = (count * apart_mm).sum(axis=1) / (self.count[which] + count.sum(axis=1))
        place[which] += moved_mm[:, None] * normal
        return replace(self, place_mm=place)

    def by_view(
        self, view_index: Int[np.ndarray, " n"]
    ) -> tuple[
        Int[np.ndarray, " k"], Int[np.ndarray, " k"], Float[np.ndarray, " k"], Int[np.ndarray, " k"]
    ]:
        """Cell, view, mean deviation and number of points of each view's share of a cell."""
        has = self.of_point >= 0
        views = int(view_index.max()) + 1
        key = self.of_point[has] * views + view_index[has]
        count = np.bincount(key)
        keys = np.flatnonzero(count)
        count = count[keys]
        mean = np.bincount(key, self.point_deviation_mm[has])[keys] / count
        return keys // views, keys % views, mean, count

    def toward_sensors(
        self, which: Int[np.ndarray, " q"], scan: Scan
    ) -> Float[np.ndarray, "q 3"] | None:
        """(q, 3) mean way from some cells' points to what saw them; None where nobody knows."""
        if scan.sensors_mm is None or scan.sensor_index is None:
            return None
        return np.asarray(
            kernels.mean_to_sensor(
                which, self.order, self.start, scan.points_mm, scan.sensors_mm, scan.sensor_index
            )
        )


def make_surfels(
    points_mm: Float[np.ndarray, "n 3"],
    deviation_mm: Float[np.ndarray, " n"],
    keep: Bool[np.ndarray, " n"],
    options: SurfelOptions = USUAL_SURFELS,
) -> Surfels:
    """Condense the points in `keep`; the cell follows their spacing."""
    box, kept = kernels.kept_box(points_mm, keep)
    if kept == 0:
        box = np.zeros((2, 3))
    spacing_mm = _spacing(points_mm, keep, box, kept, options)
    cell_mm = float(np.clip(2.0 * spacing_mm, options.least_cell_mm, options.most_cell_mm))
    order, start, keys, of_point, strides = _by_cell(points_mm, keep, box, cell_mm)
    # moments about one origin near the part keep float64 far from cancellation
    origin = box.mean(axis=0)
    sums = kernels.cell_sums(order, start, points_mm, origin, deviation_mm)
    count = np.diff(start)
    table = kernels.neighbour_table(keys, *strides)
    wide = kernels.neighbour_sums(
        table, np.ascontiguousarray(np.column_stack([sums[:, 3], count.astype(float)]))
    )
    mean_f = sums[:, 3] / count
    many = count >= 3
    variance = np.maximum(sums[:, 10] / count - mean_f**2, 0.0) * count / np.maximum(count - 1, 1)
    spread_mm = float(np.sqrt(np.median(variance[many]))) if many.any() else 0.0
    sums[:, 10] = count
    return Surfels(
        cell_mm=cell_mm,
        spacing_mm=spacing_mm,
        place_mm=sums[:, :3] / count[:, None] + origin,
        deviation_mm=mean_f,
        count=count,
        wide_deviation_mm=wide[:, 0] / wide[:, 1],
        spread_mm=spread_mm,
        table=table,
        of_point=of_point,
        moments=sums,
        order=order,
        start=start,
        point_deviation_mm=deviation_mm,
    )


def estimate_spacing(
    points_mm: Float[np.ndarray, "n 3"], options: SurfelOptions = USUAL_SURFELS
) -> float:
    """Mean spacing of a surface cloud from how many 1 mm (or larger) cells it occupies."""
    keep = np.ones(len(points_mm), bool)
    box, kept = kernels.kept_box(points_mm, keep)
    return _spacing(points_mm, keep, box, kept, options)


def _spacing(
    points_mm: Float[np.ndarray, "n 3"],
    keep: Bool[np.ndarray, " n"],
    box_mm: Float[np.ndarray, "2 3"],
    kept: int,
    options: SurfelOptions,
) -> float:
    """`estimate_spacing` of some points."""
    if kept < 2:
        return options.most_cell_mm / 2
    cell_mm = 1.0
    while True:
        shape = _shape(box_mm, cell_mm)
        if np.prod(shape.astype(float)) <= MOST_COUNTED_CELLS:
            occupied = int(kernels.occupied(points_mm, keep, box_mm[0], cell_mm, shape))
        else:
            occupied = len(np.unique(_keys(points_mm[keep], box_mm, cell_mm, 0)))
        # a cell must hold several points, or the count of cells says nothing about area
        if kept >= 4 * occupied or occupied == 1 or cell_mm > 64.0:
            return float(np.sqrt(options.area_per_cell * occupied * cell_mm**2 / kept))
        cell_mm *= 2.0


def _by_cell(
    points_mm: Float[np.ndarray, "n 3"],
    keep: Bool[np.ndarray, " n"],
    box_mm: Float[np.ndarray, "2 3"],
    cell_mm: float,
) -> tuple[
    Int[np.ndarray, " kept"],
    Int[np.ndarray, " s1"],
    Int[np.ndarray, " s"],
    Int[np.ndarray, " n"],
    tuple[int, int],
]:
    """Points in the order of their cells, where cells begin, their keys, each point's, strides."""
    shape = _shape(box_mm, cell_mm) + 2
    strides = (int(shape[1] * shape[2]), int(shape[2]))
    if np.prod(shape.astype(float)) <= MOST_COUNTED_CELLS:
        return *kernels.sort_by_cell(points_mm, keep, box_mm[0], cell_mm, shape), strides
    chosen = np.flatnonzero(keep)
    keys = _keys(points_mm[chosen], box_mm, cell_mm, 1)
    order = np.argsort(keys, kind="stable")
    ranked = keys[order]
    first = np.flatnonzero(np.r_[True, ranked[1:] != ranked[:-1]])
    start = np.append(first, len(ranked))
    of_point = np.full(len(points_mm), -1, np.int64)
    of_point[chosen[order]] = np.repeat(np.arange(len(first)), np.diff(start))
    return chosen[order], start, ranked[first], of_point, strides


def _shape(box_mm: Float[np.ndarray, "2 3"], cell_mm: float) -> Int[np.ndarray, " 3"]:
    """(3,) cells that a box is divided into."""
    return np.floor((box_mm[1] - box_mm[0]) / cell_mm).astype(np.int64) + 1


def _keys(
    points_mm: Float[np.ndarray, "n 3"],
    box_mm: Float[np.ndarray, "2 3"],
    cell_mm: float,
    margin: int,
) -> Int[np.ndarray, " n"]:
    """(n,) number of each point's cell, in a grid with so many empty layers around."""
    shape = _shape(box_mm, cell_mm) + 2 * margin
    index = np.floor((points_mm - box_mm[0]) / cell_mm).astype(np.int64) + margin
    return np.asarray((index[:, 0] * shape[1] + index[:, 1]) * shape[2] + index[:, 2])
