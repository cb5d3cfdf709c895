"""Defects: their grammar, and places that are really there on any part."""

from __future__ import annotations

from collections.abc import Callable

import manifold3d as m3
import numpy as np
import pytest
import trimesh

from amrepair.errors import InputError
from amrepair.frames import Transform
from amrepair.scans import ScanRequest
from amrepair.simulate.defects import PlacedDefect, parse_defect, place
from amrepair.simulate.part_files import part_path
from amrepair.simulate.run import prepare_run
from amrepair.simulate.scanner import ScannerPose, SimulatedScanner
from amrepair.simulate.stage import Stage
from amrepair.simulate.world import World
from amrepair.template import MeshSdf
from gcode.firmware.motion import MotionBatch
from gcode.profiles import load_setup
from gcode.reader import read_job
from gcode.slicing.job import plan_part
from gcode.writer import write

PARTS = {
    "block": m3.Manifold.cube((30, 30, 10)),
    "thin": m3.Manifold.cube((40, 6, 20)),
    "ball": m3.Manifold.sphere(12, 64).trim_by_plane((0, 0, 1), -8).translate((0, 0, 8)),
    "small": m3.Manifold.cylinder(6, 6, 6, 64),
}


def tops(part: m3.Manifold) -> np.ndarray:
    return np.arange(1, round(part.bounding_box()[5] / 0.2) + 1) * 0.2


def test_grammar_fills_in_defaults_and_keeps_what_was_said() -> None:
    defect = parse_defect("void:diameter=8, layers=3")
    assert defect.kind == "void"
    assert defect.values["diameter"] == 8
    assert defect.values["layers"] == 3
    assert parse_defect(str(defect)) == defect


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("hole", "under_extrusion"),
        ("void:depth=1", "diameter"),
        ("void:diameter=wide", "from 2 to 40"),
        ("void:diameter", "from 2 to 40"),
        ("chip:size=nan", "from 1.5 to 40"),
        ("under_extrusion:flow=1.5", "from 0 to 0.95"),
        ("none:size=1", "none"),
    ],
)
def test_bad_defects_are_refused_with_what_is_allowed(text: str, names: str) -> None:
    with pytest.raises(InputError, match=names):
        parse_defect(text)


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("seed", range(3))
def test_void_lies_inside_the_part_in_every_one_of_its_layers(name: str, seed: int) -> None:
    part = PARTS[name].translate((100, 80, 0))
    placed = place(parse_defect("void"), part, tops(part), np.random.default_rng(seed))
    assert placed.last_layer == placed.layers[-1]
    x, y, cos, sin, a, b, *_ = placed.flow_regions[0]
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    u, v = a * np.cos(angle), b * np.sin(angle)
    ring = m3.CrossSection([np.stack([x + u * cos - v * sin, y + u * sin + v * cos], axis=1)])
    for layer in placed.layers:
        section = part.slice(float(tops(part)[layer]) - 0.1)
        assert (ring - section).area() < 1e-6


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("kind", ["chip", "blob", "under_extrusion"])
def test_other_defects_touch_the_part(name: str, kind: str) -> None:
    part = PARTS[name].translate((100, 80, 0))
    placed = place(parse_defect(kind), part, tops(part), np.random.default_rng(5))
    if kind == "chip":
        assert placed.removed is not None
        taken = part ^ placed.removed
        assert taken.volume() > 3.0
        # open above: nothing of the part is left over what broke off
        rest = part - placed.removed
        for lift_mm in (0.5, 2.0, 5.0):
            assert (rest ^ taken.translate((0, 0, lift_mm))).volume() < 0.02 * taken.volume()
    elif kind == "blob":
        assert placed.added is not None
        assert (placed.added - part).volume() > 1.0
        assert part.min_gap(placed.added, 1.0) == 0.0
    else:
        assert placed.layers


def test_placing_is_seeded() -> None:
    part = PARTS["block"]
    first, second, other = (
        place(parse_defect("void"), part, tops(part), np.random.default_rng(seed))
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.flow_regions, second.flow_regions)
    assert not np.array_equal(first.flow_regions, other.flow_regions)


def test_part_without_room_is_refused() -> None:
    needle = m3.Manifold.cube((1, 1, 20))
    with pytest.raises(InputError, match="no room"):
        place(parse_defect("void"), needle, tops(needle), np.random.default_rng(0))


def test_a_default_defect_without_room_is_left_out_and_said() -> None:
    # regression: a printed hotend holder whose top is a dome's tip was refused after 48 s
    spike = m3.Manifold.cylinder(5.0, 0.8, 0.1, 16).translate((15.0, 15.0, 3.9))
    solid = (m3.Manifold.cube((30.0, 30.0, 4.0)) + spike).to_mesh64()
    part = MeshSdf.from_mesh(trimesh.Trimesh(solid.vert_properties, solid.tri_verts))
    asked, setup = [parse_defect("void"), parse_defect("chip")], load_setup(process="repair_0.30")
    with pytest.raises(InputError, match="no room for the defect chip"):
        prepare_run(part, setup, asked, title="spike")
    with pytest.raises(InputError, match="no room for the defect chip"):
        prepare_run(part, setup, asked[1:], title="spike", where_room=True)
    run = prepare_run(part, setup, asked, title="spike", where_room=True)
    assert [defect.kind for defect in run.defects] == ["void"]
    assert len(run.left_out) == 1


def test_bracket_is_found_and_other_names_are_refused() -> None:
    assert part_path("bracket").is_file()
    with pytest.raises(InputError, match="bracket"):
        part_path("teapot")


def test_skipped_beads_lie_on_the_jobs_own_lines() -> None:
    part = m3.Manifold.cube((30, 20, 4)).translate((60, 60, 0))
    program = write(plan_part(part, load_setup()).toolpath, load_setup(), title="test")
    job = read_job(program, filament_diameter_mm=1.75, dialect=program.dialect)
    defect = parse_defect("missing_beads:beads=3,layers=2,layer=9")
    beads = job.beads
    placed = place(defect, part, tops(part), np.random.default_rng(1), beads=beads)
    assert placed.layers == (8, 9)
    assert len(placed.flow_regions) == 6
    whole, broken = World((250.0, 210.0)), World((250.0, 210.0))
    mine = beads.layer <= 9
    length_mm = np.linalg.norm(beads.end_mm - beads.start_mm, axis=1)
    motion = MotionBatch(
        beads.start_mm[mine],
        beads.end_mm[mine],
        (length_mm * beads.section_mm2 / (np.pi / 4 * 1.75**2))[mine],
        np.full(mine.sum(), 50.0),
        np.arange(mine.sum()) * 1.0,
    )
    lost_mm3 = whole.deposit(motion) - broken.deposit(motion, [placed])
    skipped_mm = 2 * placed.flow_regions[:, 4].sum()
    # whole steps of 0.2 mm at either end, and the two neighbours' spacing
    assert lost_mm3 == pytest.approx(skipped_mm * 0.407 * 0.2, rel=0.15)
    with pytest.raises(InputError, match="no job"):
        place(defect, part, tops(part), np.random.default_rng(1))


def stage_of(
    world: World, defect: PlacedDefect, take_motion: Callable[[], MotionBatch], *, size_mm: float
) -> Stage:
    """A stage of one defect, looked at from straight above; truth is compared from (17, 17) on."""
    identity = Transform.identity("build", "scanner")
    return Stage(
        world,
        defects=[defect],
        scanner=SimulatedScanner(
            world,
            pose=ScannerPose(identity, identity),
            sensors_mm=np.array([[30.0, 30.0, 200.0]]),
            rng=np.random.default_rng(0),
        ),
        take_motion=take_motion,
        box_mm=(17.0, 17.0, 17.0 + size_mm, 17.0 + size_mm),
    )


@pytest.mark.slow
def test_truth_says_how_even_a_repair_is_and_what_it_added() -> None:
    world = World((60.0, 60.0))
    block = m3.Manifold.cube((16, 16, 2)).translate((20, 20, 0))
    hole = m3.Manifold.cube((4, 4, 1)).translate((26, 26, 1))
    box = np.array([[26.0, 26, 1], [30, 30, 2]])
    defect = PlacedDefect("chip", (), np.zeros((0, 9)), hole, None, box)
    none = MotionBatch.concatenate([])
    stage = stage_of(world, defect, lambda: none, size_mm=22.0)
    for one in (stage.world, stage.reference):
        one.add(block)
    request = ScanRequest("final", None, 2.0)
    stage.scan(request)
    assert stage.truth[0].surface_ratio < 0.3  # a column beside each wall is even sideways
    world.add(m3.Manifold.cube((4, 3, 1.05)).translate((26, 26, 1)))  # 3/4 filled, 0.05 too high
    stage.scan(request)
    truth = stage.truth[0]
    assert truth.missing_mm3 == pytest.approx(16.0)
    assert truth.filled_mm3 == pytest.approx(12.0)
    assert truth.added_mm3 == pytest.approx(12 * 0.05)
    assert truth.surface_ratio == pytest.approx(3 / 4, abs=0.08)


def test_truth_counts_what_each_layer_of_a_defect_took_away() -> None:
    def lines(z: float, flow: float = 1.0) -> MotionBatch:
        y = 20.0 + 0.4 * np.arange(20)
        start = np.column_stack([np.full(20, 20.0), y, np.full(20, z)])
        end = start + np.array([10.0, 0.0, 0.0])
        pushed = np.full(20, flow * 10.0 * 0.4 * 0.2 / (np.pi / 4 * 1.75**2))
        return MotionBatch(start, end, pushed, np.full(20, 50.0), np.arange(20) * 1.0)

    world = World((60.0, 60.0))
    hole = np.array([[25.0, 24.0, 1.0, 0.0, 2.0, 2.0, -1.0, 1.0, 0.0]])
    box = np.array([[22.5, 21.5, -1.0], [27.5, 26.5, 1.0]])
    defect = PlacedDefect("void", (0, 1), hole, None, None, box)
    waiting = [lines(0.2), MotionBatch.concatenate([]), lines(0.4)]
    stage = stage_of(world, defect, lambda: waiting.pop(0), size_mm=16.0)
    one_layer_mm3 = np.pi * 2.0**2 * 0.2
    stage.scan(ScanRequest("layer-000", 0, 0.2))
    world.add(m3.Manifold.cylinder(0.2, 3.0, 3.0, 64).translate((25, 24, 0)))  # a perfect repair
    stage.scan(ScanRequest("layer-000", 0, 0.2))
    (first,) = stage.truth
    assert first.missing_mm3 == pytest.approx(one_layer_mm3, rel=0.1)
    assert first.filled_mm3 == pytest.approx(first.missing_mm3)
    stage.scan(ScanRequest("layer-001", 1, 0.4))
    (both,) = stage.truth
    assert both.label == "layer-001"
    assert both.missing_mm3 == pytest.approx(2 * one_layer_mm3, rel=0.1)
    assert both.filled_mm3 == pytest.approx(first.filled_mm3)  # the second is still open
    waiting += [lines(0.6, flow=2.0), MotionBatch.concatenate([])]
    stage.finish()
    assert stage.truth[0].filled_mm3 == both.filled_mm3  # as it was at its own stop
    stage.finish(measure=True)
    assert stage.truth[0].filled_mm3 > both.filled_mm3 + 0.3 * one_layer_mm3  # the next layer's
