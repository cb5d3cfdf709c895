"""The learned and the planned template: near to exact fields, files that are refused in words."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from amrepair.errors import TemplateError
from amrepair.template import GridSdf, MeshSdf, PlannedSdf, fit_template, load_or_fit
from amrepair.template.file import write_template

KNOB = Path(__file__).parents[2] / "examples" / "parts" / "knob.stl"


@pytest.fixture(scope="module")
def knob() -> GridSdf:
    return fit_template(KNOB, seed=1)


@pytest.fixture(scope="module")
def exact(knob: GridSdf) -> MeshSdf:
    return MeshSdf.from_mesh(knob.mesh)


def test_the_surface_lies_where_it_should(knob: GridSdf) -> None:
    points, _ = trimesh.sample.sample_surface(knob.mesh, 40_000, seed=9)
    error_mm = np.abs(knob.distance(np.asarray(points)))
    assert error_mm.mean() < 0.002
    assert np.quantile(error_mm, 0.99) < 0.02
    assert np.quantile(error_mm, 0.99) < 1.5 * knob.bias_mm


def test_the_grid_holds_the_exact_field_to_its_corners(knob: GridSdf, exact: MeshSdf) -> None:
    grid, rng = knob.grid, np.random.default_rng(0)
    nodes = np.stack([rng.integers(0, n, 20_000) for n in grid.base.shape], axis=1)
    truth = exact.distance(grid.origin_mm + grid.cell_mm * nodes)
    found = grid.base[tuple(nodes.T)].astype(np.float64)
    # far out a triangle carried on is now and then the nearest one's neighbour
    assert np.abs(found - truth).mean() < 0.001 * grid.cell_mm
    assert np.abs(found - truth).max() < 0.1 * grid.cell_mm
    clear = np.abs(truth) > 1e-3
    assert np.array_equal(found[clear] < 0, truth[clear] < 0)


@pytest.mark.parametrize("offset_mm", [0.05, 0.5, 2.0])
def test_distances_and_signs_hold_away_from_it(
    knob: GridSdf, exact: MeshSdf, offset_mm: float
) -> None:
    points, _ = trimesh.sample.sample_surface(knob.mesh, 20_000, seed=4)
    rng = np.random.default_rng(0)
    way = rng.normal(size=points.shape)
    away = np.asarray(points) + offset_mm * way / np.linalg.norm(way, axis=1, keepdims=True)
    truth, found = exact.distance(away), knob.distance(away)
    assert np.abs(found - truth).mean() < 0.002 + 0.005 * offset_mm
    wrong = (np.sign(found) != np.sign(truth)) & (np.abs(truth) > 0.15)
    assert wrong.mean() < 1e-4


def test_beyond_the_grid_distances_go_on(knob: GridSdf, exact: MeshSdf) -> None:
    # regression: 5 mm out, beyond the grid's margin, the field said 4.0
    points, _ = trimesh.sample.sample_surface(knob.mesh, 5_000, seed=6)
    middle = knob.bounds_mm.mean(axis=0)
    for reach_mm in (6.0, 25.0):
        away = np.asarray(points) - middle
        away = np.asarray(points) + reach_mm * away / np.linalg.norm(away, axis=1, keepdims=True)
        truth = exact.distance(away)
        far = truth > 5.0
        assert np.abs(knob.distance(away) - truth)[far].mean() < 0.02 * reach_mm


def test_far_points_are_far(knob: GridSdf, exact: MeshSdf) -> None:
    far = np.array([[200.0, 0.0, 0.0], [0.0, -300.0, 50.0], [0.0, 0.0, 500.0]])
    assert knob.distance(far) == pytest.approx(exact.distance(far), rel=0.1)


def test_gradients_point_outwards(knob: GridSdf) -> None:
    points, normals = knob.surface_points(1.5)
    _, gradient = knob.distance_and_gradient(points)
    agree = np.einsum("ij,ij->i", gradient, normals)
    assert np.median(agree) > 0.99
    assert (agree > 0.7).mean() > 0.9


def test_a_file_comes_back_bit_for_bit(knob: GridSdf, tmp_path: Path) -> None:
    path = tmp_path / "knob.safetensors"
    knob.save(path)
    again = GridSdf.load(path)
    points = np.random.default_rng(0).uniform(*knob.bounds_mm, (5_000, 3))
    assert np.array_equal(again.distance(points), knob.distance(points))
    assert again.metadata["recipe"] == "fast"
    assert again.solid().volume() == pytest.approx(knob.solid().volume())


@pytest.mark.parametrize("damage", ["missing", "empty", "truncated", "zeroed", "foreign", "text"])
def test_a_damaged_file_is_refused(knob: GridSdf, tmp_path: Path, damage: str) -> None:
    path = tmp_path / "t.safetensors"
    if damage == "truncated":
        knob.save(path)
        path.write_bytes(path.read_bytes()[:5000])
    elif damage == "zeroed":  # regression: it was read, and its distances were taken for true
        knob.save(path)
        data = bytearray(path.read_bytes())
        data[-6000:-2000] = bytes(4000)
        path.write_bytes(data)
    elif damage == "foreign":
        from safetensors.numpy import save_file

        save_file({"weights": np.zeros(3)}, path)
    elif damage != "missing":
        path.write_bytes(b"" if damage == "empty" else b"not a template at all")
    with pytest.raises(TemplateError, match=r"t\.safetensors"):
        GridSdf.load(path)


def test_the_cache_is_used_and_survives_damage(tmp_path: Path) -> None:
    box = trimesh.creation.box((10.0, 8.0, 6.0))
    first = load_or_fit(box, cache_dir=tmp_path)
    (kept,) = tmp_path.glob("*.safetensors")
    stamp = kept.stat().st_mtime_ns
    second = load_or_fit(box, cache_dir=tmp_path)
    assert kept.stat().st_mtime_ns == stamp
    points = np.random.default_rng(0).uniform(-6, 6, (1000, 3))
    assert np.array_equal(first.distance(points), second.distance(points))
    kept.write_bytes(b"half")
    assert load_or_fit(box, cache_dir=tmp_path).bias_mm == first.bias_mm


@pytest.mark.slow
def test_a_file_that_is_known_is_not_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """regression: of 500,000 triangles that took two seconds of every command."""
    box = trimesh.creation.box((10.0, 8.0, 6.0))
    box.invert()
    part, cache = tmp_path / "part.stl", tmp_path / "cache"
    box.export(part)
    first = load_or_fit(part, cache_dir=cache)
    monkeypatch.setattr("amrepair.template.fitting.load_mesh", Mock(side_effect=AssertionError))
    caplog.clear()
    assert load_or_fit(part, cache_dir=cache).bias_mm == first.bias_mm
    assert "part.stl: turned outside out" in caplog.text  # whoever asks again is told again
    box.apply_scale(1.1)
    box.export(part)
    with pytest.raises(AssertionError):
        load_or_fit(part, cache_dir=cache)


def test_an_unknown_recipe_is_refused() -> None:
    with pytest.raises(TemplateError, match="recipe"):
        fit_template(KNOB, recipe="magic")


def beads(gap: bool) -> PlannedSdf:
    """A plate of parallel beads, 20×20 mm, five layers of 0.2 mm; one bead left out if asked."""
    lines, pitch, height = 40, 0.5, 0.2
    y = 10 + (np.arange(lines) + 0.5) * pitch
    starts, ends = [], []
    for k in range(5):
        keep = np.ones(lines, bool)
        if gap and k == 4:
            keep[18:22] = False
        z = np.full(keep.sum(), height * (k + 1))
        starts.append(np.column_stack([np.full(keep.sum(), 10.0), y[keep], z]))
        ends.append(np.column_stack([np.full(keep.sum(), 30.0), y[keep], z]))
    start, end = np.concatenate(starts), np.concatenate(ends)
    section = np.full(len(start), pitch * height)
    return PlannedSdf.from_beads(start, end, section, np.full(len(start), height))


def test_a_planned_plate_is_where_its_beads_are() -> None:
    plate = beads(gap=False)
    middle = np.array([[20.0, 20.0, z] for z in (1.0, 1.3, 0.9, 0.6)])
    assert plate.distance(middle) == pytest.approx([0.0, 0.3, -0.1, -0.4], abs=0.02)
    assert plate.distance(np.array([[20.0, 8.0, 0.5]]))[0] == pytest.approx(2.0, abs=0.15)


def test_a_part_drawn_below_its_own_zero_has_planned_beads_too() -> None:
    # regression: the grid ended at z = 0 of the template's frame, wherever the part stood in it
    start = np.array([[0.0, 0.0, -9.8], [0.0, 0.0, -9.6]])
    end = start + np.array([10.0, 0.0, 0.0])
    planned = PlannedSdf.from_beads(start, end, np.full(2, 0.09), np.full(2, 0.2))
    assert planned.bounds_mm[:, 2] == pytest.approx([-10.0, -9.6])
    assert planned.distance(np.array([[5.0, 0.0, -9.7]]))[0] < 0


def test_an_open_groove_is_planned_to_be_open() -> None:
    groove = beads(gap=True)
    floor = np.array([[20.0, 20.0, 0.8]])
    assert abs(groove.distance(floor)[0]) < 0.06
    assert beads(gap=False).distance(floor)[0] == pytest.approx(-0.2, abs=0.03)


def test_no_beads_no_template() -> None:
    none = np.zeros((0, 3))
    with pytest.raises(TemplateError, match="no beads"):
        PlannedSdf.from_beads(none, none, np.zeros(0), np.zeros(0))


def test_what_an_earlier_version_kept_of_unseen_surface_is_read_as_it_was(
    knob: GridSdf, tmp_path: Path
) -> None:
    """Cells that held surface nobody saw, and a layer of cells around: it was in the first."""
    cell_mm = 1.3
    origin_mm = knob.bounds_mm[0] - 2.3 * cell_mm  # no face lies on the border of cells
    shape = np.ceil((np.ptp(knob.bounds_mm, axis=0) + 4.0 * cell_mm) / cell_mm).astype(int)
    places, outward = knob.surface_points(0.4)
    index = ((places - origin_mm) / cell_mm).astype(int)
    # whole cells: of the upper end, on one side of the middle
    low, side = np.quantile(index[:, 2], 0.7), np.median(index[:, 0])
    unseen = (index[:, 2] > low) & (index[:, 0] > side)
    assert 0.05 < unseen.mean() < 0.4
    cells = np.zeros(tuple(shape), bool)
    cells[tuple(index[unseen].T)] = True
    arrays, head = knob._packed()
    arrays["unseen"] = ndimage.binary_dilation(cells, np.ones((3, 3, 3))).astype(np.uint8)
    head |= {
        "unseen_origin_mm": origin_mm.tolist(),
        "unseen_cell_mm": cell_mm,
        "unseen_mm2": 12.5,
    }
    write_template(tmp_path / "old.safetensors", arrays, head)
    read = GridSdf.load(tmp_path / "old.safetensors")
    assert read.coverage is not None
    assert read.coverage.unseen_mm2 == 12.5
    unknown = read.coverage.unknown_at(places, np.zeros(len(places)), outward)
    assert np.array_equal(unknown, unseen)
    # what is written anew is read as the same
    read.save(tmp_path / "new.safetensors")
    again = GridSdf.load(tmp_path / "new.safetensors").coverage
    assert again is not None
    assert np.array_equal(again.unknown_at(places, np.zeros(len(places)), outward), unknown)
