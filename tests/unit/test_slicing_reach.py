"""Where the tip may go along straight pieces: the compiled loop against plain look-ups."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcode.profiles import load_setup
from gcode.slicing import reach_kernels
from gcode.slicing.reach import Reach
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
