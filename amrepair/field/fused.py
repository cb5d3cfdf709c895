"""Surfels: a scan condensed to occupied cells, so that noise averages out before any decision.

A surfel is the mean of the points in one cell: its place, its deviation, and how many there are. A
table of neighbouring cells gives local planes and averages over the width of a bead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Mask, Numbers, Points, Values
from amrepair.field import fused_kernels as kernels
from amrepair.field.options import DEFAULT_SURFELS, SurfelOptions
from amrepair.field.places import PlaceTree
from amrepair.frames import box_of, cells_of
from amrepair.observe.views import Shares
from amrepair.scans import Scan
from gcode.compiled import read_only

# A grid of so many cells is numbered in place; keys of a larger one are sorted.
MOST_COUNTED_CELLS = 16_000_000
# Columns of a neighbour table: the cells before and behind along each axis.
CELLS_BEFORE_AND_BEHIND = ((4, 22), (10, 16), (12, 14))


@dataclass(frozen=True)
class Surfels:
    """Occupied cells of a scan, template frame.

    Attributes
    ----------
    cell_mm
        The edge of a cell, about twice the point spacing.
    spacing_mm
        The mean distance between neighbouring points, estimated.
    place_mm
        (s, 3) the mean place of the points in each cell.
    deviation_mm
        (s,) their mean signed distance to the template.
    count
        (s,) their number.
    spread_mm
        Robust standard deviation of deviations within a cell: the noise as the scan shows it.
    table
        (s, 27) the cell itself and its neighbours, by number; −1 where there is none.
    of_point
        (n,) the cell of each point of the scan; −1 for points that were left out.
    moments
        (s, 12) sums over each cell's points, from which planes are fitted.
    point_deviation_mm
        (n,) the deviation of each point of the scan.
    sensor_mm
        (s, 3) the mean place of the sensors that saw a cell's points; None where not known.
    """

    cell_mm: float
    spacing_mm: float
    place_mm: Points
    deviation_mm: Values
    count: Numbers
    spread_mm: float
    table: Int[np.ndarray, "s 27"]
    of_point: Int[np.ndarray, " m"]
    moments: Float[np.ndarray, "s 12"]
    point_deviation_mm: Float[np.ndarray, " m"]
    sensor_mm: Points | None

    def __len__(self) -> int:
        return len(self.place_mm)

    @cached_property
    def tree(self) -> PlaceTree:
        """A search tree of the places, made when first asked for: a clean layer needs none."""
        return PlaceTree.of(self.place_mm)

    def planes(self, which: Numbers) -> Points:
        """(q, 3) unit normals (either sign) of the planes through each cell and its neighbours."""
        sums = kernels.neighbour_sums(self.table[which], self.moments)
        n = sums[:, 11]
        mean = sums[:, :3] / n[:, None]
        xx, yy, zz, xy, xz, yz = (sums[:, 4:10] / n[:, None]).T
        second = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
        covariance = second - mean[:, :, None] * mean[:, None, :]
        return np.asarray(np.linalg.eigh(covariance)[1][:, :, 0])

    def halves_joined(self, which: Numbers, normal: Points) -> Surfels:
        """The same surfels, with some moved onto the surface that a cell's boundary cuts in two.

        Where a boundary between cells runs along the surface, the cells on both sides hold halves
        of its points. Each cell in `which` is moved along its normal to the mean of its own points
        and of those that the cells before and behind it hold of the same surface.
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

    def wide_mean(
        self, value: Values, which: Int[np.ndarray, " q"] | slice = slice(None)
    ) -> Float[np.ndarray, " q"]:
        """(q,) a value averaged over each cell and its 26 neighbours, about as wide as a bead.

        For the cells in `which`; by default for all.
        """
        sums = np.stack([self.count * value, self.count], axis=1)
        wide = kernels.neighbour_sums(self.table[which], sums)
        return np.asarray(wide[:, 0] / wide[:, 1])

    def by_view(self, view_index: Int[np.ndarray, " m"]) -> Shares:
        """What each view contributes to each cell that it saw, ordered by cells."""
        views = int(view_index.max(initial=0)) + 1
        count, total_mm = kernels.sums_by_view(
            self.of_point, view_index, read_only(self.point_deviation_mm), len(self), views
        )
        place, view = np.nonzero(count)
        seen = count[place, view]
        return Shares(place, view, total_mm[place, view] / seen, seen)

    def toward_sensors(self, which: Numbers) -> Points | None:
        """(n, 3) vectors from some cells to the sensors that saw them; None where not known."""
        if self.sensor_mm is None:
            return None
        return np.asarray(self.sensor_mm[which] - self.place_mm[which])


def make_surfels(
    scan: Scan, deviation_mm: Values, keep: Mask, options: SurfelOptions = DEFAULT_SURFELS
) -> Surfels:
    """Condense the points in `keep` to cells, whose size follows from the point spacing."""
    points_mm, sensor_mm = scan.points_mm, None
    box = box_of(np.compress(keep, points_mm, axis=0)) if keep.any() else np.zeros((2, 3))
    spacing_mm = _spacing(points_mm, keep, box, options)
    cell_mm = options.cell_spacings * spacing_mm
    cell_mm = float(np.clip(cell_mm, options.least_cell_mm, options.most_cell_mm))
    of_point, keys, strides = _numbered(points_mm, keep, box, cell_mm)
    # moments about one origin near the part keep float64 far from cancellation
    origin = box.mean(axis=0)
    sums = kernels.cell_sums(
        of_point, read_only(points_mm), origin, read_only(deviation_mm), len(keys)
    )
    count, mean_f = sums[:, 11], sums[:, 3] / sums[:, 11]
    table = kernels.neighbour_table(keys, *strides)
    if scan.sensors_mm is not None and scan.sensor_index is not None:
        told = of_point, scan.sensor_index, np.ascontiguousarray(scan.sensors_mm)
        sensor_mm = kernels.sensor_sums(*told, len(keys)) / count[:, None]
    many = count >= 3
    variance = np.maximum(sums[:, 10] / count - mean_f**2, 0.0) * count / np.maximum(count - 1, 1)
    return Surfels(
        cell_mm=cell_mm,
        spacing_mm=spacing_mm,
        place_mm=sums[:, :3] / count[:, None] + origin,
        deviation_mm=mean_f,
        count=count.astype(np.int64),
        spread_mm=float(np.sqrt(np.median(variance[many]))) if many.any() else 0.0,
        table=table,
        of_point=of_point,
        moments=sums,
        point_deviation_mm=deviation_mm,
        sensor_mm=sensor_mm,
    )


def estimate_spacing(points_mm: Points) -> float:
    """Estimate a surface cloud's mean point spacing from how many coarse cells it occupies."""
    return _spacing(points_mm, np.ones(len(points_mm), bool), box_of(points_mm), DEFAULT_SURFELS)


def _spacing(
    points_mm: Points, keep: Mask, box_mm: Float[np.ndarray, "2 3"], options: SurfelOptions
) -> float:
    """`estimate_spacing` of some points."""
    if keep.sum() < 2:
        return options.most_cell_mm / 2
    cell_mm = 1.0
    while True:
        of_point, keys, strides = _numbered(points_mm, keep, box_mm, cell_mm)
        count = np.bincount(of_point[of_point >= 0], minlength=len(keys))
        table = kernels.neighbour_table(keys, *strides)
        # a stray point in the air would count as much as a cell of surface
        near = np.where(table >= 0, count[table], 0).max(axis=1) >= options.least_near
        near |= not near.any()
        kept, occupied = int(count[near].sum()), int(near.sum())
        # a cell must hold several points, or the count of cells says nothing about area
        if kept >= 4 * occupied or occupied == 1 or cell_mm > 64.0:
            return float(np.sqrt(options.area_per_cell * occupied * cell_mm**2 / kept))
        cell_mm *= 2.0


def _numbered(
    points_mm: Points, keep: Mask, box_mm: Float[np.ndarray, "2 3"], cell_mm: float
) -> tuple[Numbers, Int[np.ndarray, " s"], tuple[int, int]]:
    """Number the occupied cells: each point's number (−1 if left out), the cells' keys, strides.

    Keys rise with x, y and z, on a grid with an empty layer around it.
    """
    shape = np.floor((box_mm[1] - box_mm[0]) / cell_mm).astype(np.int64) + 3
    strides = (int(shape[1] * shape[2]), int(shape[2]))
    if np.prod(shape.astype(float)) <= MOST_COUNTED_CELLS:
        return *kernels.numbered(read_only(points_mm), keep, box_mm[0], cell_mm, shape), strides
    index = cells_of(points_mm[keep], box_mm[0], cell_mm) + 1
    of_point = np.full(len(points_mm), -1, np.int64)
    keys, of_point[keep] = np.unique(index @ np.array([*strides, 1]), return_inverse=True)
    return of_point, keys, strides
