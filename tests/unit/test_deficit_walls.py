"""Walls of the as-built field beside what is missing: as sharp as the points of the wall say."""

from __future__ import annotations

import manifold3d
import numpy as np
import pytest
import trimesh
from scipy import ndimage

from amrepair.deficit.heights import as_built_heights, columns_of, with_what_stands_out
from amrepair.deficit.options import HeightOptions, WallOptions
from amrepair.deficit.walls import (
    even_crests,
    rising_rims,
    whole_rims,
    with_rims,
    with_sharp_walls,
)
from amrepair.frames import Transform
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from gcode.meshes import mesh_of
from gcode.surfaces import HeightField

Solid = manifold3d.Manifold
CELL_MM, SIGMA_MM, SPACING_MM = 0.1, 0.04, 0.2
# A column whose middle is so near to a wall may go either way: three standard deviations of the
# mean of some twenty points.
UNDECIDED_MM = 0.03
OPTIONS = WallOptions()


def scanned(solid: manifold3d.Manifold, seed: int) -> np.ndarray:
    """Points of a solid's surface with noise."""
    vertices, faces = mesh_of(solid)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, int(mesh.area / SPACING_MM**2), seed=seed)
    noise = np.random.default_rng(seed).normal(scale=SIGMA_MM, size=points.shape)
    return np.asarray(points) + noise


def gone_from(field: HeightField, piece: manifold3d.Manifold) -> np.ndarray:
    """Columns of a field that a piece lies over."""
    offset = columns_of(piece, field)[0]
    return np.asarray((offset[1:] != offset[:-1]).reshape(field.shape))


def wavering(field: HeightField, seed: int) -> HeightField:
    """Every third column beside a step as high, or as low, as its neighbours."""
    rng = np.random.default_rng(seed)
    z_mm = np.array(field.z_mm, dtype=np.float64)
    high, low = ndimage.maximum_filter(z_mm, 3), ndimage.minimum_filter(z_mm, 3)
    wrong = (high - low > 1.0) & (rng.random(z_mm.shape) < 1 / 3)
    wrong_mm = np.where(z_mm > 0.5 * (high + low), low, high)
    return HeightField(field.origin_mm, field.cell_mm, np.where(wrong, wrong_mm, z_mm), field.seen)


def broken(shape: str, turned: float) -> tuple[manifold3d.Manifold, manifold3d.Manifold]:
    """What is left of a block, and the piece that is gone, at no round place of the grid."""
    block = Solid.cube((24.0, 20.0, 6.0))
    tool = {
        "notch": Solid.cube((9.0, 30.0, 4.0), True).rotate((0.0, 0.0, turned)),
        "pit": Solid.cube((8.0, 9.0, 4.0), True).rotate((0.0, 0.0, turned)),
        "bore": Solid.cylinder(4.0, 4.3, 4.3, 96, True),
    }[shape].translate((12.037, 10.071, 6.0))
    return block - tool, block ^ tool


@pytest.mark.parametrize(
    ("shape", "turned"), [("notch", 0.0), ("notch", 17.0), ("pit", 31.0), ("bore", 0.0)]
)
def test_columns_beside_walls_are_told_by_the_walls_own_points(shape: str, turned: float) -> None:
    rest, piece = broken(shape, turned)
    truth = HeightField.from_manifold(rest, CELL_MM, margin_mm=1.0)
    rough = wavering(truth, 0)
    sharp = with_sharp_walls(rough, gone_from(rough, piece), scanned(rest, 1), SIGMA_MM)
    x, y = truth.centres_mm()
    inside = (np.abs(x - 12.0) < 11.0)[None, :] & (np.abs(y - 10.0) < 9.0)[:, None]
    off_before = inside & (np.abs(rough.z_mm - truth.z_mm) > 0.5)
    off_after = inside & (np.abs(sharp.z_mm - truth.z_mm) > 0.5)
    assert off_before.sum() > 100
    # corners of a pit, where two walls lie within reach, are left as they are
    assert off_after.sum() < 0.2 * off_before.sum()
    made_wrong = off_after & ~off_before
    # the wall's place to a fiftieth of a millimetre
    fine = HeightField.from_manifold(piece, CELL_MM / 5, box_mm=truth.box_mm).z_mm > 1.0
    to_wall_mm = _distance_to_edge(fine, CELL_MM / 5)
    for row, column in np.argwhere(made_wrong):
        assert to_wall_mm[5 * row + 2, 5 * column + 2] < UNDECIDED_MM + CELL_MM / 5
    assert made_wrong.sum() <= 0.05 * off_before.sum()


def _distance_to_edge(inside: np.ndarray, cell_mm: float) -> np.ndarray:
    """Of every cell to where a region begins or ends."""
    within = ndimage.distance_transform_edt(inside)
    without = ndimage.distance_transform_edt(~inside)
    return np.asarray(np.maximum(within, without) * cell_mm)


def test_a_wall_thinner_than_its_points_reach_is_told_by_its_broken_face() -> None:
    """Between a pit and the outside: points of both faces lie on no plane, and it read too wide."""
    block = Solid.cube((24.0, 20.0, 6.0))
    pit = Solid.cube((9.0, 8.0, 4.0)).translate((7.037, 11.74, 3.0))
    rest, piece = block - pit, block ^ pit
    truth = HeightField.from_manifold(rest, CELL_MM, margin_mm=1.0)
    x, y = truth.centres_mm()
    thin_mm = 20.0 - 19.74
    along = (np.abs(x - 11.5) < 3.5)[None, :]
    wide = along & ((y > 19.74 - 0.35) & (y < 20.0))[:, None]
    rough = truth.raised(np.where(wide, 6.0, 0.0))
    points = scanned(rest, 3)
    # of a block the nearest face tells how far inside a point lies, by each axis
    deviation_mm = np.maximum(-points, points - (24.0, 20.0, 6.0)).max(axis=1)
    sharp = with_sharp_walls(
        rough, gone_from(truth, piece), points, SIGMA_MM, deviation_mm=deviation_mm
    )
    surely = along & (np.abs(y - 19.74) > UNDECIDED_MM)[:, None]
    asked = surely & ((y > 19.0) & (y < 21.0))[:, None]
    assert thin_mm < OPTIONS.radius_mm
    assert (asked & (rough.z_mm - truth.z_mm > 0.5)).sum() > 100
    assert not (asked & (np.abs(sharp.z_mm - truth.z_mm) > 0.5)).any()


def test_slopes_and_what_is_not_broken_stay_as_they_are() -> None:
    block = Solid.cube((24.0, 20.0, 6.0))
    wedge = Solid.cube((10.0, 8.0, 6.0), True).rotate((0.0, 40.0, 0.0)).translate((12.0, 10.0, 7.0))
    rest = block - wedge
    truth = HeightField.from_manifold(rest, CELL_MM, margin_mm=1.0)
    gone = gone_from(truth, block ^ wedge)
    sharp = with_sharp_walls(truth, gone, scanned(rest, 2), SIGMA_MM)
    changed = np.abs(sharp.z_mm - truth.z_mm) > 0.2
    # the two steep ends of the groove may differ by a column whose middle is on the wall
    assert changed.sum() < 20
    outside = HeightField.from_manifold(block, CELL_MM, margin_mm=1.0)
    nothing = np.zeros(outside.shape, dtype=bool)
    assert with_sharp_walls(outside, nothing, scanned(rest, 2), SIGMA_MM) is outside


def test_a_crest_between_two_columns_that_were_seen_is_as_high_as_they() -> None:
    """A horn read 0.8 mm low in the middle: the flat went 0.4 mm into it."""
    block = Solid.cube((24.0, 20.0, 6.0))
    tools = [
        Solid.cube((30.0, 9.9, 4.0), True).translate((12.0, y, 6.0)) for y in (4.9, 15.05)
    ]  # a fin of 0.25 mm is left between them
    piece = block ^ (tools[0] + tools[1])
    truth = HeightField.from_manifold(block - piece, CELL_MM, margin_mm=1.0)
    z_mm = np.array(truth.z_mm, dtype=np.float64)
    fin = z_mm > 5.0
    assert 0 < fin.sum() < 3 * z_mm.shape[1]
    low = fin & (np.random.default_rng(3).random(z_mm.shape) < 0.3)
    z_mm[low] -= 0.8
    designed = HeightField.from_manifold(block, CELL_MM, margin_mm=1.0)
    lost_mm = np.where(gone_from(truth, piece), 2.0, 0.0)
    even_mm = even_crests(z_mm, lost_mm, designed.z_mm, OPTIONS)
    assert (even_mm[fin] > 5.9).mean() > 0.99
    assert (even_mm[~fin] == z_mm[~fin]).all()
    # of a whole field, of which the window beside what is missing is looked at
    rough = HeightField(truth.origin_mm, CELL_MM, z_mm, truth.seen)
    field = with_rims(rough, lost_mm, designed.z_mm, SPACING_MM)
    assert (field.z_mm[fin] > 5.9).mean() > 0.99
    assert with_rims(rough, 0.0 * lost_mm, designed.z_mm, SPACING_MM) is rough


def test_a_splinter_a_little_lower_than_designed_is_as_designed() -> None:
    """Of 0.1 to 0.3 mm beside a pit, read 0.1 to 0.5 mm low: the flat went 0.2 mm into it."""
    block = Solid.cube((24.0, 15.25, 6.0))
    piece = Solid.cube((9.0, 9.0, 3.0)).translate((7.5, 6.0, 3.0))
    truth = HeightField.from_manifold(block - piece, CELL_MM, margin_mm=1.0)
    designed = HeightField.from_manifold(block, CELL_MM, margin_mm=1.0)
    lost_mm = np.where(gone_from(truth, piece), 3.0, 0.0)
    x, y = truth.centres_mm()
    crest = ((y > 15.0) & (y < 15.25))[:, None] & ((x > 8.0) & (x < 16.0))[None, :]
    z_mm = np.array(truth.z_mm, dtype=np.float64)
    z_mm[crest] -= np.random.default_rng(4).uniform(0.1, 0.45, int(crest.sum()))
    even_mm = even_crests(z_mm, lost_mm, designed.z_mm, OPTIONS)
    assert crest.sum() > 100
    assert np.abs(even_mm[crest] - 6.0).max() < 1e-6
    # beside a line that was skipped nothing was cut: an idler's was filled to 0.83 instead of 0.92
    skipped_mm = even_crests(z_mm, np.minimum(lost_mm, 0.4), designed.z_mm, OPTIONS)
    assert skipped_mm[crest & (x > 8.5) & (x < 15.5)].max() < 5.95
    z_mm[crest] -= 1.0  # that is no rounding: it broke off lower
    broken_off_mm = even_crests(z_mm, lost_mm, designed.z_mm, OPTIONS)
    assert broken_off_mm[crest & (x > 8.5) & (x < 15.5)].max() < 5.0


@pytest.mark.parametrize("rises_deg", [20.0, 40.0])
def test_a_worn_edge_rises_up_to_the_wall_behind_it(rises_deg: float) -> None:
    """Its last columns read as high as what lies three columns in: 0.2 mm low, and were hit."""
    block = Solid.cube((24.0, 20.0, 6.0))
    rise = np.tan(np.radians(rises_deg))
    tool = Solid.cube((60.0, 60.0, 20.0), True).translate((0.0, 0.0, 10.0))
    tool = tool.rotate((0.0, -rises_deg, 0.0)).translate((24.0, 10.0, 4.6))
    tool = tool ^ Solid.cube((20.0, 40.0, 20.0)).translate((20.0, -10.0, -5.0))
    truth = HeightField.from_manifold(block - tool, CELL_MM, margin_mm=1.0)
    designed = HeightField.from_manifold(block, CELL_MM, margin_mm=1.0)
    z_mm = np.array(truth.z_mm, dtype=np.float64)
    z_mm += np.random.default_rng(7).normal(scale=0.01, size=z_mm.shape) * (z_mm > 0.5)
    x, y = truth.centres_mm()
    inside = ((y > 1.5) & (y < 18.5))[:, None] & (x < 24.0)[None, :]
    last = inside & (x > 23.7)[None, :]
    z_mm[last] -= np.broadcast_to((x - 23.65) * rise, z_mm.shape)[last]
    lost_mm = np.maximum(designed.z_mm - truth.z_mm, 0.0)
    risen_mm = rising_rims(z_mm, lost_mm, designed.z_mm, 4, 12, OPTIONS)
    assert np.abs(risen_mm - truth.z_mm)[last].max() < 0.05
    assert (risen_mm[~last] == z_mm[~last]).mean() > 0.95
    assert (risen_mm >= z_mm).all()
    # nothing stands higher than designed
    low_mm = np.minimum(designed.z_mm - 0.02, truth.z_mm)
    held_mm = rising_rims(z_mm, lost_mm, low_mm, 4, 12, OPTIONS)
    assert (held_mm <= np.maximum(low_mm, z_mm)).all()


def test_what_rounds_off_the_foot_of_a_thick_wall_is_no_crest() -> None:
    rest, piece = broken("notch", 0.0)
    truth = HeightField.from_manifold(rest, CELL_MM, margin_mm=1.0)
    z_mm = np.array(truth.z_mm, dtype=np.float64)
    beside = (ndimage.maximum_filter(z_mm, 3) > 5.9) & (np.abs(z_mm - 4.0) < 0.1)
    z_mm[beside] += 0.9
    lost_mm = np.where(gone_from(truth, piece), 2.0, 0.0)
    assert beside.sum() > 300
    assert (even_crests(z_mm, lost_mm, np.full(z_mm.shape, 6.0), OPTIONS) == z_mm).all()


@pytest.mark.parametrize("turned", [0.0, 17.0])
def test_a_sloping_top_ends_at_a_steep_face_and_not_before(turned: float) -> None:
    """Its last column read 0.1 to 0.35 mm low, and the body went 0.22 mm into it."""
    wedge = Solid.hull_points(
        [(x, y, z) for x, high in ((0.0, 7.0), (24.0, 5.0)) for y in (0.0, 20.0) for z in (0, high)]
    )
    tool = Solid.cube((9.0, 30.0, 4.0), True).rotate((0.0, 0.0, turned))
    tool = tool.translate((12.037, 10.071, 6.0))
    truth = HeightField.from_manifold(wedge - tool, CELL_MM, margin_mm=1.0)
    designed = HeightField.from_manifold(wedge, CELL_MM, margin_mm=1.0)
    gone = gone_from(truth, wedge ^ tool)
    lip = ~gone & ndimage.maximum_filter(gone, 3) & (truth.z_mm > 1.0)
    assert lip.sum() > 300
    z_mm = np.array(truth.z_mm, dtype=np.float64)
    z_mm[lip] -= np.random.default_rng(5).uniform(0.1, 0.35, int(lip.sum()))
    # the piece, rounded off as well, has the lip's columns, too
    lost_mm = np.where(gone | lip, np.maximum(designed.z_mm - truth.z_mm, 1.0), 0.0)
    whole_mm = whole_rims(z_mm, lost_mm, designed.z_mm, OPTIONS)
    assert np.abs(whole_mm - truth.z_mm).max() < 1e-6


def test_a_worn_edge_is_no_lip() -> None:
    block = Solid.cube((24.0, 20.0, 6.0))
    tool = Solid.cube((30.0, 40.0, 20.0), True).translate((0.0, 0.0, 10.0))
    tool = tool.rotate((0.0, 35.0, 0.0)).translate((21.037, 10.0, 5.0))
    truth = HeightField.from_manifold(block - tool, CELL_MM, margin_mm=1.0)
    designed = HeightField.from_manifold(block, CELL_MM, margin_mm=1.0)
    worn_mm = truth.z_mm + np.random.default_rng(6).normal(scale=0.05, size=truth.shape)
    gone = gone_from(truth, block ^ tool)
    assert gone.sum() > 5000
    lost_mm = np.where(gone, designed.z_mm - truth.z_mm, 0.0)
    assert (whole_rims(worn_mm, lost_mm, designed.z_mm, OPTIONS) == worn_mm).all()


def test_beside_a_skipped_line_nothing_stands_as_if_cut() -> None:
    """At the outline its columns lie as low as the bed: what was low beside it was raised."""
    block = Solid.cube((24.0, 20.0, 6.0))
    line = Solid.cube((12.0, 0.5, 0.4)).translate((6.0, 0.0, 5.6))
    designed = HeightField.from_manifold(block, CELL_MM, margin_mm=1.0)
    z_mm = np.array(HeightField.from_manifold(block - line, CELL_MM, margin_mm=1.0).z_mm)
    lost_mm = np.where(gone_from(designed, line), 0.4, 0.0)
    z_mm[lost_mm > 0] = 0.0  # as a wall that stands a column farther in reads
    z_mm[ndimage.maximum_filter(lost_mm, 5) > 0] -= 0.2
    assert (whole_rims(z_mm, lost_mm, designed.z_mm, OPTIONS) == z_mm).all()


def test_cells_that_chance_left_empty_are_as_high_as_what_is_next_to_them() -> None:
    # regression: a chain of such cells, corner to corner, was as high as the wall at its end: the
    # head kept off a worn edge that it could reach, and 0.90 of it was filled instead of 0.97
    cell_mm = 0.3
    x, y = (g.ravel() for g in np.meshgrid(np.arange(0.15, 12, 0.3), np.arange(0.15, 9, 0.3)))
    column, row = np.rint(x / cell_mm - 0.5), np.rint(y / cell_mm - 0.5)
    wall = column >= 30
    empty = (column + row == 40) & (column > 24) & ~wall  # five cells, the last beside the wall
    z = np.where(wall, 6.0, 2.0)
    points = np.column_stack([x, y, z])[~empty]
    template = MeshSdf.from_mesh(trimesh.creation.box(bounds=[[0, 0, 0], [12, 9, 6]]))
    field = as_built_heights(
        Scan(points, 0.0, "template"),
        template,
        0.25,
        build_from_template=Transform.identity("build", "template"),
        printed_z_mm=None,
        options=HeightOptions(cell_mm=cell_mm),
    )
    told = field.sample(np.column_stack([x, y])[empty], outside_mm=np.nan)
    beside = column[empty] == 29
    assert told[~beside] == pytest.approx(2.0)
    assert told[beside] == pytest.approx(6.0)  # it may be the wall's


def test_noise_of_walls_stands_out_nowhere() -> None:
    # regression: of the thousands of points on walls beside a notch one in fifty was taken for what
    # stands out, and the columns that it raised kept the head off: 0.946 to 0.942 filled for 0.956
    rest, _ = broken("notch", 17.0)
    truth = HeightField.from_manifold(rest, CELL_MM, margin_mm=1.0)
    points = scanned(rest, 4)
    options = HeightOptions()
    field = with_what_stands_out(truth, points, SIGMA_MM, SPACING_MM, options)
    walls = ndimage.maximum_filter(truth.z_mm, 3) - truth.z_mm > 1.0
    raised = walls & (field.z_mm - truth.z_mm > 0.5)
    assert raised.sum() < 0.01 * walls.sum()  # 0.13 of them
    # a burr thinner than the points' spacing stays what the head must keep off
    burr = Solid.cube((6.0, 0.1, 1.0)).translate((1.0, 3.0, 6.0))
    points = scanned(rest + burr, 4)
    field = with_what_stands_out(truth, points, SIGMA_MM, SPACING_MM, options)
    x, y = truth.centres_mm()
    beside = ((x > 1.2) & (x < 6.8))[None, :] & (np.abs(y - 3.05) < 0.15)[:, None]
    assert (ndimage.maximum_filter(field.z_mm, 9)[beside] > 6.7).all()


def test_a_wall_beside_the_middles_of_columns_is_told_where_its_plane_crosses_them() -> None:
    # regression: a plane 0.015 mm beside the middles, through noise, crossed them between its ends,
    # and whatever stood there before stayed: whole rows of columns too high
    block = Solid.cube((24.0, 20.0, 6.0))
    rough = HeightField.from_manifold(block, CELL_MM, margin_mm=1.0)
    middle_mm = float(rough.centres_mm()[0][100])
    piece = block ^ Solid.cube((9.0, 30.0, 4.0)).translate((middle_mm - 0.015, -5.0, 3.0))
    rest = block - piece
    truth = HeightField.from_manifold(rest, CELL_MM, margin_mm=1.0)
    z_mm = np.array(truth.z_mm, dtype=np.float64)
    assert (z_mm[30:190, 100] < 4.0).all()
    assert (z_mm[30:190, 99] > 5.0).all()
    z_mm[:, 100] = z_mm[:, 99]
    high = HeightField(truth.origin_mm, CELL_MM, z_mm, truth.seen)
    sharp = with_sharp_walls(high, gone_from(truth, piece), scanned(rest, 5), SIGMA_MM)
    assert (sharp.z_mm[30:190, 100] < 4.0).mean() > 0.9
