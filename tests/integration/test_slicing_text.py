"""What corrective slicing promises, read off the text of the program that is printed."""

from __future__ import annotations

import json
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
import shapely
import trimesh
from typer.testing import CliRunner

from gcode.check import find_refusals
from gcode.cli.app import app
from gcode.errors import SliceError
from gcode.moves import Extrude, ModalState, Program
from gcode.profiles import PrintSetup, load_setup
from gcode.slicing.job import slice_part
from gcode.slicing.layers import LayerGrid
from gcode.slicing.options import DEFAULT_PART
from gcode.slicing.patch import slice_patch
from gcode.surfaces import HeightField
from gcode.writer import write
from tests.gcode_text import Step, beads_of, points_of, steps_of, ways_of

SETUP = load_setup()
TOP_MM = 4.0
BLOCK = m3.Manifold.cube((30.0, 30.0, TOP_MM)).translate((60.0, 60.0, 0.0))
PARK = (10.0, 200.0, 20.0)
JOB_C = 207.5
HOT = ModalState(PARK, 0.0, True, False, 50.0, 1.0, (JOB_C,), 60.0)
WRITTEN_MM = 2e-3  # of what is written to a micrometre, and of doubles


def box(size: tuple[float, float, float], at: tuple[float, float, float]) -> m3.Manifold:
    return m3.Manifold.cube(size).translate(at)


def highest_beside(
    field: HeightField, start_mm: np.ndarray, end_mm: np.ndarray, radius_mm: float
) -> float:
    """Greatest height within a radius of a straight way over a field."""
    x_mm, y_mm = np.meshgrid(*field.centres_mm())
    cells_mm = np.stack([x_mm, y_mm], axis=-1)
    way = end_mm[:2] - start_mm[:2]
    share = (cells_mm - start_mm[:2]) @ way / max(float(way @ way), 1e-12)
    nearest_mm = start_mm[:2] + np.clip(share, 0.0, 1.0)[..., None] * way
    beside = np.linalg.norm(cells_mm - nearest_mm, axis=2) <= radius_mm + field.cell_mm
    return float(field.z_mm[beside].max(initial=0.0))


POCKET = box((12.0, 9.0, 0.6), (69.0, 70.5, TOP_MM - 0.6))


def patch_of(
    missing: m3.Manifold,
    block: m3.Manifold = BLOCK,
    *,
    standalone: bool = False,
    setup: PrintSetup = SETUP,
) -> tuple[list[Step], Program, HeightField]:
    """The steps of a checked patch, its program, and what stood there."""
    field = HeightField.from_manifold(block - missing, 0.1, margin_mm=8.0)
    plan = slice_patch(
        missing,
        setup,
        as_built=field,
        grid=LayerGrid.from_setup(setup),
        standalone=standalone,
        start_mm=None if standalone else PARK,
        hotend_c=None if standalone else JOB_C,
    )
    state = None if standalone else HOT
    program = write(plan.toolpath, setup, title="patch", resume=state, restore=False)
    assert not find_refusals(program, setup, as_built=field, initial=state)
    return steps_of(program.text, (0.0, 0.0, 0.0) if standalone else PARK), program, field


def test_the_nozzle_is_primed_and_wiped_beside_the_part_before_it_touches_it() -> None:
    steps, _, field = patch_of(POCKET, standalone=True)
    printer = SETUP.printer
    before = steps[: next(k for k, step in enumerate(steps) if step.is_bead)]
    low = [step for step in before if min(step.start_mm[2], step.end_mm[2]) < field.top_mm]
    primed = next(k for k, step in enumerate(low) if step.e_mm > 0)
    prime, pull, wipe = low[primed : primed + 3]
    assert tuple(prime.end_mm) == printer.prime_mm
    assert prime.e_mm == pytest.approx(printer.prime_length_mm)
    assert prime.waited
    assert pull.e_mm == pytest.approx(-printer.retraction_mm)
    assert wipe.sideways_mm >= 3.0
    assert wipe.start_mm[2] == wipe.end_mm[2] == printer.prime_mm[2]
    assert wipe.e_mm == 0
    # all of it far from the part; the first bead is come down to with the filament pulled back
    for step in low[: primed + 3]:
        assert max(60.0 - step.end_mm[0], 60.0 - step.end_mm[1]) > 40.0
    *_, down, push = before
    assert down.pulled_mm == pytest.approx(printer.retraction_mm)
    assert down.sideways_mm == 0
    assert push.e_mm == pytest.approx(printer.retraction_mm)
    assert push.sideways_mm == 0


@pytest.mark.parametrize(
    ("printer", "wide_mm", "high_mm", "on_bed"),
    [
        ("ender_3", 60.0, 40.0, True),
        ("ender_3", 150.0, 12.0, False),  # the duct has no room beside it
        pytest.param("ender_3", 150.0, 40.0, False, marks=pytest.mark.slow),
        pytest.param("prusa_mk3s", 180.0, 40.0, False, marks=pytest.mark.slow),
        ("prusa_mk3s", 180.0, 10.0, True),  # not at the profile's own place
    ],
)
def test_it_primes_where_the_head_has_room_or_from_above(
    printer: str, wide_mm: float, high_mm: float, on_bed: bool
) -> None:
    """regression: at the profile's place whatever stood there; the checker then refused it all."""
    setup = load_setup(printer)
    x, y = (0.5 * (side - wide_mm) for side in setup.printer.bed_size_mm)
    block = box((wide_mm, wide_mm, high_mm), (x, y, 0.0))
    missing = box((12.0, 9.0, 0.6), (x + 20.0, y + 20.0, high_mm - 0.6))
    steps, _, field = patch_of(missing, block, standalone=True, setup=setup)
    prime, *after = steps[next(k for k, step in enumerate(steps) if step.e_mm > 0) :]
    assert prime.e_mm == pytest.approx(setup.printer.prime_length_mm)
    assert highest_beside(field, prime.end_mm, prime.end_mm, 5.0) <= 0.0
    if on_bed:
        assert prime.end_mm[2] == setup.printer.prime_mm[2]
        assert after[1].sideways_mm == pytest.approx(4.0)
        assert after[1].end_mm[2] == prime.end_mm[2]
    else:
        assert prime.end_mm[2] > high_mm
    assert after[0].e_mm == pytest.approx(-setup.printer.retraction_mm)


def test_a_full_bed_has_no_place_to_prime() -> None:
    full = box((250.0, 210.0, 3.0), (0.0, 0.0, 0.0))
    with pytest.raises(SliceError, match="no bare place"):
        patch_of(box((12.0, 9.0, 0.6), (90.0, 90.0, 2.4)), full, standalone=True)


@pytest.mark.parametrize("standalone", [False, True])
def test_between_beads_it_combs_over_the_patch_or_pulls_back_and_clears_what_stands(
    standalone: bool,
) -> None:
    rim = box((0.8, 30.0, 1.0), (74.6, 60.0, TOP_MM))
    tower = box((4.0, 4.0, 20.0), (75.0, 120.0, 0.0))
    left = box((4.6, 9.0, 0.8), (69.0, 70.5, TOP_MM - 0.8))
    right = box((4.0, 9.0, 0.8), (77.0, 70.5, TOP_MM - 0.8))
    steps, _, field = patch_of(left + right, BLOCK + rim + tower, standalone=standalone)
    pockets = [np.array(one.bounding_box()).reshape(2, 3)[:, :2] for one in (left, right)]
    kept, lifted = 0, 0
    for way in ways_of(steps):
        across = [step for step in way if step.sideways_mm > WRITTEN_MM]
        if not any(step.e_mm < 0 for step in way):
            kept += 1
            for step in across:
                assert step.start_mm[2] == step.end_mm[2]
                ends = np.stack([step.start_mm, step.end_mm])[:, :2]
                assert any(((low < ends) & (ends < high)).all() for low, high in pockets)
            continue
        lifted += 1
        assert sum(step.e_mm for step in way) == pytest.approx(0.0, abs=2e-5)
        for step in across:
            assert step.pulled_mm == pytest.approx(SETUP.printer.retraction_mm)
            over_mm = highest_beside(field, step.start_mm, step.end_mm, 0.5)
            assert min(step.start_mm[2], step.end_mm[2]) > over_mm
            # along the way: over the rim, not as high as the tower
            assert TOP_MM + 1.0 < step.end_mm[2] < TOP_MM + 3.0
    assert kept > 5
    assert lifted == 1  # from one pocket to the other, over the rim
    assert sum(step.e_mm for step in steps if not step.is_bead) == pytest.approx(
        (SETUP.printer.prime_length_mm - SETUP.printer.retraction_mm) if standalone else 0.0,
        abs=1e-4,
    )


def test_a_whole_part_is_combed_inside_its_walls() -> None:
    part = box((30.0, 10.0, 0.6), (60.0, 60.0, 0.0)) + box((10.0, 30.0, 0.6), (60.0, 60.0, 0.0))
    outline = shapely.union(shapely.box(60, 60, 90, 70), shapely.box(60, 60, 70, 90)).buffer(1e-3)
    program = write(slice_part(part, SETUP), SETUP, title="part")
    steps = [step for step in steps_of(program.text) if step.layer > 0]
    combed = 0
    for way in ways_of(steps):
        across = [step for step in way if step.sideways_mm > DEFAULT_PART.short_travel_mm]
        if any(step.e_mm < 0 for step in way):
            assert all(step.pulled_mm > 0 for step in across)
            continue
        for step in across:
            combed += 1
            way_mm = shapely.LineString([step.start_mm[:2], step.end_mm[:2]])
            assert way_mm.within(outline)
    assert combed > 0


def test_seams_of_a_patch_lie_beside_old_material() -> None:
    """Loops along the part's sides begin at their inner side, where the seam does not show."""
    for x, y, outward in (
        (69.0, 60.0, (0.0, -1.0)),
        (69.0, 84.0, (0.0, 1.0)),
        (60.0, 69.0, (-1.0, 0.0)),
        (84.0, 69.0, (1.0, 0.0)),
    ):
        steps, *_ = patch_of(box((6.0, 6.0, 0.6), (x, y, TOP_MM - 0.6)))
        loops = [points_of(bead) for bead in beads_of(steps)]
        loops = [loop for loop in loops if np.allclose(loop[0], loop[-1], atol=WRITTEN_MM)]
        assert loops
        for loop in loops:
            along = loop[:, :2] @ np.array(outward)
            assert along[0] < along.max() - 1.0


def test_seams_of_a_part_lie_in_its_inward_corner() -> None:
    part = box((30.0, 10.0, 2.0), (60.0, 60.0, 0.0)) + box((10.0, 30.0, 2.0), (60.0, 60.0, 0.0))
    steps = steps_of(write(slice_part(part, SETUP), SETUP, title="part").text)
    outer = [bead for bead in beads_of(steps) if bead[0].role == "External perimeter"]
    assert len(outer) == 10
    for bead in outer:
        assert np.hypot(*(bead[0].start_mm[:2] - (70.0, 70.0))) < 0.5


@pytest.mark.parametrize("standalone", [False, True])
def test_the_first_pass_is_slower_and_hotter_and_the_rest_is_not(standalone: bool) -> None:
    # regression: a patch of its own was laid as hot as its first bead to the end, and one in
    # mid-job was never hotter
    fast = SETUP.process.model_copy(update={"repair_speed_mm_s": 35.0})
    setup = PrintSetup(SETUP.printer, SETUP.material, fast)
    steps, program, _ = patch_of(POCKET, standalone=standalone, setup=setup)
    own_c = setup.material.hotend_c if standalone else JOB_C
    beads = [step for step in steps if step.is_bead]
    first = [step for step in beads if step.layer == 1]
    rest = [step for step in beads if step.layer > 1]
    hotter_c = own_c + setup.material.repair_first_bead_delta_c
    assert hotter_c > own_c
    assert {(step.hot_c, step.waited) for step in first} == {(hotter_c, True)}
    assert {step.hot_c for step in rest} == {own_c}
    assert {step.feed_mm_s for step in first} == {setup.process.first_layer_speed_mm_s}
    assert {step.feed_mm_s for step in rest} == {35.0}
    told = [line for line in program.text.splitlines() if "onto cold material" in line]
    assert told == [
        f"; first pass, onto cold material: {hotter_c:g} C ({hotter_c - own_c:g} C more than the "
        f"rest), at most {setup.process.first_layer_speed_mm_s:g} mm/s (as what else lies on cold "
        "material)"
    ]
    if not standalone:  # what the job goes on with
        heats = [line for line in program.text.splitlines() if line.startswith(("M104", "M109"))]
        assert heats == [f"M109 S{hotter_c:g}", f"M104 S{own_c:g}"]


def test_what_lies_on_cold_material_is_slow_in_every_pass_and_what_lies_on_beads_is_not() -> None:
    # regression: of a notch whose floor rises in steps only the lowest pass was laid slowly; on the
    # steps above it beads lay on material as cold, as fast as on others
    fast = SETUP.process.model_copy(update={"repair_speed_mm_s": 35.0})
    setup = PrintSetup(SETUP.printer, SETUP.material, fast)
    block = m3.Manifold.cube((24.0, 20.0, 6.0)).translate((100.0, 90.0, 0.0))
    steps = [m3.Manifold.cube((6.0 * (k + 1), 20.0, 0.4)).translate((100.0, 90.0, 4.8 + 0.4 * k))
             for k in range(3)]  # fmt: skip
    gone = m3.Manifold.batch_boolean(steps, m3.OpType.Add)
    field = HeightField.from_manifold(block - gone, 0.1, margin_mm=15.0)
    plan = slice_patch(
        gone, setup, as_built=field, grid=LayerGrid.from_setup(setup), standalone=True
    )
    right_mm = all_mm = 0.0
    for move in plan.toolpath:
        if not isinstance(move, Extrude):
            continue
        middles = 0.5 * (move.points_mm[1:] + move.points_mm[:-1])
        floor_mm = 4.8 + 0.4 * np.clip((middles[:, 0] - 100.0) // 6.0, 0, 2)
        cold = middles[:, 2] - floor_mm < 0.25
        slow = move.speed_mm_s == setup.process.first_layer_speed_mm_s
        lengths_mm = np.linalg.norm(np.diff(move.points_mm, axis=0), axis=1)
        right_mm += float(lengths_mm[cold == slow].sum())
        all_mm += float(lengths_mm.sum())
    assert right_mm > 0.9 * all_mm  # but where a stretch runs over an edge


def test_a_job_as_hot_as_the_hotend_gets_is_not_heated_beyond_it() -> None:
    limited = SETUP.printer.model_copy(update={"max_hotend_c": JOB_C + 2.0})
    setup = PrintSetup(limited, SETUP.material, SETUP.process)
    steps, *_ = patch_of(POCKET, setup=setup)
    assert {step.hot_c for step in steps if step.layer == 1 and step.is_bead} == {JOB_C + 2.0}


VARIABLE_TOPS_MM = (0.2, 0.4, 0.6, 0.85, 1.1, 1.35, 1.6, 1.75, 1.87, 1.97, 2.05, 2.2, 2.4, 2.6)


def variable_job() -> str:
    """A slicer's file whose layers are as thick as the shape allows."""
    lines = ["M140 S60", "M104 S215", "M190 S60", "M109 S215", "G28", "G90", "M83"]
    for z_mm in VARIABLE_TOPS_MM:
        lines += [";LAYER_CHANGE", f";Z:{z_mm:g}", f"G1 Z{z_mm:g} F720", "G1 X60 Y60 F6000"]
        lines += ["G1 X90 E1 F1200", "G1 Y90 E1", "G1 X60 E1", "G1 Y60 E1"]
    return "\n".join([*lines, "M104 S0", "M140 S0"]) + "\n"


def saved(solid: m3.Manifold, path: Path) -> Path:
    mesh = solid.to_mesh64()
    vertices = np.array(mesh.vert_properties)[:, :3]
    trimesh.Trimesh(vertices, np.array(mesh.tri_verts).astype(int), process=False).export(path)
    return path


def test_passes_lie_on_the_jobs_own_layers_of_whatever_height(tmp_path: Path) -> None:
    block = box((30.0, 30.0, 2.6), (60.0, 60.0, 0.0))
    missing = box((12.0, 9.0, 1.5), (69.0, 70.5, 1.1))
    job, output = tmp_path / "job.gcode", tmp_path / "patch.gcode"
    job.write_text(variable_job())
    words = ["slice", str(saved(missing, tmp_path / "missing.stl")), "-o", str(output)]
    words += ["--as-built", str(saved(block - missing, tmp_path / "standing.stl"))]
    done = CliRunner().invoke(app, [*words, "--job", str(job)])
    assert done.exit_code == 0, done.output
    beads = [step for step in steps_of(output.read_text()) if step.is_bead]
    heights = {round(float(step.end_mm[2]), 3) for step in beads}
    assert len(heights) >= 5
    assert heights <= set(VARIABLE_TOPS_MM)
    assert max(heights) == VARIABLE_TOPS_MM[-1]
    # thin ones among them: the regular grid has none of these
    assert heights & {1.35, 1.75, 1.87, 1.97, 2.05}


def test_what_is_too_thin_is_listed_with_its_volume(tmp_path: Path) -> None:
    """A blade of 1.2 mm that runs out to nothing: what is not laid is what is listed."""
    base = box((40.0, 10.0, 2.0), (60.0, 60.0, 0.0))
    flat = m3.CrossSection([[(62.0, 64.4), (92.0, 65.0), (62.0, 65.6)]])
    blade = flat.extrude(1.0).translate((0.0, 0.0, 2.0))
    output = tmp_path / "patch.gcode"
    words = ["slice", str(saved(blade, tmp_path / "blade.stl")), "-o", str(output), "--json"]
    words += ["--as-built", str(saved(base, tmp_path / "base.stl"))]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    left_out = json.loads(done.stdout)["left_out"]
    laid_mm3 = sum(step.volume_mm3 for step in steps_of(output.read_text()) if step.is_bead)
    listed_mm3 = sum(thing["volume_mm3"] for thing in left_out)
    assert laid_mm3 > 0.8 * blade.volume()
    assert laid_mm3 + listed_mm3 == pytest.approx(blade.volume(), rel=0.03)
    assert all(thing["reason"] for thing in left_out)
