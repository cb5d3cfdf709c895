"""Plastic and light against what can be worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import manifold3d as m3
import numpy as np
import pytest

from amrepair.frames import Transform
from amrepair.scans.scanner import ScanRequest
from amrepair.simulate.columns import IntervalMap
from amrepair.simulate.flow import noisy_flow
from amrepair.simulate.parameters import ScannerModel, ThermalModel, load_world
from amrepair.simulate.scanner import ScannerPose, SimulatedScanner
from amrepair.simulate.world import World
from gcode.firmware.motion import MotionBatch
from tests.unit.test_simulate_world import (
    HEIGHT_MM,
    SECTION_MM2,
    SPACING_MM,
    Nozzle,
    block,
    commanded_mm3,
)

IDENTITY = Transform.identity("build", "scanner")
REQUEST = ScanRequest("final", None, 8.0)


def strip(world: World, x_mm: float, wide_mm: float = 0.5) -> IntervalMap:
    """What stands across a strand along X at y = 30."""
    return world.snapshot(world.columns.box_window((x_mm - wide_mm, 28.0), (x_mm + wide_mm, 32.0)))


def strand(world: World, x0: float, x1: float, z: float) -> float:
    """Lay a strand along X at y = 30.03 and leave; returns the volume commanded."""
    nozzle = Nozzle()
    if z > HEIGHT_MM:  # a crumb beside it, a layer lower: that there are layers of 0.2 mm
        nozzle.go(x0, 34, z - HEIGHT_MM)
        nozzle.go(x0 + 1, 34, z - HEIGHT_MM, SECTION_MM2)
    nozzle.go(x0, 30.03, z + 1)
    nozzle.go(x0, 30.03, z)
    nozzle.go(x1, 30.03, z, SECTION_MM2)
    nozzle.go(x1, 30.03, z + 5)
    motion = nozzle.batch()
    world.deposit(motion)
    return commanded_mm3(motion)


@pytest.mark.parametrize("flow", [1.0, 0.96])
def test_a_stack_stands_at_the_nozzles_height_and_what_it_lacks_is_between_its_beads(
    flow: float,
) -> None:
    # slicers give a bead the section w h - (1 - pi/4) h² and lay it that far apart: the volume of
    # a full layer; with less, grooves stay open, and nothing sinks
    world, lines, layers = World((60.0, 60.0)), 20, 25
    motion = block((20.03, 20.01), lines, layers, flow=flow)
    world.deposit(motion)
    solid = world.snapshot()
    assert solid.volume_mm3 == pytest.approx(commanded_mm3(motion), rel=1e-9)
    inside = world.snapshot(world.columns.box_window((21.0, 21.0), (27.0, 27.0)))
    off_mm = inside.top_mm() - layers * HEIGHT_MM
    # a groove's column is low by the layer's own open share, and by what is too low for a void;
    # had grooves been filled, the top would lie 25 layers' open share lower: 0.2 and 0.4 mm
    assert np.median(off_mm) == pytest.approx(0.0, abs=1e-6)
    assert off_mm.mean() == pytest.approx(0.0, abs=(1 - flow) * HEIGHT_MM + 0.02)
    share = inside.thickness_mm(HEIGHT_MM, (layers - 1) * HEIGHT_MM).mean()
    assert share / ((layers - 2) * HEIGHT_MM) == pytest.approx(flow, abs=0.012)


def layered(flows: list[float], lines: int = 20) -> MotionBatch:
    """A block whose layers have flows of their own."""
    motion = block((20.03, 20.01), lines, len(flows))
    layer = np.rint(motion.end_mm[:, 2] / HEIGHT_MM).astype(int) - 1
    share = np.array([*flows, *[1.0] * 99])[layer]
    return replace(motion, filament_mm=motion.filament_mm * share)


def test_too_much_plastic_is_pressed_into_the_voids_right_under_it() -> None:
    # every other layer lacks as much as the one above it has too much
    scant, even = World((60.0, 60.0)), World((60.0, 60.0))
    scant.deposit(layered([1.0, *[0.95, 1.05] * 8, 1.0]))
    even.deposit(layered([1.0, *[0.95, 1.0] * 8, 1.0]))
    shares = []
    for world in (scant, even):
        inside = world.snapshot(world.columns.box_window((21.0, 21.0), (27.0, 27.0)))
        off_mm = inside.top_mm() - 18 * HEIGHT_MM
        assert off_mm.mean() == pytest.approx(0.0, abs=0.02)
        shares.append(inside.thickness_mm(HEIGHT_MM, 17 * HEIGHT_MM).mean() / (16 * HEIGHT_MM))
    assert shares[0] == pytest.approx(1.0, abs=0.01)
    assert shares[1] == pytest.approx(0.975, abs=0.005)


def test_wandering_flow_leaves_a_stack_at_the_nozzles_height() -> None:
    world = World((60.0, 60.0))
    motion = noisy_flow(block((20.03, 20.01), 20, 50), np.random.default_rng(3), load_world().flow)
    world.deposit(motion)
    assert world.volume_mm3 == pytest.approx(commanded_mm3(motion), rel=1e-9)
    inside = world.snapshot(world.columns.box_window((21.0, 21.0), (27.0, 27.0)))
    assert inside.top_mm().mean() == pytest.approx(50 * HEIGHT_MM, abs=0.05)


@pytest.mark.parametrize(("over_mm", "is_planed"), [(0.08, True), (0.4, False)])
def test_the_nozzles_flat_planes_off_a_ridge_and_takes_it_along(
    over_mm: float, is_planed: bool
) -> None:
    world = World((60.0, 60.0))
    world.add(m3.Manifold.cube((40, 4, 1.0)).translate((10, 28, 0)))
    world.add(m3.Manifold.cube((0.25, 0.25, 0.2 + over_mm)).translate((30, 30, 1.0)))
    before_mm3 = world.volume_mm3
    laid = strand(world, 20, 40, 1.2)
    assert world.volume_mm3 - before_mm3 == pytest.approx(laid, rel=1e-9)
    top_mm = strip(world, 30.0, 2.0).top_mm().max()
    assert (top_mm < 1.201) if is_planed else (top_mm == pytest.approx(1.2 + over_mm))


def test_lone_bead_has_the_section_that_was_pushed() -> None:
    world = World((60.0, 60.0))
    strand(world, 10, 50, HEIGHT_MM)
    middle = strip(world, 30.0, 10.0)
    across = middle.thickness_mm().mean(axis=1)
    assert across.sum() * world.cell_mm == pytest.approx(SECTION_MM2, rel=0.005)
    assert middle.top_mm().max() == pytest.approx(HEIGHT_MM, abs=1e-6)
    # as wide, on average, as the stadium of the same height and section
    assert (across / HEIGHT_MM).sum() * world.cell_mm == pytest.approx(SPACING_MM, rel=0.005)
    # the outermost columns are only grazed; nothing lies a whole column beyond the stadium
    assert (across > 1e-3).sum() * world.cell_mm < 0.45 + 2 * world.cell_mm


def test_bridge_sags_as_the_square_of_its_length() -> None:
    for gap_mm in (8.0, 20.0):
        world = World((60.0, 60.0))
        for x0 in (30 - gap_mm / 2 - 5, 30 + gap_mm / 2):
            world.add(m3.Manifold.cube((5, 5, 8.0)).translate((x0, 27.5, 0)))
        before_mm3 = world.volume_mm3
        laid = strand(world, 30 - gap_mm / 2 - 3, 30 + gap_mm / 2 + 3, 8.2)
        assert world.volume_mm3 - before_mm3 == pytest.approx(laid, rel=1e-9)
        for share in (0.5, 0.25):
            low = strip(world, 30 + (share - 0.5) * gap_mm, 0.2)
            sag_mm = 0.001 * gap_mm**2 * 4 * share * (1 - share)
            # the ends hold a bore's radius beyond the rims; a step is 0.2 mm long
            assert low.top_mm().max() == pytest.approx(8.2 - sag_mm, abs=0.012 * gap_mm / 8)
            assert low.bounds_mm()[0, 2] > 7.0  # nothing fell


def test_cantilever_droops_and_then_lies_on_what_is_below() -> None:
    world = World((60.0, 60.0))
    world.add(m3.Manifold.cube((8, 8, 6.0)).translate((10, 26, 0)))
    before_mm3 = world.volume_mm3
    laid = strand(world, 12, 40, 6.2)
    assert world.volume_mm3 - before_mm3 == pytest.approx(laid, rel=1e-9)
    for beyond_mm in (1.0, 2.0, 4.0):
        here = strip(world, 18 + beyond_mm, 0.1).top_mm().max()
        # steps of 0.2 mm on a parabola of slope 0.2 x, from a hold a bore's radius early or late
        assert here == pytest.approx(6.2 - 0.1 * beyond_mm**2, abs=0.06 + 0.06 * beyond_mm)
    far = strip(world, 32.0, 4.0).bounds_mm()
    assert far is not None
    assert far[0, 2] == 0.0
    assert far[1, 2] < 0.45  # a strand of 0.32 mm across on the bed


def test_strand_in_the_air_falls_and_none_of_it_is_lost() -> None:
    world = World((60.0, 60.0))
    world.add(m3.Manifold.cube((4, 10, 2.0)).translate((28, 25, 0)))
    before_mm3 = world.volume_mm3
    laid = strand(world, 20, 40, 6.2)
    assert world.volume_mm3 - before_mm3 == pytest.approx(laid, rel=1e-9)
    assert strip(world, 22.0).bounds_mm()[1, 2] < 0.45
    assert 2.0 < strip(world, 30.0).bounds_mm()[1, 2] < 2.45


def test_strand_beside_its_neighbour_hangs_on_it() -> None:
    world = World((60.0, 60.0))
    world.add(m3.Manifold.cube((30, 1, 4.2)).translate((15, 28.8, 0)))  # ends at y = 29.8
    strand(world, 16, 44, 4.2)
    assert strip(world, 30.0).clipped(np.array([[0.0, 29.95, 0.0], [60.0, 32.0, 9.0]])).bounds_mm()[
        0, 2
    ] == pytest.approx(4.0, abs=0.01)


def test_a_bridge_s_thick_strands_hang_and_push_nothing_aside() -> None:
    # regression: as thick as their layer they had no room beside one another, and where a slicer
    # bridges in every layer, as under a slope, walls were pushed out by 0.6 mm: blobs of clean jobs
    world, nozzle, bore_mm, section_mm2 = World((60.0, 60.0)), Nozzle(), 0.4, 0.1414
    world.add(m3.Manifold.cube((40, 1, 6.0)).translate((10, 26.8, 0)))  # ends at y = 27.8
    for x0 in (10, 45):
        world.add(m3.Manifold.cube((5, 10, 5.8)).translate((x0, 26.8, 0)))
    nozzle.go(11, 40, 5.8)
    nozzle.go(12, 40, 5.8, SECTION_MM2)  # that there are layers of 0.2 mm
    lines_y = 28.0 + 0.45 * np.arange(12)
    for y in lines_y:
        nozzle.go(11, y, 7.0)
        nozzle.go(11, y, 6.0)
        nozzle.go(49, y, 6.0, section_mm2)
    nozzle.go(49, 40, 9.0)
    before_mm3 = world.volume_mm3
    motion = nozzle.batch()
    world.deposit(motion)
    assert world.volume_mm3 - before_mm3 == pytest.approx(commanded_mm3(motion), rel=1e-9)
    hang = world.snapshot(world.columns.box_window((20.0, 27.8), (40.0, 36.0)))
    low, high = hang.bounds_mm()
    assert high[1] < lines_y[-1] + 0.5 * bore_mm + 2 * world.cell_mm
    assert high[2] < 6.0 + 0.02
    assert low[2] == pytest.approx(6.0 - section_mm2 / bore_mm, abs=0.05)


def test_groove_is_spanned_and_a_trench_is_filled() -> None:
    for wide_mm, y0, is_spanned in (
        (0.125, 30.0, True),
        (0.25, 29.875, True),
        (0.625, 29.75, False),
    ):
        world = World((60.0, 60.0))
        world.add(m3.Manifold.cube((20, 20, 1.0)).translate((20, 20, 0)))
        world.remove(m3.Manifold.cube((20, wide_mm, 0.2)).translate((20, y0, 0.8)))
        strand(world, 25, 35, 1.2)
        low = world.snapshot(
            world.columns.box_window((29.0, y0), (31.0, y0 + wide_mm))
        ).thickness_mm(0.8, 1.0)
        # spanned: it bulges in by at most a semicircle's mean depth
        most_mm = np.pi / 8 * wide_mm + 0.001
        assert (low.mean() <= most_mm) if is_spanned else (low.mean() > 0.08), wide_mm


def wall(thermal: ThermalModel) -> World:
    """A wall three beads wide, 56 mm long, 20 layers."""
    world = World((60.0, 60.0), thermal=thermal)
    nozzle = Nozzle()
    for layer in range(20):
        z = HEIGHT_MM * (layer + 1)
        for line in range(3):
            y = 30.03 + (line - 1) * SPACING_MM
            nozzle.go(2.0, y, z)
            nozzle.go(58.0, y, z, SECTION_MM2)
    nozzle.go(30.0, 30.0, 20.0)
    world.deposit(nozzle.batch())
    return world


def test_curled_ends_rise_under_the_nozzle_which_goes_on_at_its_height() -> None:
    thermal = ThermalModel(curl_per_mm=2e-4, held_mm=5.0, warm_mm=1.0)
    flat, curled = wall(ThermalModel()), wall(thermal)
    assert curled.volume_mm3 == pytest.approx(flat.volume_mm3, rel=1e-9)
    away_mm = 25.0  # from the middle, 30
    lift_mm = thermal.curl_per_mm * away_mm**2
    foot = curled.as_cooled(np.array([[55.0, 30.0, 0.0], [30.0, 30.0, 0.0]]))
    np.testing.assert_allclose(foot[:, 2], [lift_mm * (1 - np.exp(-1.0)), 0.0], atol=1e-9)
    top_mm = strip(curled, 55.0, 0.3).top_mm().max()
    now_mm = curled.as_cooled(np.array([[55.0, 30.0, top_mm]]))[0, 2]
    # the nozzle kept its height; what was still warm has risen since
    warm_mm = lift_mm * (np.exp(-4.0 / 5.0) - np.exp(-5.0 / 5.0))
    assert now_mm == pytest.approx(4.0 + warm_mm, abs=0.01)
    assert strip(curled, 30.0).top_mm().max() == pytest.approx(4.0, abs=0.01)


def looked_at(
    world: World, model: ScannerModel, sensor: tuple[float, float, float] = (30.0, 30.0, 300.0)
) -> np.ndarray:
    device = SimulatedScanner(
        world,
        pose=ScannerPose(IDENTITY, IDENTITY),
        sensors_mm=np.array([sensor]),
        rng=np.random.default_rng(0),
        model=model,
    )
    return device.scan(REQUEST).points_mm


def test_a_length_that_is_known_shrinks_by_what_is_told() -> None:
    thermal = ThermalModel(shrink_ratio=0.01, held_mm=2.0)
    lengths = []
    for told in (ThermalModel(), thermal):
        world = World((60.0, 60.0), thermal=told)
        world.add(m3.Manifold.cube((20, 20, 9)).translate((20, 20, 0)))  # on the grid's own lines
        views = [
            looked_at(world, ScannerModel(sigma_mm=0.0), (30.0 + side * 200, 30.0, 200.0))
            for side in (-1, 1)
        ]
        faces = []
        for view, side in zip(views, (-1, 1), strict=True):
            face = (np.abs(view[:, 2] - 7.0) < 0.5) & (side * (view[:, 0] - 30) > 9)
            faces.append(view[face & (np.abs(view[:, 1] - 30) < 8), 0].mean())
        lengths.append(faces[1] - faces[0])
    expected = 1 - 0.01 * (1 - np.exp(-7.0 / 2.0))
    assert lengths[1] / lengths[0] == pytest.approx(expected, abs=2e-4)  # 4 µm in 20 mm


def test_a_repair_lands_where_the_scan_saw_the_hole() -> None:
    thermal = ThermalModel(shrink_ratio=0.02, held_mm=0.5)
    world = World((60.0, 60.0), thermal=thermal)
    world.add(m3.Manifold.cube((40, 10, 3)).translate((10, 25, 0)))
    world.remove(m3.Manifold.cube((3, 10, 0.2)).translate((45, 25, 2.8)))
    seen = world.as_cooled(np.array([[45.0, 30.0, 2.8], [48.0, 30.0, 2.8]]))[:, 0]
    assert seen[0] == pytest.approx(45 - 15 * 0.02, abs=0.01)
    nozzle = Nozzle()
    for line in range(7):  # as wide as the hole is seen
        x = seen[0] + (line + 0.5) * (seen[1] - seen[0]) / 7
        nozzle.go(x, 26, 3.0)
        nozzle.go(x, 34, 3.0, (seen[1] - seen[0]) / 7 * HEIGHT_MM)
    nozzle.go(0, 0, 9.0)
    world.deposit(nozzle.batch(), onto_cold=True)
    filled = world.snapshot(world.columns.box_window((44.0, 27.0), (49.0, 33.0)))
    level = filled.thickness_mm(2.8, 3.2).mean(axis=0)
    np.testing.assert_allclose(level, 0.2, atol=0.05)  # full from rim to rim, nothing over it


@pytest.mark.parametrize("name", ["structured-light", "laser-line"])
def test_noise_grows_with_the_slope_as_told(name: str) -> None:
    told = load_world().scanner(name)
    model = told.model_copy(update={"sigma_mm": 0.1, "dropout_ratio": 0.0, "outlier_ratio": 0.0})
    for slope_deg in (0.0, 45.0, 65.0):
        tan = np.tan(np.deg2rad(slope_deg))
        world = World((60.0, 60.0))
        half = m3.Manifold.cube((10, 12, 60)).translate((25, 24, 0))
        # below z = 20 + (x - 30) tan
        cos, sin = 1 / np.hypot(1, tan), tan / np.hypot(1, tan)
        world.add(half.trim_by_plane((sin, 0, -cos), -(20.0 - 30 * tan) * cos))
        points = looked_at(world, model)
        inside = (np.abs(points[:, :2] - 30) < [4.0, 5.0]).all(axis=1)
        off = points[inside, 2] - (20.0 + (points[inside, 0] - 30) * tan)
        # seen from straight above, up to 1.5° aside: noise along the ray is height over the slope
        expected = 0.1 / np.cos(np.deg2rad(slope_deg)) ** model.slope_power
        assert inside.sum() > 300
        assert off.std() == pytest.approx(expected, rel=0.12), slope_deg
        assert off.mean() == pytest.approx(0.0, abs=0.03), slope_deg


def test_the_camera_hides_what_it_does_not_see() -> None:
    world = World((60.0, 60.0))
    world.add(m3.Manifold.cube((20, 2, 10)).translate((20, 29, 0)))
    plain = ScannerModel(sigma_mm=0.0, spacing_mm=0.2)
    # the camera is at y = 130, z = 300; its rays over the wall's top come down at y = 25.5
    rim_mm = (29 - 130 * 10 / 300) / (1 - 10 / 300)
    for baseline_mm, is_seen in ((0.0, True), (100.0, False)):
        points = looked_at(world, plain.model_copy(update={"baseline_mm": baseline_mm}))
        bed = (points[:, 2] < 0.5) & (np.abs(points[:, 0] - 30) < 8)
        y = points[bed, 1]
        shadow = ((y > rim_mm + 0.2) & (y < 28.7)).sum()
        assert (shadow > 1000) if is_seen else (shadow == 0)
        assert ((y > rim_mm - 1.5) & (y < rim_mm - 0.2)).sum() > 400
        assert (y > 31.5).sum() > 400  # on the camera's own side nothing is hidden


def test_a_laser_line_is_denser_along_the_line_than_across_it() -> None:
    world = World((60.0, 60.0))
    world.add(m3.Manifold.cube((20, 20, 3)).translate((20, 20, 0)))
    model = ScannerModel(sigma_mm=0.0, spacing_mm=0.1, line_step_mm=0.4)
    points = looked_at(world, model)
    inside = (np.abs(points[:, :2] - 30) < 5).all(axis=1) & (points[:, 2] > 2.5)
    stretch = 300 / 297  # the grid is on the bed, and seen from 300 mm
    expected = 100.0 / (0.1 * 0.4) * stretch**2
    assert inside.sum() == pytest.approx(expected, rel=0.02)
