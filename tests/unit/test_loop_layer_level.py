"""A layer's flow changes where its top lies off by more than its own scatter, at a stated rate."""

from __future__ import annotations

from dataclasses import replace

import manifold3d as m3
import numpy as np
import pytest

from amrepair.loop.layer_level import FlowOptions, LayerLevel
from amrepair.loop.next_layer import gap_solids
from amrepair.policy.table import Action, Cover, Finding, judge
from amrepair.regions.anomaly import DefectType

LAYER_MM, Z_MM = 0.2, 2.0
SIZE_MM = (30.0, 24.0)
SCATTER_MM = 0.03  # of patches: what a wandering flow leaves


def layer(
    rng: np.random.Generator, *, rise: float = 0.0, half_mm: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """A flat layer whose patches scatter, and a square around its middle that is off."""
    xy = rng.uniform((0, 0), SIZE_MM, (12_000, 2))
    cell = np.floor(xy / 2.0).astype(int)
    wander = rng.normal(scale=SCATTER_MM, size=(15, 12))[cell[:, 0], cell[:, 1]]
    over = wander + rng.normal(scale=0.03, size=len(xy))
    over += rise * (np.abs(xy - np.array(SIZE_MM) / 2) < half_mm).all(axis=1)
    return np.column_stack([xy, Z_MM + over]), over


def level_of(points_mm: np.ndarray, deviation_mm: np.ndarray) -> LayerLevel:
    level = LayerLevel.of_points(points_mm, deviation_mm, Z_MM, LAYER_MM)
    assert level is not None
    return level


def box(half_mm: float) -> np.ndarray:
    x, y = np.array(SIZE_MM) / 2
    return np.array([[x - half_mm, y - half_mm, 1.9], [x + half_mm, y + half_mm, 2.2]])


def worst_place(level: LayerLevel, half_mm: float) -> bool:
    """Whether any place of a clean layer would change the flow: as if a detector looked for it."""
    corners = np.argwhere(np.ones((10, 8))) * 2.0 + 4.0
    return any(
        level.is_off(np.array([[x - half_mm, y - half_mm, 1.9], [x + half_mm, y + half_mm, 2.2]]))
        for x, y in corners
    )


def test_clean_layers_change_nothing_wherever_one_looks() -> None:
    alarms = 0
    for seed in range(60):
        level = level_of(*layer(np.random.default_rng(seed)))
        assert level.spread_mm == pytest.approx(SCATTER_MM, rel=0.35)
        alarms += any(worst_place(level, half) for half in (1.0, 2.0, 4.0))
    assert alarms == 0


def test_the_rate_of_false_alarms_is_no_more_than_stated() -> None:
    """With no tolerance at all, and the worst of disjoint places, the promise still holds."""
    options = FlowOptions(false_alarm=0.1, tolerance_layers=0.0)
    alarms, looks = 0, 300
    for seed in range(looks):
        rng = np.random.default_rng([7, seed])
        cells = np.argwhere(np.ones((15, 12)))
        level = LayerLevel(cells, rng.normal(scale=SCATTER_MM, size=180), SCATTER_MM, 0.2, options)
        corners = np.argwhere(np.ones((5, 4))) * 6.0
        alarms += any(
            level.is_off(np.array([[x, y, 1.9], [x + 6.0, y + 6.0, 2.2]])) for x, y in corners
        )
    # 20 places tested, 0.1 a look: a binomial's 99.9 % is 47 of 300
    assert 5 <= alarms <= 47


@pytest.mark.parametrize("rise", [-0.12, 0.12])
def test_too_little_or_too_much_over_a_place_is_told(rise: float) -> None:
    for seed in range(20):
        points = layer(np.random.default_rng(seed), rise=rise, half_mm=4.0)
        assert level_of(*points).is_off(box(4.0))


def test_a_whole_layer_that_is_too_low_is_told() -> None:
    level = level_of(*layer(np.random.default_rng(3), rise=-0.08, half_mm=50.0))
    assert level.is_off(box(10.0))


def test_what_bulges_beside_a_layer_says_nothing_of_its_top() -> None:
    points, deviation = layer(np.random.default_rng(1))
    bulge = np.column_stack([
        np.full(400, -0.3), np.linspace(5, 20, 400), np.linspace(1.0, 1.9, 400)])  # fmt: skip
    level = level_of(np.concatenate([points, bulge]), np.append(deviation, np.full(400, 0.3)))
    assert not level.is_off(np.array([[-0.5, 5.0, 1.0], [0.0, 20.0, 1.9]]))


def test_too_few_patches_tell_nothing() -> None:
    points, deviation = layer(np.random.default_rng(1))
    few = points[:, 0] < 1.5
    assert LayerLevel.of_points(points[few][:20], deviation[few][:20], Z_MM, LAYER_MM) is None


THIN = Finding(
    kind="missing", type=DefectType.UNDER_EXTRUSION, confidence=0.9, volume_mm3=4.0,
    defect_mm3=4.0, thickness_layers=0.4, height_layers=0.8, reachable_ratio=0.9,
    cover=Cover.SOLID, hit_mm=0.0, box_mm=((0.0, 0.0, 1.0), (5.0, 5.0, 1.2)),
)  # fmt: skip
HIGH = replace(THIN, kind="excess", type=DefectType.BLOB)


@pytest.mark.parametrize(
    ("finding", "action"), [(THIN, Action.FILL_WITH_NEXT), (HIGH, Action.LOWER_NEXT)]
)
def test_a_region_that_the_layer_does_not_confirm_changes_no_flow(
    finding: Finding, action: Action
) -> None:
    assert judge(finding).action is action
    assert judge(replace(finding, layer_off=False)).action is Action.GO_ON


def test_what_hangs_down_a_wall_does_not_starve_the_beads_over_it() -> None:
    """Regression: a bulge 0.2 mm thick and 3.5 mm tall took 70 % of the flow over it."""
    low, high = (4.0, 4.0, Z_MM - 0.8), (8.0, 8.0, Z_MM + 0.05)
    size = np.subtract(high, low)
    bulge = m3.Manifold.cube(tuple(size)).translate(low)
    verdict = judge(replace(HIGH, box_mm=(low, high)))
    ((solid, sign),) = gap_solids(m3.Manifold(), bulge, [verdict], floor_mm=Z_MM)
    assert sign == -1.0
    assert solid.volume() == pytest.approx(0.05 * 16.0)
    assert gap_solids(m3.Manifold(), bulge, [verdict], floor_mm=Z_MM + 0.1) == []
