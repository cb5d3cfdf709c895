"""Where the tip may go along straight pieces: the compiled loop against plain look-ups."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gcode.slicing import reach_kernels


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
