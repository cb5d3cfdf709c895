"""What many scans say of each place of a template: whole numbers that add up in any order.

Floating-point sums depend on their order; these are counts, tenths of a micrometre and millionths
of a cubic millimetre, so that a batch of ten thousand comes to the same numbers on one core and on
a cluster, killed or not.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from amrepair.arrays import Numbers, Points
from amrepair.errors import InputError
from amrepair.field.near import nearest_within
from amrepair.frames import diagonal
from amrepair.regions import AnomalyMap, Label, Region
from amrepair.template.port import Template

# So many cells to the part's diagonal: some thousands over its surface.
CELLS_PER_DIAGONAL = 40.0
UNIT_MM = 1e-4
UNIT_MM3 = 1e-6
# A point that lies farther off than this many cells belongs to none.
REACH_CELLS = 1.5
# What one scan may say of a cell: 10 mm; squares of ten million scans still fit 64 bits.
MOST_UNITS = 100_000
# The quickest: most columns are zero at most cells, and pack well.
PACKING = 1
CELL_COLUMNS = ("seen", "missing", "excess", "deviation", "squared", "missing_mm3", "excess_mm3")


@dataclass(frozen=True)
class PartCells:
    """Places on a template's surface, the same wherever they are asked for.

    Attributes
    ----------
    place_mm, normal
        (k, 3) each, template frame.
    """

    place_mm: Float[np.ndarray, "k 3"]
    normal: Float[np.ndarray, "k 3"]
    spacing_mm: float

    @classmethod
    def of(cls, template: Template) -> PartCells:
        """Those of a template."""
        diagonal_mm = diagonal(template.bounds_mm)
        spacing_mm = diagonal_mm / CELLS_PER_DIAGONAL
        place_mm, normal = template.surface_points(spacing_mm)
        return cls(np.array(place_mm), np.array(normal), spacing_mm)

    def __len__(self) -> int:
        return len(self.place_mm)

    def nearest(self, points_mm: Points) -> Numbers:
        """(n,) the cell that each point belongs to, −1 where it lies too far off."""
        return nearest_within(points_mm, self.place_mm, REACH_CELLS * self.spacing_mm)

    @cached_property
    def tree(self) -> cKDTree:
        """Of the places."""
        return cKDTree(self.place_mm)


@dataclass(frozen=True, slots=True)
class CellSums:
    """Sums over scans, by cell.

    Attributes
    ----------
    table
        (k, 7) in the order of `CELL_COLUMNS`: scans that saw the cell, that found something
        missing or too much there, Σ of their mean deviations and of its squares in units of
        0.1 µm, and the volumes of regions there in units of 10⁻⁶ mm³.
    """

    table: Int[np.ndarray, "k 7"]

    @classmethod
    def zero(cls, count: int) -> CellSums:
        """Of no scan."""
        return cls(np.zeros((count, len(CELL_COLUMNS)), np.int64))

    def __add__(self, other: CellSums) -> CellSums:
        if self.table.shape != other.table.shape:
            raise InputError(
                f"sums of {len(other.table)} cells cannot be added to those of {len(self.table)}: "
                "they are of another template"
            )
        return CellSums(self.table + other.table)

    def column(self, name: str) -> Int[np.ndarray, " k"]:
        """(k,) one of the sums."""
        return self.table[:, CELL_COLUMNS.index(name)]

    def volume_mm3(self, name: str) -> Float[np.ndarray, " k"]:
        """(k,) volume of all scans together, mm³: `missing` or `excess`."""
        return UNIT_MM3 * self.column(f"{name}_mm3")

    def to_bytes(self) -> bytes:
        """Packed; the same sums give the same bytes."""
        by_column = np.ascontiguousarray(self.table.T, dtype="<i8")
        return zlib.compress(by_column.tobytes(), PACKING)

    @classmethod
    def from_bytes(cls, data: bytes) -> CellSums:
        """As `to_bytes` wrote them."""
        flat = np.frombuffer(zlib.decompress(data), dtype="<i8").astype(np.int64)
        return cls(flat.reshape(len(CELL_COLUMNS), -1).T.copy())


def sums_of(
    anomaly: AnomalyMap,
    regions: Sequence[Region],
    centres_mm: Float[np.ndarray, "r 3"],
    cells: PartCells,
) -> CellSums:
    """What one scan says of each cell.

    Parameters
    ----------
    regions, centres_mm
        Regions with their volumes, and (r, 3) where they are, template frame.
    """
    count = len(cells)
    near = cells.nearest(anomaly.points_mm)
    marked = anomaly.label != int(Label.OK)
    # points of the bed, strays and clutter are OK by label, however far they lie
    part = (near >= 0) & (marked | (np.abs(anomaly.deviation_mm) < anomaly.threshold_mm))
    units = np.rint(anomaly.deviation_mm[part] / UNIT_MM).astype(np.int64)
    units = np.clip(units, -MOST_UNITS, MOST_UNITS)
    at, label = near[part], anomaly.label[part]
    points = np.bincount(at, minlength=count)
    total = np.zeros(count, np.int64)
    np.add.at(total, at, units)
    mean = np.where(points > 0, _rounded(total, np.maximum(points, 1)), 0)
    sums = CellSums.zero(count)
    table = sums.table
    gone = _cells_of(cells, anomaly, Label.MISSING)
    for name, which in (("missing", Label.MISSING), ("excess", Label.EXCESS)):
        found = np.bincount(at[label == int(which)], minlength=count) > 0
        table[:, CELL_COLUMNS.index(name)] = found | gone if which is Label.MISSING else found
    table[:, 0] = (points > 0) | gone
    table[:, 3], table[:, 4] = mean, mean * mean
    _add_volumes(sums, regions, centres_mm, cells)
    return sums


def _rounded(total: Int[np.ndarray, " k"], count: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """Quotients to the nearest whole number."""
    return (2 * total + count) // (2 * count)


def _cells_of(cells: PartCells, anomaly: AnomalyMap, label: Label) -> np.ndarray:
    """(k,) cells at which the template's own surface has a label: what is gone has no points."""
    near = cells.nearest(anomaly.template_points_mm[anomaly.template_label == int(label)])
    return np.bincount(near[near >= 0], minlength=len(cells)) > 0


def _add_volumes(
    sums: CellSums,
    regions: Sequence[Region],
    centres_mm: Float[np.ndarray, "r 3"],
    cells: PartCells,
) -> None:
    """Share each region's volume among the cells that were found to have it."""
    tree = cells.tree
    for region, centre_mm in zip(regions, centres_mm, strict=True):
        name = "missing" if region.label is Label.MISSING else "excess"
        half_mm = 0.5 * diagonal(np.asarray(region.box_mm))
        around = np.array(tree.query_ball_point(centre_mm, half_mm + cells.spacing_mm), np.int64)
        held = np.sort(around[sums.column(name)[around] > 0]) if len(around) else around
        if not len(held):
            held = np.array([int(tree.query(centre_mm)[1])])
        whole = round(region.volume_mm3 / UNIT_MM3)
        share = np.full(len(held), whole // len(held), np.int64)
        share[: whole % len(held)] += 1  # nothing is lost by rounding
        sums.column(f"{name}_mm3")[held] += share
