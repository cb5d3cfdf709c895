"""Beads of a patch lie in the middle of what they fill."""

from __future__ import annotations

import manifold3d
import numpy as np
import pytest
import trimesh

from gcode.moves import Role
from gcode.profiles import load_setup
from gcode.slicing.beads import Bead, loop_bead
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch import slice_patch
from gcode.slicing.patch_middles import in_the_middle
from gcode.surfaces import HeightField
from gcode.writer import write
from tests.judge import Verdict, judge

LINE = Bead(np.array([[0.0, 0.0], [0.4, 0.0], [0.8, 0.0]]), np.ones(2), Role.SOLID_INFILL, False)
Solid = manifold3d.Manifold


def _anywhere(start_mm: np.ndarray, end_mm: np.ndarray) -> np.ndarray:
    return np.ones(len(start_mm), dtype=bool)


def test_a_line_moves_to_the_middle_of_what_it_fills_to_its_left() -> None:
    moved = in_the_middle(LINE, np.array([0.05, 0.05]), _anywhere)
    np.testing.assert_allclose(moved, LINE.xy_mm + np.array([0.0, 0.05]))


def test_a_line_stays_where_the_nozzle_may_not_go_beside_it() -> None:
    moved = in_the_middle(
        LINE, np.array([0.05, 0.05]), lambda a, b: (a[:, 1] < 0.01) & (b[:, 1] < 0.01)
    )
    np.testing.assert_array_equal(moved, LINE.xy_mm)


def test_a_loop_stays_closed() -> None:
    turn = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    loop = loop_bead(3.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1), 0.45, Role.PERIMETER)
    moved = in_the_middle(loop, np.full(24, 0.05), _anywhere)
    np.testing.assert_array_equal(moved[0], moved[-1])
    assert np.hypot(*moved.T) == pytest.approx(2.95, abs=0.003)  # its left is its inside


def _mesh(solid: Solid) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(
        np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts).astype(int), process=False
    )


def _judged(part: Solid, above_mm: float) -> Verdict:
    """What the outside judge says of a patch for all of a part over a height."""
    part = part.translate((103.03, 104.02, 0.0))
    tool = Solid.cube((20.0, 20.0, 9.0)).translate((93.0, 94.0, above_mm))
    piece, rest = part ^ tool, part - tool
    setup = load_setup()
    as_built = HeightField.from_manifold(rest, 0.1, margin_mm=8.0)
    grid = LayerGrid.from_setup(setup)
    plan = slice_patch(piece, setup, as_built=as_built, grid=grid, standalone=True)
    text = write(plan.toolpath, setup, title="middles", resume=None, restore=False).text
    box = np.asarray(piece.bounding_box()).reshape(2, 3)
    return judge(text, _mesh(rest), _mesh(part), box)


def test_a_ring_is_filled_to_its_rims_and_not_over_them() -> None:
    """Lines lay nearer to a rim than to each other: 0.950 filled, 6.4 % over the rims."""
    ring = Solid.cylinder(6.0, 5.0, 5.0, 96)
    ring -= Solid.cylinder(9.0, 3.4, 3.4, 96).translate((0.0, 0.0, -1.0))
    verdict = _judged(ring, 4.8)
    assert verdict.filled_ratio >= 0.98
    assert verdict.outside_ratio <= 0.035


def test_a_pin_is_filled_as_far_inside_its_only_line_as_outside() -> None:
    """Most of a disc's columns lie outside a line in it, which moved out to them: 0.905 filled."""
    pin = Solid.cylinder(6.0, 0.7, 0.7, 32) + Solid.cube((8.0, 8.0, 2.0)).translate((-4, -4, 0))
    assert _judged(pin, 3.5).filled_ratio >= 0.93
