"""The planned template's own arithmetic, against plain references."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from amrepair.align import align
from amrepair.frames import Transform
from amrepair.loop import plan_stops
from amrepair.loop.sites import sites
from amrepair.repair import Site, plan_repair
from amrepair.repair.options import DEFAULT_REPAIR
from amrepair.repair.scan_scope import within_planned
from amrepair.scans import Scan
from amrepair.template import PlannedSdf
from amrepair.template import planned_kernels as kernels
from gcode.profiles import load_setup
from gcode.slicing.layers import LayerGrid
from tests.unit.loop_bench import LAYER, Small, scan_of


@pytest.fixture(params=range(3))
def solid(request: pytest.FixtureRequest) -> np.ndarray:
    """Boxes thrown together; the top is open."""
    rng = np.random.default_rng(request.param)
    shape = np.array([23, 31, 11])
    made = np.zeros(shape, bool)
    for _ in range(6):
        low = rng.integers(0, shape - 2)
        high = low + rng.integers(1, 9, 3)
        made[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
    made[:, :, -2:] = False
    return made


def test_distances_are_those_of_scipy(solid: np.ndarray) -> None:
    for sought in (True, False):
        found = np.sqrt(kernels.squared_distances(solid, sought))
        wanted = ndimage.distance_transform_edt(solid != sought)
        np.testing.assert_allclose(found, wanted, atol=1e-5)  # float32


def test_where_nothing_is_sought_for_everything_is_far() -> None:
    found = kernels.squared_distances(np.zeros((4, 5, 3), bool), True)
    assert (found >= kernels.FAR2).all()


@pytest.mark.parametrize("every", [1, 7])
def test_open_faces_are_those_of_shifted_copies(solid: np.ndarray, every: int) -> None:
    padded = np.pad(solid, 1)
    padded[:, :, 0] = padded[:, :, 1]  # the lowest slice goes on downwards
    wanted, found, count = [], [], 0
    room = np.empty((solid.size, 3))
    for axis in range(3):
        for side in (-1, 1):
            beside = np.roll(padded, -side, axis=axis)[1:-1, 1:-1, 1:-1]
            normal = 0.5 * side * np.eye(3)[axis]
            wanted.append(np.argwhere(solid & ~beside) + 0.5 + normal)
            faces, kept = kernels.open_faces(solid, axis, side, every, count, room)
            found.append(room[:kept].copy())
            count += faces
    np.testing.assert_array_equal(np.concatenate(found), np.concatenate(wanted)[::every])


def beads_of_a_block(layers: int) -> PlannedSdf:
    """Lines along X side by side, 10 × 6 mm, 0.2 mm a layer."""
    y, z = np.meshgrid(np.arange(0.2, 6.0, 0.4), 0.2 * np.arange(1, layers + 1))
    start = np.column_stack([np.zeros(y.size), y.ravel(), z.ravel()])
    count = len(start)
    end = start + np.array([10.0, 0.0, 0.0])
    return PlannedSdf.from_beads(start, end, np.full(count, 0.08), np.full(count, 0.2))


@pytest.mark.parametrize("layers", [5, 40])
def test_nothing_is_planned_below_the_lowest_beads(layers: int) -> None:
    """Regression: the lowest slice went on into the bed, and was called missing there."""
    planned = beads_of_a_block(layers)
    foot_mm = float(planned.bounds_mm[0, 2])
    assert foot_mm == pytest.approx(max(0.0, 0.2 * layers - 4.2), abs=0.21)
    below_mm = np.array([0.3, 1.0, 5.0, 30.0])
    middle = np.tile([5.0, 3.0, 0.0], (4, 1)) + np.outer(foot_mm - below_mm, [0, 0, 1])
    assert planned.distance(middle) == pytest.approx(below_mm, abs=0.1)
    middle[:, 2] = foot_mm + 0.4
    assert planned.distance(middle) == pytest.approx(-0.4, abs=0.1)


@pytest.mark.parametrize("depth_mm", [0.0, 0.55])
def test_a_scan_all_around_finds_the_pocket_and_nothing_below_the_bed(depth_mm: float) -> None:
    """Regression: 5,906 mm³ of an intact block of 192 mm³ were missing, 31 mm into the bed."""
    small = Small.made()
    stop = plan_stops(small.job, [LAYER])[0]
    site = sites(small.job, small.template, small.placed, small.setup, by_beads=True)(stop)
    pocket = small.block(-depth_mm, 1.0, 5.0)
    scan = scan_of(small.standing - pocket if depth_mm else small.standing)
    guess = small.placed.inverse() @ small.pose
    plan = plan_repair(scan, site, title="pocket", guess=guess, strict=False)
    assert plan.deficit.missing_mm3 == pytest.approx(25.0 * depth_mm, rel=0.05, abs=0.1)


def test_a_thick_bead_higher_up_does_not_lower_the_foot() -> None:
    # regression: OrcaSlicer's beads of two layers' height put the foot a layer into the bed, and
    # the alignment, which lays the foot on the bed, the part with it
    x = np.arange(0.0, 4.0, 0.4)
    low = np.column_stack([x, np.zeros(len(x)), np.full(len(x), 0.2)])
    start = np.concatenate([low, low + np.array([0.0, 0.0, 0.2]), [[1.0, 1.0, 0.8]]])
    end = start + np.array([0.0, 4.0, 0.0])
    height = np.array([0.2] * (len(start) - 1) + [0.4])
    planned = PlannedSdf.from_beads(start, end, 0.4 * height, height)
    assert planned.bounds_mm[0, 2] == pytest.approx(0.0, abs=1e-9)
    assert planned.bounds_mm[1, 2] == pytest.approx(0.8)


@pytest.mark.parametrize(("first_mm", "layer_mm"), [(0.3, 0.3), (0.35, 0.2), (0.2, 0.28)])
def test_layers_that_are_no_whole_voxels_do_not_lower_the_foot(
    first_mm: float, layer_mm: float
) -> None:
    # regression: a sign and a screw in layers of 0.3 mm, voxels of 0.25, had their foot up to
    # 0.2 mm in the bed, the alignment laid them so deep, and their last layer was all missing
    height = np.array([first_mm] + [layer_mm] * 5)
    top = np.cumsum(height)
    start = np.column_stack([np.zeros(6), np.zeros(6), top])
    end = start + np.array([10.0, 0.0, 0.0])
    planned = PlannedSdf.from_beads(start, end, 0.45 * height, height)
    assert planned.bounds_mm[0, 2] == pytest.approx(0.0, abs=1e-9)
    assert planned.bounds_mm[1, 2] == pytest.approx(top[-1])


def test_a_flange_below_a_cut_template_is_not_the_bed() -> None:
    # regression: the foot of the last millimetres of beads lies in mid-air; a plate within a
    # millimetre of that height was laid on it, and a clean screw 0.6 mm too high
    layers, flange_mm = 30, 1.2
    planned = beads_of_a_block(layers)
    assert planned.off_bed
    assert not beads_of_a_block(5).off_bed
    assert abs(planned.bounds_mm[0, 2] - flange_mm) > 0.3
    rng = np.random.default_rng(0)
    top_mm = 0.2 * layers
    low, high = planned.bounds_mm[0, :2], planned.bounds_mm[1, :2]
    xy = np.stack(np.meshgrid(np.arange(-15.0, 25.0, 0.25), np.arange(-15.0, 21.0, 0.25)), -1)
    xy = xy.reshape(-1, 2)
    on_block = ((xy > low) & (xy < high)).all(axis=1)
    z_mm = np.where(on_block, top_mm, flange_mm)
    faces = [np.column_stack([xy, z_mm])]
    up = np.arange(flange_mm, top_mm, 0.25)
    for axis in (0, 1):
        along = np.arange(low[1 - axis], high[1 - axis], 0.25)
        side = np.zeros((len(along) * len(up), 3))
        side[:, 1 - axis], side[:, 2] = np.repeat(along, len(up)), np.tile(up, len(along))
        for at in (low[axis], high[axis]):
            side[:, axis] = at
            faces.append(side.copy())
    points = np.concatenate(faces)
    scan = Scan(points + rng.normal(0, 0.02, points.shape), 0.02, "build")
    found = align(scan, planned, guess=Transform.identity("template", "build"), rng=rng)
    assert found.template_from_scan.translation_mm[2] == pytest.approx(0.0, abs=0.05)


def test_points_below_a_cut_template_are_not_judged_whatever_stands_beside_it() -> None:
    # regression: where the planned beads are all that is known of the part, a slope below their
    # cut was judged, and a clean part stopped for a shifted layer
    planned, setup = beads_of_a_block(30), load_setup()
    site = Site(planned, setup, LayerGrid.from_setup(setup), planned=planned)
    low_mm = float(planned.bounds_mm[0, 2])
    z_mm = np.arange(0.1, 6.0, 0.1)
    scan = Scan(np.column_stack([np.zeros_like(z_mm), np.zeros_like(z_mm), z_mm]), 0.02, "template")
    seen_mm = within_planned(scan, site).points_mm[:, 2]
    assert seen_mm.min() == pytest.approx(low_mm + DEFAULT_REPAIR.planned_edge_mm, abs=0.11)
    whole = beads_of_a_block(5)
    assert within_planned(scan, Site(whole, setup, site.grid, planned=whole)) is scan
