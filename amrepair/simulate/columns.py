"""Columns of solid: what the simulated world is made of, and flat pictures of it to compare.

`Columns` grows and is cut; `IntervalMap` is a read-only window of it with set operations. Beads,
defects and scanners live elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import manifold3d
import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from amrepair.arrays import Box, HeightMap
from amrepair.errors import InputError
from amrepair.simulate import columns_kernels as kernels
from gcode.meshes import mesh_of
from gcode.surfaces.raster_kernels import column_crossings

_FIRST_POOL = 1 << 16


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangle of columns, half-open: rows [y0, y1), columns [x0, x1) of a grid.

    Attributes
    ----------
    origin_mm
        XY of the corner of the *grid's* cell [0, 0], build frame.
    cell_mm
        Edge of a column.
    """

    origin_mm: tuple[float, float]
    cell_mm: float
    y0: int
    y1: int
    x0: int
    x1: int

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        return max(0, self.y1 - self.y0), max(0, self.x1 - self.x0)

    @property
    def corner_mm(self) -> tuple[float, float]:
        """XY of the window's lowest corner, build frame."""
        return (
            self.origin_mm[0] + self.x0 * self.cell_mm,
            self.origin_mm[1] + self.y0 * self.cell_mm,
        )


@dataclass(frozen=True, slots=True)
class IntervalMap:
    """Solid z-intervals by column over a window, read-only.

    Attributes
    ----------
    window
        Which columns, row by row.
    offsets
        (n + 1,) where each column's intervals begin in `spans_mm`.
    spans_mm
        (m, 2) lower and upper end of each interval, rising within a column, build frame.
    """

    window: Window
    offsets: Int[np.ndarray, " k"]
    spans_mm: Float[np.ndarray, "m 2"]

    @property
    def volume_mm3(self) -> float:
        """Volume of all intervals."""
        lengths_mm = self.spans_mm[:, 1] - self.spans_mm[:, 0]
        return float(lengths_mm.sum()) * self.window.cell_mm**2

    def minus(self, other: IntervalMap) -> IntervalMap:
        """What is solid here and not there, over the same window."""
        self._meet(other)
        offsets, spans = kernels.subtract_flat(
            self.offsets, self.spans_mm, other.offsets, other.spans_mm
        )
        return IntervalMap(self.window, offsets, spans)

    def common(self, other: IntervalMap) -> IntervalMap:
        """What is solid in both, over the same window."""
        self._meet(other)
        offsets, spans = kernels.intersect_flat(
            self.offsets, self.spans_mm, other.offsets, other.spans_mm
        )
        return IntervalMap(self.window, offsets, spans)

    def thickness_mm(self, z_low_mm: float = -np.inf, z_high_mm: float = np.inf) -> HeightMap:
        """(ny, nx) solid length of each column between two heights."""
        column = np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))
        low, high = np.clip(self.spans_mm, z_low_mm, z_high_mm).T
        length = np.bincount(column, high - low, len(self.offsets) - 1)
        return length.astype(np.float64, copy=False).reshape(self.window.shape)  # ints of no spans

    def top_mm(self) -> HeightMap:
        """(ny, nx) height of the highest solid; 0, the bed, where there is none."""
        top = np.zeros(len(self.offsets) - 1)
        filled = np.diff(self.offsets) > 0
        top[filled] = self.spans_mm[self.offsets[1:][filled] - 1, 1]
        return top.reshape(self.window.shape)

    def clipped(self, box_mm: Box) -> IntervalMap:
        """What lies within a box, by column centre in XY and exactly in Z; the same window."""
        lows = np.maximum(self.spans_mm[:, 0], box_mm[0, 2])
        highs = np.minimum(self.spans_mm[:, 1], box_mm[1, 2])
        column = np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))
        ny, nx = self.window.shape
        corner = self.window.corner_mm
        x_mm = corner[0] + (column % max(nx, 1) + 0.5) * self.window.cell_mm
        y_mm = corner[1] + (column // max(nx, 1) + 0.5) * self.window.cell_mm
        keep = (
            (highs > lows)
            & (x_mm >= box_mm[0, 0])
            & (x_mm <= box_mm[1, 0])
            & (y_mm >= box_mm[0, 1])
            & (y_mm <= box_mm[1, 1])
        )
        offsets = np.concatenate([[0], np.cumsum(np.bincount(column[keep], minlength=ny * nx))])
        return IntervalMap(self.window, offsets, np.stack([lows[keep], highs[keep]], axis=1))

    def bounds_mm(self) -> Box | None:
        """(2, 3) box around all intervals, build frame; None where there are none."""
        if len(self.spans_mm) == 0:
            return None
        nx = self.window.shape[1]
        filled = np.flatnonzero(np.diff(self.offsets))
        x0, y0 = self.window.corner_mm
        cell = self.window.cell_mm
        iy, ix = filled // nx, filled % nx
        low = (x0 + ix.min() * cell, y0 + iy.min() * cell, self.spans_mm[:, 0].min())
        high = (x0 + (ix.max() + 1) * cell, y0 + (iy.max() + 1) * cell, self.spans_mm[:, 1].max())
        return np.array([low, high])

    def apart_mm(self, margin_mm: float) -> Float[np.ndarray, "k 2 3"]:
        """Boxes of what stands apart: a part, the line that primes the nozzle at the bed's edge.

        What is not more than two margins from one another is in one box. The boxes are in the
        build frame, without the margin.
        """
        ny, nx = self.window.shape
        filled = (np.diff(self.offsets) > 0).reshape(ny, nx)
        reach = 2 * round(margin_mm / self.window.cell_mm) + 1
        near = ndimage.maximum_filter(filled, size=reach, mode="constant")
        labels, _ = ndimage.label(near, structure=np.ones((3, 3), dtype=bool))
        labels[~filled] = 0
        top_mm, corner_mm = self.top_mm(), np.array(self.window.corner_mm)
        boxes = []
        for label, (rows, columns) in enumerate(ndimage.find_objects(labels), start=1):
            high_mm = top_mm[rows, columns][labels[rows, columns] == label].max()
            low = corner_mm + self.window.cell_mm * np.array([columns.start, rows.start])
            high = corner_mm + self.window.cell_mm * np.array([columns.stop, rows.stop])
            boxes.append([[*low, 0.0], [*high, high_mm]])
        return np.array(boxes).reshape(-1, 2, 3)

    def _meet(self, other: IntervalMap) -> None:
        if self.window != other.window:
            raise InputError(
                f"two interval maps can be compared only over one window, these cover "
                f"{self.window} and {other.window}"
            )


class Columns:
    """Solid z-intervals over a grid of square columns, in continuous z.

    Parameters
    ----------
    origin_mm, size_mm
        XY corner and extent of the grid, build frame.
    cell_mm
        Edge of a column.
    """

    def __init__(
        self, *, origin_mm: tuple[float, float], size_mm: tuple[float, float], cell_mm: float
    ) -> None:
        self.origin_mm = origin_mm
        self.cell_mm = cell_mm
        self.shape = (int(np.ceil(size_mm[1] / cell_mm)), int(np.ceil(size_mm[0] / cell_mm)))
        self.hi = np.zeros(self.shape)
        self.lo = np.zeros(self.shape)
        self.nxt = np.zeros(self.shape, dtype=np.int32)
        self.pool = np.empty((_FIRST_POOL, 2))
        self.pool_next = np.zeros(_FIRST_POOL, dtype=np.int32)
        self.meta = np.array([1, 0], dtype=np.int64)
        self.touched = np.array([self.shape[0], -1, self.shape[1], -1], dtype=np.int64)

    @property
    def arrays(self) -> tuple[Any, ...]:
        """The arrays in the order that the kernels take them."""
        return self.hi, self.lo, self.nxt, self.pool, self.pool_next, self.meta

    def window(self, margin_mm: float = 0.0) -> Window:
        """The columns in use, and a margin around them."""
        pad = int(np.ceil(margin_mm / self.cell_mm))
        y0, y1, x0, x1 = (int(value) for value in self.touched)
        if y1 < 0:
            return Window(self.origin_mm, self.cell_mm, 0, 0, 0, 0)
        return Window(
            self.origin_mm,
            self.cell_mm,
            max(0, y0 - pad),
            min(self.shape[0], y1 + 1 + pad),
            max(0, x0 - pad),
            min(self.shape[1], x1 + 1 + pad),
        )

    def box_window(self, low_mm: tuple[float, float], high_mm: tuple[float, float]) -> Window:
        """The columns that a rectangle of the build frame touches."""
        x0 = int(np.floor((low_mm[0] - self.origin_mm[0]) / self.cell_mm))
        y0 = int(np.floor((low_mm[1] - self.origin_mm[1]) / self.cell_mm))
        x1 = int(np.ceil((high_mm[0] - self.origin_mm[0]) / self.cell_mm))
        y1 = int(np.ceil((high_mm[1] - self.origin_mm[1]) / self.cell_mm))
        ny, nx = self.shape
        x0, x1 = np.clip((x0, x1), 0, nx).tolist()
        y0, y1 = np.clip((y0, y1), 0, ny).tolist()
        return Window(self.origin_mm, self.cell_mm, y0, y1, x0, x1)

    def snapshot(self, window: Window | None = None) -> IntervalMap:
        """The intervals of a window (default: all in use) as they are now."""
        window = self.window() if window is None else window
        hi, lo, nxt, pool, pool_next, _ = self.arrays
        offsets, spans = kernels.flatten(
            hi, lo, nxt, pool, pool_next, window.y0, window.y1, window.x0, window.x1
        )
        return IntervalMap(window, offsets, spans)

    def unite(self, added: IntervalMap) -> float:
        """Add intervals; returns the volume that was not solid before, mm³."""
        return self._merge(added, subtract=False)

    def cut(self, removed: IntervalMap) -> float:
        """Take intervals away; returns the volume removed, mm³."""
        return self._merge(removed, subtract=True)

    def rasterise(self, solid: manifold3d.Manifold) -> IntervalMap:
        """A solid of the build frame as intervals along the column centres; cut at the bed."""
        x0, y0, _, x1, y1, _ = solid.bounding_box()
        window = self.box_window((x0, y0), (x1, y1))
        ny, nx = window.shape
        crossed, z, _ = column_crossings(*mesh_of(solid), *window.corner_mm, self.cell_mm, nx, ny)
        offsets, spans = kernels.paired(crossed, z)
        return IntervalMap(window, offsets, spans)

    def copy(self) -> Columns:
        """An independent copy."""
        twin = Columns.__new__(Columns)
        twin.origin_mm, twin.cell_mm, twin.shape = self.origin_mm, self.cell_mm, self.shape
        twin.hi, twin.lo = np.zeros(self.shape), np.zeros(self.shape)
        twin.nxt = np.zeros(self.shape, dtype=np.int32)
        used = self.window(margin_mm=10.0)  # plastic spreads a little beyond the nozzle's path
        rows, cols = slice(used.y0, used.y1), slice(used.x0, used.x1)
        for target, source in ((twin.hi, self.hi), (twin.lo, self.lo), (twin.nxt, self.nxt)):
            target[rows, cols] = source[rows, cols]
        twin.pool, twin.pool_next = self.pool.copy(), self.pool_next.copy()
        twin.meta, twin.touched = self.meta.copy(), self.touched.copy()
        return twin

    def touch(self, window: Window) -> None:
        """Note that a window may have been changed."""
        if window.shape[0] and window.shape[1]:
            self.touched[0] = min(self.touched[0], window.y0)
            self.touched[1] = max(self.touched[1], window.y1 - 1)
            self.touched[2] = min(self.touched[2], window.x0)
            self.touched[3] = max(self.touched[3], window.x1 - 1)

    def _merge(self, change: IntervalMap, *, subtract: bool) -> float:
        window = change.window
        if (window.origin_mm, window.cell_mm) != (self.origin_mm, self.cell_mm):
            raise InputError("intervals can be merged only into columns of their own grid")
        merge: Any = kernels.merge_flat
        self.pool, self.pool_next, changed = merge(
            *self.arrays,
            window.y0,
            window.x0,
            window.shape[1],
            change.offsets,
            change.spans_mm,
            subtract,
        )
        self.touch(window)
        return float(changed) * self.cell_mm**2
