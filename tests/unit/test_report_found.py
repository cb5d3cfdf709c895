"""What a run found missing is what any of its looks found, each of it once."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import manifold3d as m3
import numpy as np
import pytest

from amrepair.regions import DefectType, Label, Region
from amrepair.report.collect import found_mm3, region_rows

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


def test_crumbs_beside_a_defect_are_no_defects() -> None:
    # regression: a chip of 279 mm³ with three crumbs of 0.03 to 0.14 mm³ was told as four chips
    def piece(volume_mm3: float) -> Region:
        box_mm = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
        return Region(
            Label.MISSING,
            DefectType.CHIP,
            volume_mm3,
            1.0,
            0.2,
            box_mm,
            below_bead=volume_mm3 < 0.5,
        )

    def told(*volumes_mm3: float) -> list[float]:
        deficit = SimpleNamespace(regions=tuple(map(piece, volumes_mm3)))
        plan: Any = SimpleNamespace(deficit=deficit, patch=None)
        return [row.volume_mm3 for row in region_rows(plan)]

    assert told(279.0, 0.14, 0.04) == [279.0]
    assert told(0.14) == [0.14]
    assert told() == []
