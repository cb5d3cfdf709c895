"""The world against what a nozzle's plastic must fill: volume, height, walls, bridges."""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest

from amrepair.errors import InputError
from amrepair.simulate.deposit_kernels import CARRY
from amrepair.simulate.world import World
from gcode.firmware.motion import MotionBatch
from tests.worlds import missing_versus

FILAMENT_MM2 = np.pi / 4 * 1.75**2
HEIGHT_MM = 0.2
SPACING_MM = 0.45 - HEIGHT_MM * (1 - np.pi / 4)
SECTION_MM2 = SPACING_MM * HEIGHT_MM


class Nozzle:
    """Writes motion by hand."""

    def __init__(self) -> None:
        self.at = np.array([0.0, 0.0, 5.0])
        self.rows: list[tuple[np.ndarray, np.ndarray, float]] = []

    def go(self, x: float, y: float, z: float, section_mm2: float = 0.0) -> None:
        target = np.array([x, y, z], dtype=np.float64)
        length = float(np.linalg.norm(target - self.at))
        self.rows.append((self.at, target, section_mm2 * length / FILAMENT_MM2))
        self.at = target

    def push(self, filament_mm: float) -> None:
        self.rows.append((self.at, self.at, filament_mm))

    def batch(self) -> MotionBatch:
        start, end, filament = zip(*self.rows, strict=True)
        n = len(filament)
        self.rows = []
        return MotionBatch(
            np.array(start), np.array(end), np.array(filament), np.full(n, 50.0), np.arange(n) * 1.0
        )


def block(corner: tuple[float, float], lines: int, layers: int, flow: float = 1.0) -> MotionBatch:
    """A solid block: one perimeter and crossing lines, a whole number of spacings wide."""
    nozzle, size = Nozzle(), lines * SPACING_MM
    (x0, y0), section, half = corner, SECTION_MM2 * flow, SPACING_MM / 2
    z = 0.0
    for layer in range(layers):
        z = HEIGHT_MM * (layer + 1)
        low, high = half, size - half
        ring = [(low, low), (high, low), (high, high), (low, high), (low, low)]
        nozzle.go(x0 + low, y0 + low, z)
        for x, y in ring[1:]:
            nozzle.go(x0 + x, y0 + y, z, section)
        for line in range(1, lines - 1):
            across, ends = (line + 0.5) * SPACING_MM, [SPACING_MM, size - SPACING_MM]
            if line % 2:
                ends.reverse()
            points = [(end, across) if layer % 2 == 0 else (across, end) for end in ends]
            nozzle.go(x0 + points[0][0], y0 + points[0][1], z)
            nozzle.go(x0 + points[1][0], y0 + points[1][1], z, section)
    nozzle.go(0.0, 0.0, z + 5.0)  # what rides along with the nozzle is laid when it leaves
    return nozzle.batch()


def commanded_mm3(motion: MotionBatch) -> float:
    return float(motion.filament_mm.sum()) * FILAMENT_MM2


@pytest.mark.parametrize("cell_mm", [0.1, 0.125, 0.15])
def test_block_has_the_volume_height_and_walls_that_were_commanded(cell_mm: float) -> None:
    world = World((60.0, 60.0), cell_mm=cell_mm)
    lines, layers = 30, 12
    motion = block((20.03, 20.01), lines, layers)
    world.deposit(motion)
    solid = world.snapshot()
    assert solid.volume_mm3 == pytest.approx(commanded_mm3(motion), rel=1e-9)
    assert solid.top_mm().max() == pytest.approx(layers * HEIGHT_MM, abs=0.06)  # one ridge step
    # mean position of the four walls, from the solid share of rows well inside the block
    share = solid.thickness_mm(0.6, 2.0) / 1.4
    middle_y, middle_x = share.shape[0] // 2, share.shape[1] // 2
    wide = (share[middle_y - 30 : middle_y + 30].sum(axis=1) * cell_mm).mean()
    deep = (share[:, middle_x - 30 : middle_x + 30].sum(axis=0) * cell_mm).mean()
    # two walls each; a wall may be off by 0.02 mm on average
    assert wide == pytest.approx(lines * SPACING_MM, abs=0.04)
    assert deep == pytest.approx(lines * SPACING_MM, abs=0.04)


@pytest.mark.parametrize("x_mm", [20.0, 20.03, 20.0625, 20.1])
def test_lone_bead_lies_centred_on_its_path_wherever_the_grid_is(x_mm: float) -> None:
    world, nozzle = World((60.0, 60.0)), Nozzle()
    nozzle.go(x_mm, 10, HEIGHT_MM)
    nozzle.go(x_mm, 40, HEIGHT_MM, SECTION_MM2)
    world.deposit(nozzle.batch())
    solid = world.snapshot(world.columns.box_window((15.0, 15.0), (25.0, 35.0)))
    share = solid.thickness_mm().sum(axis=0) / solid.thickness_mm().sum()
    centre = solid.window.corner_mm[0] + (np.arange(len(share)) + 0.5) * world.cell_mm
    assert float(share @ centre) == pytest.approx(x_mm, abs=0.01)
    assert solid.volume_mm3 == pytest.approx(20 * SECTION_MM2, rel=0.01)


def test_an_empty_world_has_columns_of_no_length() -> None:
    world = World((40.0, 30.0))
    window = world.columns.box_window((10.0, 10.0), (12.0, 11.0))
    thick = world.snapshot(window).thickness_mm()
    assert thick.shape == window.shape
    assert thick.dtype == np.float64
    assert not thick.any()


def test_under_extruded_bead_is_lower_and_hardly_narrower() -> None:
    heights, widths, sections = [], [], []
    for flow in (0.9, 0.5):
        world, nozzle = World((60.0, 60.0)), Nozzle()
        nozzle.go(10, 20.03, HEIGHT_MM)
        nozzle.go(40, 20.03, HEIGHT_MM, SECTION_MM2 * flow)
        world.deposit(nozzle.batch())
        thick = world.snapshot(world.columns.box_window((15.0, 15.0), (35.0, 25.0))).thickness_mm()
        heights.append(thick.mean(axis=1).max())
        sections.append(thick.mean(axis=1).sum() * world.cell_mm)
        widths.append((thick > 0.02).sum(axis=0).mean() * world.cell_mm)
    assert sections == pytest.approx([0.9 * SECTION_MM2, 0.5 * SECTION_MM2], rel=0.02)
    # its edges are thin: what is lacking, they lack first, by less than a column on each side
    assert heights[0] == pytest.approx(HEIGHT_MM, abs=0.01)
    assert heights[1] == pytest.approx(heights[0] * 0.5 / 0.9, abs=0.03)
    assert widths[1] > widths[0] - 2 * 0.125


@pytest.mark.parametrize("lean_mm", [0.0, 0.03, 0.1])
@pytest.mark.parametrize("lines", [1, 2, 4])
def test_free_standing_wall_stands_at_the_nozzles_height(lines: int, lean_mm: float) -> None:
    # a slicer's wall of n lines carries plastic for n spacings, not for its outer width: its edges
    # are round. Square ones let walls sink, by 0.2 mm (two lines) within a dozen layers.
    layers = 24
    spacing = 0.42 - HEIGHT_MM * (1 - np.pi / 4)
    for x0 in (20.03, 20.09):
        world, nozzle, sunk = World((60.0, 60.0)), Nozzle(), []
        for layer in range(layers):
            z, left = HEIGHT_MM * (layer + 1), x0 + lean_mm * layer
            for line in range(lines):
                x = left + spacing * line
                nozzle.go(x, 18.0, z + 0.6)
                nozzle.go(x, 18.0, z)
                nozzle.go(x, 34.0, z, 0.99 * spacing * HEIGHT_MM)
                nozzle.go(x, 34.0, z + 0.6)
            world.deposit(nozzle.batch())
            right = left + spacing * (lines - 1)
            top = world.snapshot(world.columns.box_window((left, 22.0), (right + 1e-6, 30.0)))
            sunk.append(z - top.top_mm().mean())
        assert max(sunk) < 0.03 + 0.07 / lines
        assert np.mean(sunk) < 0.01 + 0.04 / lines


def test_over_extrusion_is_conserved_and_rises_only_where_it_finds_no_room() -> None:
    world = World((60.0, 60.0))
    motion = block((20.0, 20.0), 20, 6, flow=1.2)
    world.deposit(motion)
    solid = world.snapshot()
    assert solid.volume_mm3 == pytest.approx(commanded_mm3(motion), rel=1e-9)
    assert solid.top_mm().max() > 6 * HEIGHT_MM


def test_a_repair_between_two_layers_makes_no_layer_of_its_own() -> None:
    laid = []
    for heights in ((2.0,), (1.92, 2.0)):
        world, nozzle = World((60.0, 60.0)), Nozzle()
        world.deposit(block((20.0, 20.0), 8, 9))  # the tenth layer is lacking
        nozzle.at = np.array([0.0, 0.0, 5.0])
        for z in heights:  # one bead beside another, far apart
            y = 20.25 if z == 2.0 else 22.5
            nozzle.go(20.5, y, z)
            nozzle.go(23.0, y, z, 1.2 * SECTION_MM2)
            nozzle.go(23.0, y, z + 3.0)
        world.deposit(nozzle.batch(), onto_cold=True)
        window = world.columns.box_window((21.0, 19.0), (22.5, 21.0))
        laid.append(world.snapshot(window).thickness_mm())
    # as wide as what it fills says, whatever lies at other heights beside it
    assert np.abs(laid[1] - laid[0]).max() < 1e-9


def test_bridge_hangs_at_its_own_thickness() -> None:
    world, nozzle = World((60.0, 60.0)), Nozzle()
    world.add(m3.Manifold.cube((5, 5, 4.0)).translate((10, 20, 0)))
    world.add(m3.Manifold.cube((5, 5, 4.0)).translate((25, 20, 0)))
    nozzle.go(12, 22.5, 4.2)
    nozzle.go(28, 22.5, 4.2, SECTION_MM2)
    world.deposit(nozzle.batch())
    span = world.snapshot(world.columns.box_window((17.0, 20.0), (23.0, 25.0)))
    bounds = span.bounds_mm()
    assert bounds is not None
    assert bounds[0, 2] > 3.0  # nothing fell to the bed
    assert span.volume_mm3 == pytest.approx(6 * SECTION_MM2, rel=0.03)


def test_retracted_filament_must_come_back_before_plastic_does() -> None:
    world, nozzle = World((60.0, 60.0)), Nozzle()
    nozzle.go(20, 20, 0.2)
    nozzle.push(-0.8)
    world.deposit(nozzle.batch())
    nozzle.push(0.8)
    assert world.deposit(nozzle.batch()) == 0.0
    nozzle.push(1.0)
    assert world.deposit(nozzle.batch()) == pytest.approx(FILAMENT_MM2)
    nozzle.go(30, 30, 0.2)
    world.deposit(nozzle.batch())
    assert world.volume_mm3 == pytest.approx(FILAMENT_MM2)


def test_how_motion_is_cut_into_batches_changes_nothing() -> None:
    motion = block((20.0, 20.0), 12, 4)
    whole, pieces = World((60.0, 60.0)), World((60.0, 60.0))
    whole.deposit(motion)
    for part in np.array_split(np.arange(len(motion)), 17):
        rows = slice(part[0], part[-1] + 1)
        pieces.deposit(
            MotionBatch(
                motion.start_mm[rows],
                motion.end_mm[rows],
                motion.filament_mm[rows],
                motion.speed_mm_s[rows],
                motion.time_s[rows],
            )
        )
    difference = missing_versus(pieces, whole)
    assert difference.missing_mm3 == 0.0
    assert difference.excess_mm3 == 0.0


def test_truth_counts_only_what_was_missing_as_filled() -> None:
    whole, broken = World((60.0, 60.0)), World((60.0, 60.0))
    cube = m3.Manifold.cube((10, 10, 5)).translate((20, 20, 0))
    for world in (whole, broken):
        world.add(cube)
    piece = m3.Manifold.cube((4, 4, 2)).translate((23, 23, 3))
    removed = broken.remove(piece)
    assert removed == pytest.approx(32.0, rel=1e-9)  # on the grid's own lines: exact
    before = missing_versus(broken, whole)
    assert before.missing_mm3 == pytest.approx(32.0, rel=1e-9)
    assert before.excess_mm3 == 0.0
    broken.add(m3.Manifold.cube((4, 4, 3)).translate((23, 23, 4)))  # half fills, half is too much
    assert before.filled_mm3(broken) == pytest.approx(16.0, rel=1e-9)
    after = missing_versus(broken, whole)
    assert after.missing_mm3 == pytest.approx(16.0, rel=1e-9)
    assert after.excess_mm3 == pytest.approx(32.0, rel=1e-9)
    assert after.within(np.array([[0, 0, 0], [60, 60, 5.5]])).excess_mm3 == pytest.approx(8.0)


def test_columns_wider_than_the_limit_are_refused() -> None:
    with pytest.raises(InputError, match=r"0\.15"):
        World((60.0, 60.0), cell_mm=0.2)


def test_what_rounding_leaves_at_the_nozzle_does_not_hang_in_the_air_after_a_travel() -> None:
    """Eight columns, a film of nothing 5 mm up, kept the head off a whole object for good."""
    world = World((40.0, 40.0))
    world.deposit(block((5.0, 5.0), 12, 2))
    world._state[CARRY] = 1e-12
    nozzle = Nozzle()
    for place in ((6.5, 6.2, 0.4), (30.0, 30.0, 8.0), (30.0, 30.0, 0.2)):
        nozzle.go(*place)
    world.deposit(nozzle.batch())
    assert world.top().top_mm < 1.0
