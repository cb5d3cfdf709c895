"""A defect printed into the world, then mended by beads: the truth must say how much came back."""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest

from amrepair.simulate.defects import parse_defect, place
from amrepair.simulate.world import World
from gcode.firmware.motion import MotionBatch
from tests.worlds import missing_versus

HEIGHT_MM, SPACING_MM, LINES = 0.2, 0.407, 48
SIZE_MM = LINES * SPACING_MM
FILAMENT_MM2 = np.pi / 4 * 1.75**2


def layer(index: int, low: float = 0.0, high: float = SIZE_MM) -> MotionBatch:
    """Parallel lines over the square [low, high]², block corner at (20, 20)."""
    count = max(1, round((high - low) / SPACING_MM))
    pitch = (high - low) / count
    across = 20 + low + (np.arange(count) + 0.5) * pitch
    z = np.full(count, HEIGHT_MM * (index + 1))
    ends = np.tile([[20 + low, 20 + high]], (count, 1))
    ends[1::2] = ends[1::2, ::-1]
    columns = [(ends[:, k], across, z) if index % 2 else (across, ends[:, k], z) for k in (0, 1)]
    start, end = (np.stack(column, axis=1) for column in columns)
    section_mm2 = pitch * HEIGHT_MM
    filament = np.full(count, (high - low) * section_mm2 / FILAMENT_MM2)
    return MotionBatch(start, end, filament, np.full(count, 50.0), np.arange(count) * 1.0)


@pytest.mark.parametrize("text", ["void:diameter=8,layers=3", "under_extrusion:flow=0.5,layers=3"])
def test_refilling_a_defect_at_its_last_layer_brings_its_volume_back(text: str) -> None:
    tops = np.arange(1, 13) * HEIGHT_MM
    part = m3.Manifold.cube((SIZE_MM, SIZE_MM, 12 * HEIGHT_MM)).translate((20, 20, 0))
    placed = place(parse_defect(text), part, tops, np.random.default_rng(4))
    assert placed.last_layer is not None
    clean, broken = World((60.0, 60.0)), World((60.0, 60.0))
    for index in range(placed.last_layer + 1):
        clean.deposit(layer(index))
        broken.deposit(layer(index), [placed])
    before = missing_versus(broken, clean)
    if placed.kind == "void":
        *_, a, b, _, _, _ = placed.flow_regions[0]
        expected = np.pi * a * b * 3 * HEIGHT_MM
        assert before.missing_mm3 == pytest.approx(expected, rel=0.25)  # beads round its edge off
        assert before.within(placed.box_mm).missing_mm3 > 0.8 * before.missing_mm3
    else:
        assert before.missing_mm3 == pytest.approx(0.5 * SIZE_MM**2 * 3 * HEIGHT_MM, rel=0.02)
        # a layer of the missing thickness, laid from the job's own height
        depth_ratio = 0.5 * 3
        motion = layer(placed.last_layer)
        patch = MotionBatch(
            motion.start_mm, motion.end_mm, motion.filament_mm * depth_ratio,
            motion.speed_mm_s, motion.time_s,
        )  # fmt: skip
        broken.deposit(patch)
        assert before.filled_mm3(broken) > 0.95 * before.missing_mm3
        assert missing_versus(broken, clean).excess_mm3 < 0.05 * before.missing_mm3


def test_same_job_without_a_defect_is_the_same_world() -> None:
    clean, again = World((60.0, 60.0)), World((60.0, 60.0))
    none = place(
        parse_defect("none"),
        m3.Manifold.cube((5, 5, 5)),
        np.arange(1, 26) * 0.2,
        np.random.default_rng(0),
    )
    for index in range(6):
        clean.deposit(layer(index))
        again.deposit(layer(index), [none])
    assert missing_versus(again, clean).missing_mm3 == 0.0
