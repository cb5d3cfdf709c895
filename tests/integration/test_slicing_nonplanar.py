"""The top of a patch along a slope: judged from outside, and where it must not be."""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest
import trimesh

from gcode.check import find_refusals
from gcode.moves import ModalState, Program
from gcode.profiles import load_setup
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch import PatchPlan, slice_patch
from gcode.surfaces import HeightField
from gcode.writer import write
from tests.gcode_text import beads_of, points_of, steps_of
from tests.judge import Verdict, judge

PARK = (10.0, 200.0, 20.0)
HOT = ModalState(PARK, 0.0, True, False, 50.0, 1.0, (210.0,), 60.0)
MIDDLE_MM, HIGH_MM = 75.0, 6.0


def sloped(slope_deg: float) -> m3.Manifold:
    """A block whose top rises along x."""
    block = m3.Manifold.cube((26.0, 24.0, 40.0)).translate((62.0, 63.0, 0.0))
    slope = float(np.radians(slope_deg))
    normal = (float(np.sin(slope)), 0.0, -float(np.cos(slope)))
    return block.trim_by_plane(normal, MIDDLE_MM * normal[0] + HIGH_MM * normal[2])


def lost(block: m3.Manifold, depth_mm: float = 0.6) -> m3.Manifold:
    """A hollow as deep everywhere."""
    tool = m3.Manifold.cube((10.0, 8.0, 40.0)).translate((70.0, 71.0, 0.0))
    return (block ^ tool) - block.translate((0.0, 0.0, -depth_mm))


def patched(block: m3.Manifold, process: str) -> tuple[PatchPlan, Program, HeightField]:
    setup = load_setup(process=process)
    missing = lost(block)
    field = HeightField.from_manifold(block - missing, 0.1, margin_mm=8.0)
    grid = LayerGrid.from_setup(setup)
    plan = slice_patch(missing, setup, as_built=field, grid=grid, standalone=False, start_mm=PARK)
    return plan, write(plan.toolpath, setup, title="slope", resume=HOT, restore=False), field


def slanted(program: Program) -> list[np.ndarray]:
    """Beads of the text that are not at a layer's height, or climb."""
    beads = [points_of(bead) for bead in beads_of(steps_of(program.text, PARK))]
    layers = 0.2 * np.arange(100)
    return [b for b in beads if np.abs(b[:, 2, None] - layers).min(axis=1).max() > 0.03]


def mesh_of(solid: m3.Manifold) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(
        np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts).astype(int), process=False
    )


def verdict_of(program: Program, block: m3.Manifold) -> Verdict:
    missing = lost(block)
    box = np.asarray(missing.bounding_box()).reshape(2, 3)
    return judge(program.text, mesh_of(block - missing), mesh_of(block), box)


@pytest.mark.parametrize("slope_deg", [pytest.param(4.0, marks=pytest.mark.slow), 8.0])
def test_a_gentle_slope_is_followed_and_less_lies_outside(slope_deg: float) -> None:
    block = sloped(slope_deg)
    _, program, field = patched(block, "repair_0.20_nonplanar")
    beads = slanted(program)
    assert beads
    for bead in beads:
        over_mm = bead[:, 2] - HIGH_MM - (bead[:, 0] - MIDDLE_MM) * np.tan(np.radians(slope_deg))
        assert over_mm.min() >= -0.02
        assert over_mm.max() <= 0.07
    # regression: what was laid uphill was ploughed by the next bead; the lowest come first
    steps = steps_of(program.text, PARK)
    top = [step for step in steps if step.layer == steps[-1].layer]
    starts_mm = [bead[0].start_mm[2] for bead in beads_of(top)]
    assert starts_mm == sorted(starts_mm)
    setup = load_setup(process="repair_0.20_nonplanar")
    assert not find_refusals(program, setup, as_built=field, initial=HOT)
    stepped = verdict_of(patched(block, "repair_0.20")[1], block)
    smooth = verdict_of(program, block)
    assert smooth.filled_ratio > stepped.filled_ratio - 0.005
    assert smooth.outside_ratio < stepped.outside_ratio


@pytest.mark.parametrize("slope_deg", [0.0, 30.0])
def test_flat_tops_and_steep_slopes_are_laid_in_layers(slope_deg: float) -> None:
    block = sloped(slope_deg)
    assert slanted(patched(block, "repair_0.20_nonplanar")[1]) == []
    one, other = (patched(block, f"repair_0.20{name}")[0] for name in ("", "_nonplanar"))
    assert one.beads_mm3 == pytest.approx(other.beads_mm3)
