"""What a run found missing is what any of its looks found, each of it once."""

from __future__ import annotations

import manifold3d as m3
import pytest

from amrepair.report.collect import found_mm3

PIT = m3.Manifold.cube((4.0, 3.0, 2.0))


def test_what_a_later_look_finds_counts_too() -> None:
    # regression: a run's closing words counted its stops' first looks alone, while a second look
    # found, and filled, what the first had not seen
    beside = PIT.translate((10.0, 0.0, 0.0))
    assert found_mm3([PIT], [PIT + beside]) == pytest.approx(48.0)
    assert found_mm3([m3.Manifold()], [beside, beside]) == pytest.approx(24.0)


def test_what_is_left_is_not_found_twice() -> None:
    left = m3.Manifold.cube((4.02, 3.0, 0.3)).translate((-0.01, 0.0, -0.02))
    assert found_mm3([PIT, PIT], [left]) == pytest.approx(24.0)
    assert found_mm3([], []) == 0.0
