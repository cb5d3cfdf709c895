"""What beads stand as: one prediction, for the planner and for the checker."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcode.check import sweep_kernels
from gcode.surfaces import HeightField
from gcode.surfaces.standing import LEAST_HIGH_MM, half_widths_mm, with_beads

CELL_MM, SHAPE, CORNER = 0.13, (60, 70), np.array([1.0, 2.0])
BORE_MM = 0.4


def beads(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Some, level and climbing, long and no longer than a dot."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(0, 12, (6, 3))
    end = start + rng.normal(scale=3.0, size=(6, 3)) * rng.integers(0, 2, (6, 1))
    end[:3, 2] = start[:3, 2]
    return start, end, rng.uniform(0.0, 0.2, 6)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_bead_stands_within_half_its_width_as_high_as_its_nozzle(seed: int) -> None:
    start, end, section = beads(seed)
    bare = HeightField(CORNER, CELL_MM, np.zeros(SHAPE), np.ones(SHAPE, bool))
    found = with_beads(bare, start, end, section, BORE_MM)
    x, y = bare.centres_mm()
    least, most = np.zeros(SHAPE), np.zeros(SHAPE)
    for a, b, half in zip(start, end, half_widths_mm(section, BORE_MM), strict=True):
        for at in a + np.linspace(0.0, 1.0, 400)[:, None] * (b - a):
            off = np.hypot(x - at[0], (y - at[1])[:, None])
            least[off <= half] = np.maximum(least[off <= half], at[2])
            near = off <= half + 0.05  # between two of the places
            most[near] = np.maximum(most[near], at[2] + 0.1)
    assert (found.z_mm >= least - 1e-9).all()
    assert (found.z_mm <= most).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_checker_sweeps_over_what_the_planner_predicts(seed: int) -> None:
    # regression: the planner took beads for one cell wider, and both had a rule of their own
    start, end, section = beads(seed)
    grown = np.zeros(SHAPE)
    need = np.full(SHAPE, -np.inf)
    tip = np.array([[0, 0, 0]])  # the tip alone, one cell wide
    sweep_kernels.sweep(
        start, end, np.ones(len(start), np.int64), half_widths_mm(section, BORE_MM), grown, CORNER,
        CELL_MM, np.array([0.0]), np.array([0]), need, np.zeros(SHAPE, np.int8), tip,
        np.array([0, 1]),
    )  # fmt: skip
    bare = HeightField(CORNER, CELL_MM, np.zeros(SHAPE), np.ones(SHAPE, bool))
    assert np.array_equal(grown, with_beads(bare, start, end, section, BORE_MM).z_mm)


@pytest.mark.parametrize(("section_mm2", "half_mm"), [(0.0, 0.0), (0.09, 0.225), (1.0, 0.4)])
def test_a_bead_is_as_wide_as_its_plastic_and_no_wider_than_two_bores(
    section_mm2: float, half_mm: float
) -> None:
    assert LEAST_HIGH_MM == 0.2
    assert half_widths_mm(np.array([section_mm2]), BORE_MM)[0] == pytest.approx(half_mm)
