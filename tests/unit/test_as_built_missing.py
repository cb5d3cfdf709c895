"""What stands there, where the job's own beads are expected: what is missing is none of it."""

from __future__ import annotations

import manifold3d as m3
import numpy as np

from amrepair.deficit.heights import without_missing
from gcode.surfaces import HeightField

CELL_MM = 0.25


def field(*, seen: bool) -> HeightField:
    """A plate 2 mm high, 10 × 10 mm; a strip of it that nobody saw into stands as high."""
    known = np.ones((40, 40), dtype=bool)
    known[:, 10:20] = seen
    return HeightField(np.zeros(2), CELL_MM, np.full((40, 40), 2.0), known)


def test_what_nobody_saw_stands_no_higher_than_what_is_missing_there() -> None:
    # regression: cells under a skin that had not been laid stood as high as the nozzle had been,
    # and kept it out of the layer in which the skin was to begin
    gone = m3.Manifold.cube((5.0, 5.0, 1.0)).translate((2.0, 2.0, 1.2))
    low = without_missing(field(seen=False), gone)
    x = y = (np.arange(40) + 0.5) * CELL_MM
    over = (x > 2.5) & (x < 5.0)
    rows = (y > 2.0) & (y < 7.0)
    assert np.allclose(low.z_mm[np.ix_(rows, over)], 1.2)
    assert np.allclose(low.z_mm[np.ix_(~rows, over)], 2.0)


def test_what_was_seen_is_believed() -> None:
    gone = m3.Manifold.cube((5.0, 5.0, 1.0)).translate((2.0, 2.0, 1.2))
    same = field(seen=True)
    assert (without_missing(same, gone).z_mm == same.z_mm).all()


def test_a_roof_over_what_is_missing_stands() -> None:
    hollow = m3.Manifold.cube((5.0, 5.0, 0.6)).translate((2.0, 2.0, 0.8))
    same = field(seen=False)
    assert (without_missing(same, hollow).z_mm == same.z_mm).all()
    assert without_missing(same, m3.Manifold()) is same
