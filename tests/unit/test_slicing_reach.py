"""Where the tip may go along straight pieces: the compiled loop against plain look-ups."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcode.check.sweep import deepest_along
from gcode.profiles import load_setup
from gcode.slicing import reach_kernels
from gcode.slicing.reach import HEXAGON_MM, PRESS_MM, Reach
from gcode.surfaces import HeightField


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_piece_is_free_where_all_that_rounding_makes_of_it_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ny, nx = (int(v) for v in rng.integers(1, 9, 2))
    free, corner, cell, little = rng.random((ny, nx)) < 0.8, rng.normal(size=2), 0.37, 0.002
    start, end = corner + rng.uniform(-1.0, 4.0, (2, 30, 2))
    shares = np.linspace(0.0, 1.0, 7)
    found = reach_kernels.free_along(start, end, shares, free, corner, cell, little)
    for a, b, ok in zip(start, end, found, strict=True):
        stuck = False
        for share in shares:
            for aside in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
                place = (a + (b - a) * share + little * np.array(aside) - corner) / cell
                ix, iy = (int(v) for v in np.floor(place))
                stuck |= 0 <= ix < nx and 0 <= iy < ny and not free[iy, ix]
        assert ok == (not stuck)


@pytest.mark.parametrize(
    ("printer", "tall_mm", "away_mm", "free"),
    [
        # the MK3S's rods, 28 mm over the tip, reach 31 mm behind it and across the bed
        ("prusa_mk3s", 40.0, (70.0, 25.0), False),
        ("prusa_mk3s", 40.0, (70.0, 40.0), True),
        ("prusa_mk3s", 27.0, (70.0, 25.0), True),
        # its extruder, 20 mm over the tip, 40 mm to the front and 34 to the side
        ("prusa_mk3s", 24.0, (0.0, -36.0), False),
        ("prusa_mk3s", 24.0, (0.0, -46.0), True),
        ("prusa_mk3s", 24.0, (38.0, 0.0), True),
        # the MK4's extruder is not the MK3S's: more room is kept for it
        ("prusa_mk4", 24.0, (38.0, 0.0), False),
        ("prusa_mini", 24.0, (38.0, 0.0), False),
        # an Ender's gantry, 25 mm over the tip
        ("ender_3", 30.0, (80.0, 0.0), False),
        ("ender_3", 24.0, (80.0, 0.0), True),
    ],
)
def test_a_tower_beside_a_low_place_keeps_off_what_would_hit_it(
    printer: str, tall_mm: float, away_mm: tuple[float, float], free: bool
) -> None:
    """A gantry said to be 60 mm over the tip would have gone through a part of 40."""
    here = np.array([125.0, 105.0])
    field = HeightField.flat((250.0, 210.0), 1.0)
    x, y = here + np.array(away_mm)
    z_mm = np.array(field.z_mm)
    z_mm[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2] = tall_mm
    window = (here[0] - 1.0, here[1] - 1.0, here[0] + 1.0, here[1] + 1.0)
    reach = Reach(field.raised(z_mm), load_setup(printer).printer, window_mm=window)
    assert bool(reach.at(0.2).all()) == free


def test_the_cone_keeps_off_a_wall_that_its_flat_passes() -> None:
    # regression: a wall 0.7 mm higher than the tip was passed at half a flat's width
    z_mm = np.zeros((60, 120))
    z_mm[:, 60:] = 5.0
    field = HeightField(np.zeros(2), 0.1, z_mm, np.ones((60, 120), dtype=bool))
    reach = Reach(field, load_setup(printer="prusa_mk3s").printer, finer=2)
    for below_mm, beside_mm in ((0.3, 0.8), (0.7, 1.2), (1.5, 2.0)):  # at 45°, from the flat's rim
        free = reach.at(5.0 - below_mm)[60]
        nearest_mm = 6.0 - 0.05 * (np.flatnonzero(free).max() + 1)
        assert nearest_mm == pytest.approx(beside_mm, abs=0.2)
        assert not free[round((6.0 - beside_mm + 0.2) / 0.05) :].any()


@pytest.mark.parametrize("turned_deg", [0.0, 8.0, 17.0, 33.0, 45.0])
def test_beside_a_wall_the_cone_goes_as_deep_as_meant_and_a_cell_deeper_at_most(
    turned_deg: float,
) -> None:
    # regression: on the cells of the field it was from 0.05 mm too high to 0.15 too deep
    across = np.array([np.cos(np.radians(turned_deg)), np.sin(np.radians(turned_deg))])
    middle = np.array([4.5, 4.5])
    printer, cell_mm, tip_mm = load_setup(printer="prusa_mk3s").printer, 0.1, 0.05
    x_mm, y_mm = np.meshgrid(*((np.arange(90) + 0.5) * cell_mm,) * 2)
    for wall_mm in (0.0, 0.02, 0.049, 0.08):
        behind = (np.stack([x_mm, y_mm], axis=-1) - middle) @ across >= wall_mm
        z_mm = np.where(behind, 3.0, 0.0)
        field = HeightField(np.zeros(2), cell_mm, z_mm, np.ones(z_mm.shape, dtype=bool))
        reach = Reach(field, printer, window_mm=(3.0, 3.0, 6.0, 6.0), finer=round(cell_mm / tip_mm))
        tips_mm = reach.centres_mm().reshape(*reach.shape, 2)
        # of the place in a cell of the tip that is nearest to the wall; the profile's cone rises
        # at 45 degrees, from 0.6 mm aside and 0.1 mm over the tip
        apart_mm = wall_mm - (tips_mm - middle) @ across - 0.5 * tip_mm * np.abs(across).sum()
        deep_mm = 3.0 - reach.need_mm - (apart_mm - 0.5)
        along = deep_mm[(apart_mm > 0.65) & (apart_mm < 2.4)]
        assert along.min() > 0.0
        assert along.max() < PRESS_MM + cell_mm


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_what_was_known_before_changes_no_answer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    printer = load_setup(printer="prusa_mk3s").printer
    z_mm = rng.uniform(0.0, 3.0, (70, 90)).round(1)
    field = HeightField(np.zeros(2), 0.2, z_mm, np.ones(z_mm.shape, dtype=bool))
    (y0, y1), (x0, x1) = (np.sort(rng.integers(0, n + 1, 2)) for n in z_mm.shape)
    z_mm = z_mm.copy()
    z_mm[y0:y1, x0:x1] = rng.uniform(0.0, 30.0)  # above slices that were passed over, too
    window = (3.0, 3.0, 9.0, 7.0)
    before = Reach(field, printer, window_mm=window, finer=2)
    later = HeightField(field.origin_mm, field.cell_mm, z_mm, field.seen)
    found = Reach(later, printer, window_mm=window, finer=2, before=before)
    anew = Reach(later, printer, window_mm=window, finer=2)
    assert [o.part for o in found.obstacles] == [o.part for o in anew.obstacles]
    for one, other in zip(found.obstacles, anew.obstacles, strict=True):
        np.testing.assert_array_equal(one.least_tip_mm, other.least_tip_mm)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_tip_may_go_nowhere_that_the_checker_refuses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    printer, cell_mm, finer = load_setup(printer="prusa_mk3s").printer, 0.1, 2
    x_mm, y_mm = np.meshgrid(*((np.arange(80) + 0.5) * cell_mm - 4.0,) * 2)
    turn = rng.uniform(0.0, np.pi)
    u = x_mm * np.cos(turn) + y_mm * np.sin(turn)
    v = y_mm * np.cos(turn) - x_mm * np.sin(turn)
    long_mm, wide_mm = rng.uniform(0.8, 3.0, 2)
    open_ = np.hypot(u, v) < long_mm if rng.random() < 0.5 else np.abs([u, v]).max(0) < wide_mm
    z_mm = np.where(open_, 0.0, rng.uniform(0.5, 3.0)) + rng.normal(0.0, 0.03, x_mm.shape)
    field = HeightField(np.full(2, -4.0), cell_mm, z_mm, np.ones(z_mm.shape, dtype=bool))
    reach = Reach(field, printer, window_mm=(-2.0, -2.0, 2.0, 2.0), finer=finer)
    places_mm = np.column_stack([reach.centres_mm(), reach.need_mm.ravel()])
    assert deepest_along(places_mm, printer, field).max() <= 0.0


def test_a_block_keeps_a_column_off_the_top_of_a_wall() -> None:
    # regression: of a worn part one column at the top of the wall was told 1 mm too low, 14.1 mm
    # from the nozzle, whose block reaches 14.0: it went 0.74 mm deep into the wall beside
    printer = load_setup(printer="prusa_mk3s").printer
    part = next(p for p in printer.head if p.reach_mm > HEXAGON_MM)
    reach_mm, below_mm = max(x for x, _ in part.polygon_mm), part.z_from_mm + 1.0
    z_mm = np.zeros((60, 260))
    z_mm[:, 200:] = below_mm + 5.0  # stands 20 mm from the left edge
    told_mm = z_mm.copy()
    told_mm[:, 200] = 0.0  # as a scan tells it
    seen = np.ones(z_mm.shape, dtype=bool)
    window = (0.0, 2.0, 19.0, 4.0)
    reach = Reach(HeightField(np.zeros(2), 0.1, told_mm, seen), printer, window_mm=window, finer=2)
    x = reach.cell_mm * (np.flatnonzero(reach.at(5.0)[20]) + 0.5)
    x = x[x > 20.0 - 0.5 - reach_mm]
    tips = np.column_stack([x, np.full(len(x), 3.0), np.full(len(x), 5.0)])
    truth = HeightField(np.zeros(2), 0.1, z_mm, seen)
    assert len(x) > 0
    assert (deepest_along(tips, printer, truth) <= 0).all()
