"""The benchmark on real scans, on scans whose truth is a formula."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

FOLDER = Path(__file__).parents[2] / "benchmarks"
RADIUS_MM = 40.0


@pytest.fixture(scope="module")
def bench() -> Iterator[ModuleType]:
    sys.path.insert(0, str(FOLDER))  # as a script has it
    try:
        import bench_real

        yield bench_real
    finally:
        sys.path.remove(str(FOLDER))


@pytest.fixture(scope="module")
def scans(bench: ModuleType) -> ModuleType:
    return sys.modules["real_scans"]


def ball_points(rng: np.random.Generator, count: int = 120_000) -> np.ndarray:
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return way * (RADIUS_MM + rng.normal(0.0, 0.05, (count, 1)))


def lens_mm3(depth_mm: float, ball_mm: float) -> float:
    """Common volume of the part's ball and a dent's (Wolfram MathWorld, sphere-sphere)."""
    apart = RADIUS_MM + ball_mm - depth_mm
    both = (RADIUS_MM + ball_mm - apart) ** 2
    other = apart**2 + 2 * apart * (ball_mm + RADIUS_MM) - 3 * (ball_mm - RADIUS_MM) ** 2
    return float(np.pi * both * other / (12 * apart))


def test_dents_take_what_the_formula_says_and_keep_the_noise(scans: ModuleType) -> None:
    surface = scans.Surface(trimesh.creation.icosphere(5, RADIUS_MM))
    points = ball_points(np.random.default_rng(0))
    deviation_mm = surface.deviation_mm(points)
    broken, dents = scans.planted(surface, points, deviation_mm, seed=3)
    again, same = scans.planted(surface, points, deviation_mm, seed=3)
    np.testing.assert_array_equal(broken, again)
    assert dents == same
    assert sorted(dent.depth_mm for dent in dents) == [1.0, 1.5, 2.0, 2.5, 3.0, 4.0]
    assert all(dent.one_sided for dent in dents)
    moved = np.linalg.norm(broken - points, axis=1) > 1e-9
    inside = np.zeros(len(points), dtype=bool)
    for dent in dents:
        # facets of the part and the dent: a per cent
        volume = lens_mm3(dent.depth_mm, dent.ball_mm)
        assert dent.volume_mm3 == pytest.approx(volume, rel=0.03)
        site = np.array([dent.centre_mm])
        centre = (site + surface.normals(site) * (dent.ball_mm - dent.depth_mm))[0]
        mine = moved & (np.linalg.norm(broken - centre, axis=1) < dent.ball_mm + 1.0)
        # a point before the wall is in the dent's air: nearer to the middle of its ball
        wall_mm = dent.ball_mm - np.linalg.norm(broken[mine] - centre, axis=1)
        np.testing.assert_allclose(wall_mm, deviation_mm[mine], atol=0.002)
        inside |= mine
    assert (inside == moved).all()


def write_range_image(path: Path, points_m: np.ndarray, grid: np.ndarray) -> None:
    rows, columns = grid.shape
    cells = ["0" if k < 0 else f"1 {k}" for k in grid.ravel()]
    head = [
        "ply", "format ascii 1.0", f"obj_info num_cols {columns}", f"obj_info num_rows {rows}",
        f"element vertex {len(points_m)}", "property float x", "property float y",
        "property float z", f"element range_grid {rows * columns}",
        "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    points = [" ".join(f"{value:.7f}" for value in point) for point in points_m]
    path.write_text("\n".join([*head, *points, *cells]) + "\n")


def test_range_images_lie_as_their_file_says_either_way_round(
    scans: ModuleType, tmp_path: Path
) -> None:
    x, y = np.meshgrid(np.arange(-30, 30, 0.8), np.arange(-20, 20, 0.8))
    z = 8 * np.sin(x / 9) + 0.02 * x * y  # no symmetry
    part = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    lines = ["camera 0 0 0 0 0 0 1"]
    for k, flipped in enumerate((False, False, True)):
        turn = Rotation.from_euler("xyz", [10.0 * k, -12.0 * k, 5.0 * k], degrees=True)
        shift = np.array([3.0, -2.0, 1.0]) * k
        keep = np.hypot(part[:, 0] - 5 * k, part[:, 1]) < 22
        points = turn.inv().apply(part[keep] - shift)
        grid = np.full(x.size, -1)
        grid[keep] = np.arange(keep.sum())
        write_range_image(tmp_path / f"v{k}.ply", points / 1000, grid.reshape(x.shape))
        q = (turn if flipped else turn.inv()).as_quat()
        numbers = " ".join(f"{value:.9f}" for value in (*shift / 1000, *q))
        lines.append(f"bmesh v{k}.ply {numbers}")
    lines.append("bmesh gone.ply 0 0 0 0 0 0 1")
    conf = tmp_path / "x.conf"
    conf.write_text("\n".join(lines))
    views = scans.read_views(tmp_path, conf)
    assert [view.image.name for view in views] == ["v0.ply", "v1.ply", "v2.ply"]
    for k, view in enumerate(views):
        keep = np.hypot(part[:, 0] - 5 * k, part[:, 1]) < 22
        np.testing.assert_allclose(view.points_mm, part[keep], atol=1e-3)
        grid = view.image.grid
        assert grid.shape == x.shape
        np.testing.assert_array_equal(np.flatnonzero(grid.ravel() >= 0), np.flatnonzero(keep))


def region(low: list[float], high: list[float], volume: float = 5.0) -> dict[str, object]:
    return {
        "label": "missing", "volume_mm3": volume, "area_mm2": 9.0, "depth_mm": 1.0,
        "box_mm": [low, high],
    }  # fmt: skip


def test_a_region_is_the_dents_in_whose_place_it_lies(bench: ModuleType) -> None:
    boxes = ([[0, 0, 0], [8, 8, 2]], [[30, 0, 0], [38, 8, 2]])
    dents = [bench.Dent([0, 0, 0], 2.0, 7.0, 10.0, box, True) for box in boxes]
    parts = [region([31, 1, 0], [33, 4, 1.9], 6.0), region([34, 3, 0.1], [38.3, 8, 1.9], 4.5)]
    whole = region([-40, -40, -40], [60, 60, 60], 3000.0)  # it drowns both
    beside = region([20, 1, 0], [24, 4, 1])
    owners = [bench.belongs_to(found, dents) for found in (*parts, whole, beside)]
    assert owners == [1, 1, None, None]
    told = bench.told(dents[1], parts)
    assert (told["found"], told["parts"], told["error"]) == (True, 2, pytest.approx(0.05))
    assert bench.told(dents[0], [])["found"] is False


def test_what_was_refused_meets_no_goal(bench: ModuleType) -> None:
    base = {"base_false": 0, "base_false_2mm2": 0, "base_found": [], "base_s": 1.0}
    row = {
        "kind": "sound", "case": "sound", "points": 9, "refused": "exit 2: no", "wall_s": 1.0,
        "peak_gb": 0.1,
    }  # fmt: skip
    told = bench.tables([row | base, row | base | {"kind": "view"}, row | base | {"kind": "load"}])
    goals = told.split("| goal |")[1]
    assert "yes" not in goals
    assert goals.count("| NO |") == 6


@pytest.mark.slow
def test_memory_is_the_childs_own(bench: ModuleType) -> None:
    ballast = np.ones(60_000_000)  # 0.48 GB, the parent's
    found = bench.run(["--version"], 60.0)
    assert found.wall_s < 60.0
    assert 0.0 < found.peak_gb < 0.4
    assert ballast.sum() > 0


@pytest.mark.slow
def test_baseline_finds_a_dent_and_nothing_else(bench: ModuleType, scans: ModuleType) -> None:
    small = 15.0 / RADIUS_MM
    surface = scans.Surface(trimesh.creation.icosphere(4, 15.0))
    points = ball_points(np.random.default_rng(1), 30_000) * small
    way = points / np.linalg.norm(points, axis=1, keepdims=True)
    in_dent = way[:, 2] > np.cos(0.3)  # 4.5 mm round
    site, _ = bench.baseline_regions(surface, points, 0.15)
    assert len(site) == 0
    broken = np.where(in_dent[:, None], points - way, points)
    site, of = bench.baseline_regions(surface, broken, 0.15)
    assert set(of) == {0}
    # all of it but its rim, where medians over 2.5 mm see both sides
    assert (site[:, 2] > 13.0).all()
    assert len(site) * 0.36 == pytest.approx(np.pi * 4.5**2, rel=0.5)
