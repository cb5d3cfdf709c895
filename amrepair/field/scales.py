"""Scales: robust local means of the deviations, over wider and wider windows.

From scale to scale cells double in width. The value of a wider cell is the median of the cells in
it, and a window is a cell with those neighbours that face the same way, so that the two sides of a
thin wall are not mixed. This module measures; `regions` decides what is significant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from amrepair.arrays import Mask, Numbers, Points, Values
from amrepair.field import scales_kernels as kernels
from amrepair.field.groups import cell_numbers
from amrepair.frames import cells_of, unit_vectors

# Neighbours of one window face within 60° of each other: a curved surface is one, the two sides
# of a wall and the faces of an edge are not.
WINDOW_FACING = 0.5
# The third lowest and third highest cell of a window count: three cells are a surface, two chance.
RANK = 3
# Cells of a surface hold two points on average; strays lie in a cell of their own each.
CELL_POINTS = 2.0
# The weight of a point of what is no surface, beside points of what is: next to none.
NOTHING = 1e-6


@dataclass(frozen=True, slots=True)
class Scale:
    """All windows of one width, one around each cell, template frame.

    Attributes
    ----------
    cell_mm
        The edge of a cell at this scale.
    of_base
        (b,) for each of the original cells the cell of this scale that it lies in.
    place_mm, normal
        (s, 3) weighted mean place and outward unit normal of each cell.
    value_mm
        (s,) the median deviation of the narrower cells in it.
    weight, window_weight
        (s,) the number of observations in each cell, and in each window.
    table, count
        (s, k) the cells of each window, itself included, and (s,) how many there are.
    median_mm, low_mm, high_mm
        (s,) the median, the `RANK`-th lowest and the `RANK`-th highest value of each window.
    noise_mm
        (s,) standard deviation of a cell's value about those of its neighbours.
    apart
        (s,) windows of cells that are kept apart from all others (broken ends of walls).
    """

    cell_mm: float
    of_base: Int[np.ndarray, " b"]
    place_mm: Points
    normal: Points
    value_mm: Values
    weight: Values
    table: Int[np.ndarray, "s k"]
    count: Numbers
    median_mm: Values
    low_mm: Values
    high_mm: Values
    noise_mm: Values
    window_weight: Values
    apart: Mask

    def __len__(self) -> int:
        return len(self.value_mm)

    @property
    def width_mm(self) -> float:
        """The width of a window: a cell and its neighbours."""
        return 3.0 * self.cell_mm

    def cells_of(self, chosen: Mask) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
        """All pairs of a chosen window and a cell in it: (p,) windows and (p,) cells."""
        which = np.flatnonzero(chosen)
        inside = np.arange(self.table.shape[1]) < self.count[which, None]
        return which[np.nonzero(inside)[0]], self.table[which][inside]

    @property
    def is_surface(self) -> Mask:
        """(s,) whether a window holds surface: `RANK` cells or more, of `CELL_POINTS` on average.

        Stray points in the air also share a window now and then, but each in a cell of its own.
        """
        return np.asarray((self.count >= RANK) & (self.window_weight >= CELL_POINTS * self.count))


def scales_of(
    place_mm: Points,
    normal: Points,
    value_mm: Values,
    weight: Values,
    *,
    cell_mm: float,
    widest_mm: float,
    apart: Mask | None = None,
) -> tuple[Scale, ...]:
    """Make the scales, from cells of `cell_mm` up to windows of `widest_mm`.

    What is no surface at one scale may be one at a wider: a place that was seen sparsely. It counts
    in the wider cells that hold nothing else; beside surface it is strays.

    Parameters
    ----------
    place_mm, normal, value_mm, weight
        Of the original cells: places, outward unit normals of the template, deviations, and numbers
        of observations.
    widest_mm
        The largest width of a window; only the first scale's may be wider.
    apart
        Cells that share no window with the others; None where there are none.
    """
    found: list[Scale] = []
    of_base = np.arange(len(place_mm))
    alone = np.zeros(len(place_mm), bool) if apart is None else apart
    inner = (place_mm, normal, value_mm, weight.astype(np.float64), alone)
    size_mm = cell_mm
    while True:
        scale = _scale(of_base, *inner, size_mm, medians=bool(found))
        found.append(scale)
        if 2.0 * 3.0 * size_mm > widest_mm or len(scale) <= kernels.MOST_NEIGHBOURS:
            return tuple(found)
        of_base = scale.of_base
        weight = np.where(scale.is_surface, scale.weight, NOTHING * scale.weight)
        inner = (scale.place_mm, scale.normal, scale.value_mm, weight, scale.apart)
        size_mm *= 2.0


def _scale(
    of_base: Int[np.ndarray, " b"],
    place_mm: Points,
    normal: Points,
    value_mm: Values,
    weight: Values,
    apart: Mask,
    cell_mm: float,
    *,
    medians: bool,
) -> Scale:
    """Group the cells of the narrower scale to wider ones, and form their windows."""
    order, start, keys, strides = _grouped(place_mm, normal, apart, cell_mm)
    group = np.empty(len(order), np.int64)
    group[order] = np.repeat(np.arange(len(start) - 1), np.diff(start))
    first = start[:-1]
    total = np.add.reduceat(weight[order], first)
    place = np.add.reduceat((place_mm * weight[:, None])[order], first) / total[:, None]
    facing = unit_vectors(np.add.reduceat((normal * weight[:, None])[order], first))
    value = (
        kernels.group_medians(order, start, value_mm, weight)
        if medians
        else np.add.reduceat((value_mm * weight)[order], first) / total
    )
    total = np.where(total < 0.5, total / NOTHING, total)  # a point that counts weighs 1
    table, count = kernels.neighbours(keys, *strides, facing, value, WINDOW_FACING, 0.5 * cell_mm)
    median, low, high, noise, around = kernels.window_statistics(
        table, count, place, value, total, RANK
    )
    noise = kernels.window_medians(table, count, noise)
    known = noise[np.isfinite(noise)]
    noise[~np.isfinite(noise)] = float(np.median(known)) if len(known) else 0.0
    return Scale(
        cell_mm=cell_mm,
        of_base=group[of_base],
        place_mm=place,
        normal=facing,
        value_mm=value,
        weight=total,
        table=table,
        count=count,
        median_mm=median,
        low_mm=low,
        high_mm=high,
        noise_mm=noise,
        window_weight=around,
        apart=keys % kernels.SLOTS == kernels.APART,
    )


def ways_of(normal: Points) -> Numbers:
    """(c,) the axis direction that a normal is nearest to: −x, x, −y, y, −z, z; 6 for none."""
    axis = np.abs(normal).argmax(axis=1)
    most = normal[np.arange(len(normal)), axis]
    return np.where(most == 0.0, 6, 2 * axis + (most > 0))


def faced_places(place_mm: Points, normal: Points, cell_mm: float) -> Numbers:
    """(c,) a number from 0 for each place of a surface: a cell, and the way that it faces."""
    return cell_numbers(np.column_stack([cells_of(place_mm, 0.0, cell_mm), ways_of(normal)]))


def _grouped(
    place_mm: Points, normal: Points, apart: Mask, cell_mm: float
) -> tuple[Numbers, Int[np.ndarray, " s1"], Int[np.ndarray, " s"], tuple[int, int]]:
    """Sort cells by the wider cell that holds them: order, where each begins, keys, strides."""
    index = cells_of(place_mm, place_mm.min(axis=0), cell_mm) + 1
    shape = index.max(axis=0) + 2
    strides = (int(shape[1] * shape[2]), int(shape[2]))
    way = np.where(apart, kernels.APART, ways_of(normal))
    key = (index @ np.array([*strides, 1])) * kernels.SLOTS + way
    order = np.argsort(key, kind="stable")
    ranked = key[order]
    begins = np.flatnonzero(np.r_[True, ranked[1:] != ranked[:-1]])
    return order, np.append(begins, len(ranked)), ranked[begins], strides
