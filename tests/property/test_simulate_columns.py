"""Columns as sets: any sequence of unions and cuts equals the same on a fine raster."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from amrepair.simulate.columns import Columns, IntervalMap, Window

STEPS = 40
ends = st.tuples(st.integers(0, STEPS - 1), st.integers(1, 12), st.booleans())


def single(columns: Columns, low: float, high: float) -> IntervalMap:
    window = Window(columns.origin_mm, columns.cell_mm, 0, 1, 0, 1)
    return IntervalMap(window, np.array([0, 1]), np.array([[low, high]]))


def build(edits: list[tuple[int, int, bool]]) -> tuple[Columns, np.ndarray]:
    columns = Columns(origin_mm=(0.0, 0.0), size_mm=(1.0, 1.0), cell_mm=1.0)
    raster = np.zeros(STEPS + 12, dtype=bool)
    for low, length, is_added in edits:
        span = single(columns, float(low), float(low + length))
        before = raster.sum()
        raster[low : low + length] = is_added
        changed = columns.unite(span) if is_added else columns.cut(span)
        assert changed == abs(int(raster.sum()) - int(before))
    return columns, raster


def spans_of(raster: np.ndarray) -> np.ndarray:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], raster.astype(int), [0]])))
    return edges.reshape(-1, 2).astype(float)


@given(st.lists(ends, max_size=25))
def test_unions_and_cuts_are_those_of_sets(edits: list[tuple[int, int, bool]]) -> None:
    columns, raster = build(edits)
    window = Window(columns.origin_mm, columns.cell_mm, 0, 1, 0, 1)
    np.testing.assert_array_equal(columns.snapshot(window).spans_mm, spans_of(raster))


@given(st.lists(ends, max_size=15), st.lists(ends, max_size=15))
def test_volume_splits_into_difference_and_intersection(
    first: list[tuple[int, int, bool]], second: list[tuple[int, int, bool]]
) -> None:
    window = Window((0.0, 0.0), 1.0, 0, 1, 0, 1)
    a_columns, a_raster = build(first)
    b_columns, b_raster = build(second)
    a, b = a_columns.snapshot(window), b_columns.snapshot(window)
    np.testing.assert_array_equal(a.minus(b).spans_mm, spans_of(a_raster & ~b_raster))
    np.testing.assert_array_equal(a.common(b).spans_mm, spans_of(a_raster & b_raster))
    assert a.volume_mm3 == a.minus(b).volume_mm3 + a.common(b).volume_mm3
