"""`RangeGrid`: which pixel of a range image saw which point, and what that tells of the points.

A range image has one depth a pixel. So it knows what a bare cloud does not: where nothing came
back (a gap), where the seen surface ends or jumps (an edge), and which points hang in the air
between the near and the far side of a jump (flying pixels: the beam fell on both sides, and the
sensor told something in between).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Int32, UInt8

from amrepair.arrays import Box, Numbers, Points, Values
from amrepair.errors import InputError
from amrepair.scans import range_grid_kernels as kernels

EDGE, FLYING = kernels.EDGE, kernels.FLYING
Kind = Literal["perspective", "orthographic", "pushbroom", "unknown"]
NO_POINT = -1
STEEPEST = float(np.tan(np.deg2rad(80.0)))
"""Depth over lateral distance up to which two neighbours are one surface: beyond 80° from its
normal few sensors get a signal back, and what comes is unsure; `detect` stops believing its rays
there too."""


@dataclass(frozen=True, slots=True)
class RangeGrid:
    """One view's pixels.

    Attributes
    ----------
    index
        (rows, columns) the scan's point at each pixel, -1 for a gap.
    kind
        How the pixels' rays run: `perspective` (they meet in the sensor, also where the pixels
        are angles), `orthographic` (parallel), `pushbroom` (a sheet of light that moves along:
        parallel in one direction, meeting in the other) or `unknown`.

    Raises
    ------
    InputError
        If the index is no table of point numbers.
    """

    index: Int32[np.ndarray, "rows columns"]
    kind: Kind = "unknown"

    def __post_init__(self) -> None:
        if self.index.ndim != 2 or self.index.size == 0 or int(self.index.min()) < NO_POINT:
            raise InputError(
                f"a range grid needs rows and columns of point numbers, -1 for a gap; this one "
                f"has shape {self.index.shape}"
            )
        self.index.setflags(write=False)

    @classmethod
    def of_seen(
        cls, seen: Bool[np.ndarray, "rows columns"], kind: Kind = "unknown", *, first: int = 0
    ) -> RangeGrid:
        """A grid whose seen pixels are the points from `first` on, row after row."""
        index = np.full(seen.shape, NO_POINT, np.int32)
        index[seen] = np.arange(first, first + np.count_nonzero(seen), dtype=np.int32)
        return cls(index, kind)

    @property
    def points(self) -> Int32[np.ndarray, " m"]:
        """(m,) the points of the seen pixels, row after row."""
        return self.index[self.index >= 0]


@dataclass(frozen=True, slots=True)
class GridDepths:
    """A scan's points as one of its grids sees them.

    Attributes
    ----------
    depth
        (n,) away from the sensor; where the sensor is not known, along the grid's mean normal
        (then its sign says nothing). The scan's unit.
    spacing
        (n,) from a point's ray to the next column's, at the point.
    row_ratio
        What the next row's is of that.
    """

    depth: Values
    spacing: Values
    row_ratio: float


def edge_flags(
    points_mm: Points,
    grids: tuple[RangeGrid, ...],
    sensors_mm: Float[np.ndarray, "k 3"] | None = None,
    sensor_index: Numbers | None = None,
) -> UInt8[np.ndarray, " n"]:
    """Which points lie at an edge, and which of them fly.

    `EDGE`: one of the eight pixels around is a gap, or lies beyond a jump of depth. The image's
    own border is no edge: the surface goes on there. `FLYING`: along a row, a column or a
    diagonal the next pixel on one side is nearer and on the other side farther, both by a jump;
    so it belongs to neither surface, and a wall seen more grazing than the limit is among them.

    Parameters
    ----------
    points_mm
        (n, 3) the scan's points; any unit, the limit is an angle.
    grids
        The scan's views.
    sensors_mm, sensor_index
        As in `Scan`; without them depth is taken along each grid's mean normal.

    Returns
    -------
    (n,) bits; 0 for points that no grid holds.
    """
    flags = np.zeros(len(points_mm), np.uint8)
    for grid in grids:
        seen = depths_of(points_mm, grid, sensors_mm, sensor_index)
        if seen is not None:
            kernels.mark_edges(
                grid.index, seen.depth, seen.spacing, seen.row_ratio, STEEPEST, flags
            )
    return flags


def depths_of(
    points_mm: Points,
    grid: RangeGrid,
    sensors_mm: Float[np.ndarray, "k 3"] | None = None,
    sensor_index: Numbers | None = None,
) -> GridDepths | None:
    """Depths and spacings; None where the grid has no two neighbours to measure a spacing."""
    steps = mean_steps(points_mm, grid)
    if steps is None:
        return None
    if sensors_mm is None or sensor_index is None:
        normal = np.cross(steps[0], steps[1])
        length = float(np.linalg.norm(normal))
        sizes = np.linalg.norm(steps, axis=1)
        if not length > 0 or not np.isfinite(sizes).all():
            return None
        spacing = np.full(len(points_mm), sizes[0])
        return GridDepths(points_mm @ (normal / length), spacing, float(sizes[1] / sizes[0]))
    rays = points_mm - sensors_mm[sensor_index]
    depth = np.linalg.norm(rays, axis=1)
    rays = rays / np.maximum(depth, np.finfo(float).tiny)[:, None]
    across = [_median_turn(rays, first, second) for first, second in _neighbours(grid)]
    if not all(turn > 0 for turn in across):
        return None
    return GridDepths(depth, depth * across[0], across[1] / across[0])


def mean_steps(points_mm: Points, grid: RangeGrid) -> Box | None:
    """How the points go on by a column and by a row, on average; None for fewer than three."""
    rows, columns = np.nonzero(grid.index >= 0)
    if len(rows) < 3:
        return None
    at = np.stack([np.ones(len(rows)), columns, rows], axis=1)
    fit = np.linalg.lstsq(at, points_mm[grid.index[rows, columns]], rcond=None)[0]
    return fit[1:]


def _neighbours(
    grid: RangeGrid,
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Pairs of points in neighbouring columns, and in neighbouring rows."""
    pairs = []
    for first, second in (
        (grid.index[:, :-1], grid.index[:, 1:]),
        (grid.index[:-1], grid.index[1:]),
    ):
        both = (first >= 0) & (second >= 0)
        pairs.append((first[both], second[both]))
    return pairs[0], pairs[1]


def _median_turn(
    rays: Points, first: Int[np.ndarray, " m"], second: Int[np.ndarray, " m"]
) -> float:
    """Median angle between pairs of rays, rad; 0 without pairs."""
    if len(first) == 0:
        return 0.0
    return float(np.median(np.linalg.norm(rays[first] - rays[second], axis=1)))
