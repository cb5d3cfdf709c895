"""Wandering flow: its size, its reach, and what it leaves alone."""

from __future__ import annotations

import numpy as np
import pytest

from amrepair.simulate.flow import noisy_flow
from amrepair.simulate.parameters import FlowModel, load_world
from gcode.firmware.motion import MotionBatch

WANDERS = load_world().flow


def moves(count: int) -> MotionBatch:
    """Beads of 1 mm; every tenth move is a travel, the last a retraction."""
    end = np.column_stack([np.arange(1.0, count + 1), np.zeros(count), np.full(count, 0.2)])
    filament = np.full(count, 0.04)
    filament[::10], filament[-1] = 0.0, -0.8
    n = np.full(count, 50.0)
    return MotionBatch(end - [1.0, 0.0, 0.0], end, filament, n, np.arange(count) * 1.0)


def test_flow_wanders_as_told_and_only_where_plastic_is_laid() -> None:
    before = moves(200_000)
    told = FlowModel(mean_ratio=0.97, sigma_ratio=0.03, over_mm=100.0)
    after = noisy_flow(before, np.random.default_rng(0), told)
    idle = before.filament_mm <= 0
    assert (after.filament_mm[idle] == before.filament_mm[idle]).all()
    factor = after.filament_mm[~idle] / before.filament_mm[~idle]
    # 2,000 times over: means are good to 3 % / sqrt(1000), deviations to a few per cent
    assert factor.mean() == pytest.approx(0.97, abs=0.004)
    assert factor.std() == pytest.approx(0.03, rel=0.1)
    off = factor - factor.mean()
    apart = 90  # laid moves in 100 mm
    assert (off[apart:] * off[:-apart]).mean() / off.var() == pytest.approx(np.exp(-1), abs=0.06)


def test_the_same_seed_gives_the_same_flow() -> None:
    first, again = (noisy_flow(moves(50), np.random.default_rng(7), WANDERS) for _ in range(2))
    assert (first.filament_mm == again.filament_mm).all()


def test_travels_alone_stay_as_they_are() -> None:
    before = moves(1)
    assert noisy_flow(before, np.random.default_rng(0), WANDERS) is before
