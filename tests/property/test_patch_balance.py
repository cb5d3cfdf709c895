"""What a patch lays and what it says it leaves out make up what is missing, whatever the shape."""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest
import trimesh

from gcode.profiles import load_setup
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch import PatchPlan, slice_patch
from gcode.surfaces import HeightField
from gcode.writer import write
from tests.draws import draws
from tests.judge import Verdict, judge

SETUP = load_setup()
AT_MM = (100.0, 100.0, 0.0)
Solid = m3.Manifold
EVERYTHING = (80.0, 80.0, 40.0)


def above(z_mm: float) -> Solid:
    return Solid.cube(EVERYTHING).translate((-40.0, -40.0, z_mm))


def hollow(sides: int, radius_mm: float, wall_mm: float) -> Solid:
    outside, inside = (Solid.cylinder(8.0, r, r, sides) for r in (radius_mm, radius_mm - wall_mm))
    return outside - inside.translate((0.0, 0.0, 1.0))


BLOCK = Solid.cube((30.0, 24.0, 10.0))
NOTCH = Solid.cube((14.0, 10.0, 20.0)).translate((8.0, -1.0, 7.0))
CASES = {
    # regression: told twice, each pass its own "thinner than half a nozzle" beside what stayed open
    "star with thin walls": (hollow(5, 12.0, 1.0), above(3.0)),
    "cup of two lines": (hollow(48, 5.0, 0.8), above(4.0)),
    # regression: the ring's box holds the pit, of which it told a share as its own
    "pit in a ring": (
        BLOCK + Solid.cube((30.0, 24.0, 3.0)).translate((0.0, 0.0, 10.0)),
        (above(11.0) - Solid.cube((26.0, 20.0, 40.0)).translate((2.0, 2.0, 0.0)))
        + Solid.cube((1.2, 14.0, 20.0)).translate((14.0, 5.0, 11.0)),
    ),
    "notch": (BLOCK, NOTCH),
    "groove": (BLOCK, Solid.cube((1.6, 12.0, 20.0)).translate((14.0, 6.0, 9.0))),
    "rim, reached from above alone": (
        BLOCK, Solid.cube((0.7, 12.0, 20.0)).translate((29.3, 6.0, 8.0)),
    ),
    "slope": (Solid.cylinder(10.0, 10.0, 3.0, 64), above(5.0)),
    "pins": (
        Solid.batch_boolean(
            [
                Solid.cylinder(6.0, 0.3 + 0.1 * k, 0.3 + 0.1 * k, 24).translate((4.0 * k, 0.0, 2.0))
                for k in range(5)
            ]
            + [Solid.cube((24.0, 8.0, 3.0)).translate((-4.0, -4.0, 0.0))],
            m3.OpType.Add,
        ),
        above(3.5),
    ),
}  # fmt: skip


def mesh_of(solid: Solid) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(
        np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts).astype(int), process=False
    )


def patched(whole: Solid, tool: Solid) -> tuple[PatchPlan, Verdict]:
    """A patch for what a tool takes away, and the outside judge's verdict on its text."""
    whole, tool = whole.translate(AT_MM), tool.translate(AT_MM)
    rest, piece = whole - tool, whole ^ tool
    plan = slice_patch(
        piece,
        SETUP,
        as_built=HeightField.from_manifold(rest, 0.1, margin_mm=8.0),
        grid=LayerGrid.from_setup(SETUP),
        standalone=True,
    )
    text = write(plan.toolpath, SETUP, title="balance", resume=None, restore=False).text
    box_mm = np.asarray(piece.bounding_box()).reshape(2, 3)
    return plan, judge(text, mesh_of(rest), mesh_of(whole), box_mm)


def assert_made_up(plan: PatchPlan, verdict: Verdict) -> None:
    missing_mm3 = sum(region.volume_mm3 for region in plan.regions)
    told_mm3 = sum(one.volume_mm3 for one in (*plan.unreachable, *plan.unprintable))
    open_mm3 = sum(r.volume_mm3 * (1.0 - r.reachable_ratio) for r in plan.regions)
    assert told_mm3 == pytest.approx(open_mm3, abs=1e-3 * missing_mm3)
    laid_mm3 = plan.beads_mm3 / plan.options.beads.bond_ratio
    # but for films, a bead's section that is a mean over pieces, and columns that sample pins
    assert laid_mm3 - plan.spilt_mm3 + told_mm3 == pytest.approx(missing_mm3, rel=0.015)
    # the judge rounds lines to its voxels: of a wall eight voxels wide one row lies outside
    filled = (verdict.filled_mm3 + told_mm3) / verdict.missing_mm3
    assert 0.89 <= filled <= 1.015


@pytest.mark.parametrize(
    "name",
    draws(CASES, "cup of two lines"),
)
def test_what_is_laid_and_what_is_left_out_make_up_what_is_missing(name: str) -> None:
    assert_made_up(*patched(*CASES[name]))


@pytest.mark.parametrize("seed", range(6))
def test_walls_of_any_width_are_laid_or_told(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sides, wall_mm = int(rng.integers(3, 24)), rng.uniform(0.45, 1.3)
    cup = hollow(sides, rng.uniform(4.0, 9.0), wall_mm).rotate((0.0, 0.0, rng.uniform(0, 90)))
    assert_made_up(*patched(cup, above(5.0)))
