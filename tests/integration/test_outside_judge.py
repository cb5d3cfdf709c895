"""Offline repairs under the outside judge: scan in, G-code out, beads laid by somebody else.

A part of our own with a hole, a thin wall and a boss; pieces of known volume are taken away; the
scan is a bare cloud (0.2 mm, 0.04 mm noise, no normals, no sensors), its pose known.
"""

from __future__ import annotations

import manifold3d
import numpy as np
import pytest
import trimesh

from amrepair.frames import Transform
from amrepair.repair import Site, plan_repair
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from gcode.check import find_refusals
from gcode.profiles import load_setup
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch import slice_patch
from gcode.surfaces import HeightField
from gcode.writer import write
from tests.draws import draws
from tests.judge import HEADS, Verdict, cone_contact_mm, judge

NOISE_MM, SPACING_MM = 0.04, 0.2
ON_BED_MM = np.array([95.0, 85.0, 0.0])
Solid = manifold3d.Manifold


def _box(size: tuple[float, float, float], at: tuple[float, float, float]) -> Solid:
    return Solid.cube(size).translate(at)


def _part() -> Solid:
    whole = _box((60.0, 40.0, 8.0), (0.0, 0.0, 0.0))
    whole += _box((50.0, 1.2, 6.0), (5.0, 30.0, 8.0))
    whole += _box((20.0, 14.0, 4.0), (6.0, 6.0, 8.0))
    return whole - Solid.cylinder(20.0, 3.0, 3.0, 64).translate((48.0, 12.0, -1.0))


# what cuts the piece off, and the share of it that must get filled of what the judge reaches
TOOLS = {
    "notch": (_box((14.0, 12.0, 10.0), (34.0, -1.0, 5.8)), 0.95),
    "corner": (_box((16.0, 14.0, 10.0), (48.0, -4.0, 6.0)), 0.95),
    "wall gap": (_box((16.0, 4.0, 6.0), (22.0, 29.0, 12.0)), 0.90),
    "boss": (_box((22.0, 8.0, 9.0), (5.0, 5.0, 10.6)), 0.95),
    "worn edge": (
        _box((60.0, 10.0, 0.1), (0.0, 0.0, 0.0))
        .rotate((-20.0, 0.0, 0.0))
        .translate((0.0, -6.0, 8.6)),
        0.91,
    ),
}


def _mesh(solid: Solid) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(
        np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts).astype(int), process=False
    )


def _assert_declared(share: float, verdict: Verdict) -> None:
    """Between what something beside it holds, and what the head alone allows."""
    assert share >= verdict.reachable_ratio - 0.05
    assert share <= verdict.open_ratio + 0.05


def _scan(solid: Solid, seed: int) -> Scan:
    mesh = _mesh(solid)
    points, _ = trimesh.sample.sample_surface(mesh, int(mesh.area / SPACING_MM**2), seed=seed)
    noise = np.random.default_rng(seed).normal(scale=NOISE_MM, size=points.shape)
    return Scan(np.asarray(points) + noise, NOISE_MM, "build")


@pytest.mark.parametrize(
    "name",
    draws(TOOLS, "wall gap"),
)
def test_a_piece_is_filled_as_an_outsider_sees_it(name: str) -> None:
    tool, least_filled = TOOLS[name]
    # from above: whatever stood over the piece is gone with it
    tool = Solid.batch_hull([tool, tool.translate((0.0, 0.0, 30.0))])
    part = _part()
    template = MeshSdf.from_mesh(_mesh(part))
    on_bed = tuple(ON_BED_MM)
    piece = part.translate(on_bed) ^ tool.translate(on_bed)
    rest = part.translate(on_bed) - tool.translate(on_bed)
    setup = load_setup()
    placed = Transform.from_rotation_translation(
        "build", "template", rotation=np.eye(3), translation_mm=ON_BED_MM
    )
    site = Site(template, setup, LayerGrid.from_setup(setup), build_from_template=placed)
    plan = plan_repair(_scan(rest, 1), site, title=name, guess=placed.inverse())
    assert plan.checked is not None
    assert plan.patch is not None
    # regression: distances to the part's own faces rounded breaks off, 36.2 of the gap's 38.4 mm³
    assert plan.deficit.missing_mm3 == pytest.approx(piece.volume(), rel=0.02)
    verdict = judge(
        plan.checked.program.text,
        _mesh(rest),
        _mesh(part.translate(on_bed)),
        np.asarray(piece.bounding_box()).reshape(2, 3),
    )
    assert verdict.filled_ratio >= least_filled
    # of a wall 1.2 mm thick the round sides of its lines lie 0.02 mm beyond either face
    assert verdict.outside_ratio <= (0.06 if name == "wall gap" else 0.05)
    assert verdict.in_air_mm3 <= 0.005 * verdict.laid_mm3 + 0.1
    assert verdict.widest_mm <= 2 * setup.printer.nozzle_diameter_mm + 1e-9
    assert verdict.deepest_contact_mm <= 0.2
    declared = sum(r.volume_mm3 * r.reachable_ratio for r in plan.patch.regions)
    _assert_declared(declared / plan.deficit.missing_mm3, verdict)


@pytest.mark.parametrize("width_mm", draws([2.0, 4.0], 2.0))
def test_what_is_too_deep_for_the_head_is_filled_from_where_it_gets_in(width_mm: float) -> None:
    """A tenth of a millimetre from a wall's reach: nothing was begun, 12 to 17 % were filled.

    Begun, the strands that hang there had what only a floor presses on to the wall: 10 % welled.
    """
    block = _box((14.0, 14.0, 8.0), (100.0, 100.0, 0.0))
    pit = _box((width_mm, 8.0, 6.0), (107.0 - 0.5 * width_mm, 103.03, 3.03))
    piece, rest = block ^ pit, block - pit
    setup = load_setup()
    as_built = HeightField.from_manifold(rest, 0.1, margin_mm=8.0)
    grid = LayerGrid.from_setup(setup)
    plan = slice_patch(piece, setup, as_built=as_built, grid=grid, standalone=True)
    program = write(plan.toolpath, setup, title="pit", resume=None, restore=False)
    assert not find_refusals(program, setup, as_built=as_built)
    box = np.asarray(piece.bounding_box()).reshape(2, 3)
    verdict = judge(program.text, _mesh(rest), _mesh(block), box)
    assert verdict.reachable_mm3 > 2.0  # the cone gets in for the last layer
    assert verdict.filled_ratio >= 0.9
    assert verdict.outside_ratio <= 0.05
    assert verdict.in_air_mm3 <= 0.005 * verdict.laid_mm3 + 0.1
    assert verdict.deepest_contact_mm <= 0.2
    _assert_declared(plan.reachable_mm3 / piece.volume(), verdict)


# a block of 44×34×12 mm; what the head alone allows of each, and how much of that must be filled
DEEP = {
    "notch": (_box((20.0, 14.0, 20.0), (12.0, -1.0, 7.0)), 0.9),
    "slot": (_box((2.5, 16.0, 20.0), (20.0, 9.0, 9.0)), 0.88),
    "wider slot": (_box((4.0, 16.0, 20.0), (20.0, 9.0, 9.5)), 0.9),
}


@pytest.mark.parametrize("name", draws(DEEP, "slot"))
@pytest.mark.parametrize("printer", ["voron_2_4"])
def test_what_the_head_alone_allows_is_filled_where_a_floor_is_near(
    name: str, printer: str
) -> None:
    """Where nothing held a first strand nothing was laid: 0.04, 0.54 and 0.33 of it."""
    tool, least = DEEP[name]
    block = _box((44.0, 34.0, 12.0), (0.0, 0.0, 0.0)).translate(tuple(ON_BED_MM))
    tool = tool.translate(tuple(ON_BED_MM))
    piece, rest = block ^ tool, block - tool
    setup = load_setup(printer=printer)
    as_built = HeightField.from_manifold(rest, 0.1, margin_mm=8.0)
    grid = LayerGrid.from_setup(setup)
    plan = slice_patch(piece, setup, as_built=as_built, grid=grid, standalone=True)
    program = write(plan.toolpath, setup, title=name, resume=None, restore=False)
    assert not find_refusals(program, setup, as_built=as_built)
    box = np.asarray(piece.bounding_box()).reshape(2, 3)
    verdict = judge(program.text, _mesh(rest), _mesh(block), box, head=HEADS[printer])
    assert verdict.filled_open_ratio >= least
    assert verdict.outside_ratio <= 0.05
    assert verdict.in_air_mm3 <= 0.005 * verdict.laid_mm3 + 0.1
    assert verdict.deepest_contact_mm <= 0.2
    assert plan.reachable_mm3 / piece.volume() == pytest.approx(verdict.open_ratio, abs=0.05)


def test_the_judge_sees_a_bead_that_is_laid_beside_the_part() -> None:
    """The judge itself: a bead in the right place fills, one beside it is outside."""
    stands, wanted = (
        _box((20.0, 20.0, 2.0), (50.0, 50.0, 0.0)),
        _box((20.0, 20.0, 2.2), (50.0, 50.0, 0.0)),
    )
    box = np.array([[50.0, 50.0, 2.0], [70.0, 70.0, 2.2]])
    filament_mm = 10.0 * 0.45 * 0.2 / (np.pi / 4 * 1.75**2)
    for x, outside in ((60.0, 0.0), (71.8, 1.0)):
        text = f"M83\nG1 Z2.2\nG1 X{x} Y55\nG1 Y65 E{filament_mm:.5f}\n"
        verdict = judge(text, _mesh(stands), _mesh(wanted), box)
        assert verdict.outside_ratio == pytest.approx(outside, abs=0.02)
        assert verdict.laid_mm3 == pytest.approx(0.9, rel=0.05)
        assert verdict.filled_mm3 == pytest.approx(0.9 * (1 - outside), abs=0.05)


def test_the_judge_sees_the_head_run_into_a_wall() -> None:
    stands = _box((20.0, 20.0, 2.0), (50.0, 50.0, 0.0)) + _box((2.0, 20.0, 9.0), (68.0, 50.0, 0.0))
    box = np.array([[50.0, 50.0, 2.0], [60.0, 70.0, 2.2]])
    near, far = "G1 Z2.2\nG1 X66.5 Y55\nG1 Y65\n", "G1 Z2.2\nG1 X30 Y55\nG1 Y65\n"
    assert judge(near, _mesh(stands), _mesh(stands), box).deepest_contact_mm > 1.0
    assert judge(far, _mesh(stands), _mesh(stands), box).deepest_contact_mm < 0.2


@pytest.mark.parametrize("aside_mm", [0.0, 0.03, 0.05, 0.08])
def test_contact_of_the_cone_is_told_however_walls_lie_to_columns(aside_mm: float) -> None:
    # regression: tip and wall were known by columns, and 0.125 mm was told as 0.06, or as 0.16
    stands = _box((20.0, 20.0, 2.0), (50.0, 50.0, 0.0))
    stands += _box((2.0, 20.0, 2.8), (68.0 + aside_mm, 50.0, 0.0))
    box = np.array([[64.0, 54.0, 2.0], [68.0, 58.0, 2.2]])
    # 0.6 mm over the tip the cone is 1.1 mm wide
    text = f"G1 Z2.2\nG1 X{68.0 + aside_mm - 1.1 + 0.083:.3f} Y55\nG1 Y57\n"
    told = cone_contact_mm(text, _mesh(stands), box, HEADS["prusa_mk3s"])
    assert told == pytest.approx(0.083, abs=0.011)


@pytest.mark.slow
@pytest.mark.parametrize("cell_mm", [0.13, pytest.param(0.2, marks=pytest.mark.slow)])
def test_what_stands_of_a_large_part_is_known_in_wider_cells_and_cleared(cell_mm: float) -> None:
    # regression: a cone reads deeper in wider cells, and the checker refused such repairs, as of a
    # spool holder of 168 mm: "0.11 mm deep, limit 0.1 mm"
    block = _box((24.0, 24.0, 10.0), (100.0, 100.0, 0.0))
    crater = Solid.cylinder(6.0, 3.0, 7.0, 64).translate((112.0, 112.0, 5.03))
    piece, rest = block ^ crater, block - crater
    setup = load_setup()
    as_built = HeightField.from_manifold(rest, cell_mm, margin_mm=8.0)
    plan = slice_patch(
        piece, setup, as_built=as_built, grid=LayerGrid.from_setup(setup), standalone=True
    )
    program = write(plan.toolpath, setup, title="crater", resume=None, restore=False)
    assert not find_refusals(program, setup, as_built=as_built)
    assert sum(r.volume_mm3 * r.reachable_ratio for r in plan.regions) > 0.5 * piece.volume()
