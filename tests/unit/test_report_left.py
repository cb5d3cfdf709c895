"""What a repair leaves is told by cause with its volume, and drawn where it is."""

from __future__ import annotations

from dataclasses import replace

import manifold3d as m3
import numpy as np
import pytest

import gcode
from amrepair.report.data import ReportData
from amrepair.report.left import LEFT_KEYS, left_parts, shape_of
from amrepair.report.page import body
from amrepair.report.payload import payload
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch import LeftCause, LeftColumns, PatchPlan, slice_patch
from gcode.surfaces import HeightField
from tests.report_example import example

SETUP = gcode.load_setup()
GROOVE = m3.Manifold.cube((1.6, 16.0, 20.0)).translate((65.0, 62.0, 5.0))


@pytest.fixture(scope="module")
def patch() -> PatchPlan:
    """A groove hardly wider than the nozzle's flat: its foot is out of reach."""
    block = m3.Manifold.cube((20.0, 20.0, 6.0)).translate((60.0, 60.0, 0.0))
    field = HeightField.from_manifold(block - GROOVE, 0.1, margin_mm=8.0)
    grid = LayerGrid.from_setup(SETUP)
    return slice_patch(GROOVE ^ block, SETUP, as_built=field, grid=grid, standalone=True)


def test_columns_hold_what_is_told(patch: PatchPlan) -> None:
    told_mm3 = sum(each.volume_mm3 for each in (*patch.unreachable, *patch.unprintable))
    drawn_mm3 = {each.cause: each.volume_mm3 for each in patch.left}
    assert told_mm3 > 1.0
    assert sum(drawn_mm3.values()) == pytest.approx(told_mm3, rel=0.01)
    assert max(drawn_mm3, key=lambda cause: drawn_mm3[cause]) is LeftCause.OUT_OF_REACH


def test_columns_lie_where_nothing_is_filled(patch: PatchPlan) -> None:
    for each in patch.left:
        assert (each.low_mm >= 5.0 - 1e-9).all()
        assert (each.high_mm <= 6.0 + 1e-9).all()
        assert (each.high_mm > each.low_mm).all()
        low, high = np.array([65.0, 62.0]), np.array([66.6, 78.0])
        assert ((each.middle_mm >= low) & (each.middle_mm <= high)).all()


@pytest.mark.parametrize("most", [40, 4_000])
def test_boxes_hold_as_much_as_columns(patch: PatchPlan, most: int) -> None:
    for each in patch.left:
        shape = shape_of(each, most)
        assert len(shape.faces) <= 12 * most
        corners = shape.vertices_mm[shape.faces]
        volume_mm3 = float(np.linalg.det(corners).sum()) / 6.0  # above 0: seen from outside
        assert volume_mm3 == pytest.approx(each.volume_mm3, rel=1e-6)


def left_in_example(patch: PatchPlan) -> ReportData:
    data = example().data if hasattr(example(), "data") else example()
    looks = (replace(data.looks[0], left=left_parts(patch.left)), *data.looks[1:])
    return replace(data, looks=looks)


def test_page_and_drawing_have_each_cause(patch: PatchPlan) -> None:
    data = left_in_example(patch)
    page, looks = body(data), payload(data)["looks"]
    assert "What repairs leave" in page
    for each in patch.left:
        assert LEFT_KEYS[each.cause] in looks[0]  # type: ignore[index, operator]
        assert f'class="dot {LEFT_KEYS[each.cause]}"' in page
    without = replace(data, looks=tuple(replace(look, left=()) for look in data.looks))
    assert "What repairs leave" not in body(without)
    assert not set(LEFT_KEYS.values()) & set(payload(without)["looks"][0])  # type: ignore[index]


def test_columns_apart_stay_apart() -> None:
    middle = np.array([[0.05, 0.05], [5.05, 0.05]])
    columns = LeftColumns(LeftCause.COVERED, 0.1, middle, np.zeros(2), np.array([1.0, 2.0]))
    shape = shape_of(columns)
    assert len(shape.faces) == 24
    assert shape.vertices_mm.max(axis=0) == pytest.approx([5.1, 0.1, 2.0])
