"""Any bytes are a scan or one sentence: good files of every reader, with bytes changed.

A thousand mutations in the suite, a million by name (`-m slow`), a hundred thousand a seed.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import tifffile
import trimesh

from amrepair.errors import InputError
from amrepair.scans import Scan, read_scan, write_ply
from gcode.surfaces import HeightField
from tests.mutations import mutated
from tests.range_images import (
    in_camera,
    perspective,
    ptx_station,
    write_depth_map,
    write_pcd_grid,
    write_ply_grid,
)


def small() -> np.ndarray:
    """A corner of a range image with gaps, as a camera sees it."""
    return np.ascontiguousarray(in_camera(perspective())[2:14, 6:20])


def good_files(folder: Path) -> dict[str, bytes]:
    """A small file of every kind; a depth map's camera goes by its image's name."""
    xyz = small()
    points = xyz[~np.isnan(xyz).any(axis=2)]
    rng = np.random.default_rng(0)
    for kind in ("ascii", "binary_little_endian", "binary_big_endian"):
        write_ply_grid(folder / f"grid_{kind}.ply", xyz, kind, header="comment unit m\n")
    for kind in ("ascii", "binary", "binary_compressed"):
        write_pcd_grid(folder / f"{kind}.pcd", xyz, kind, "0 0 1 1 0 0 0")
    (folder / "two.ptx").write_text(ptx_station(xyz) + ptx_station(xyz))
    whole = in_camera(perspective())
    write_depth_map(folder / "depth.png", whole, count_mm=0.01)
    write_depth_map(folder / "packed.tif", whole, count_mm=0.01)
    write_depth_map(folder / "plain.tiff", whole, count_mm=0)
    sensors, index = np.array([[0.0, 0, 9], [9, 0, 9]]), rng.integers(0, 2, len(points))
    scan = Scan(points, 0.03, "s", points / 200, sensors, index)
    write_ply(scan, folder / "own.ply")
    rows = "\n".join(" ".join(f"{v:.6f}" for v in p) for p in points)
    (folder / "rows.xyz").write_text(rows)
    (folder / "rows.csv").write_text("x,y,z\n" + rows.replace(" ", ","))
    np.save(folder / "rows.npy", points)
    np.savez_compressed(
        folder / "rows.npz", points_mm=points, sensors_mm=sensors, sensor_index=index, sigma_mm=0.1
    )
    heights = HeightField(np.zeros(2), 0.5, rng.uniform(0, 1, (6, 7)), np.ones((6, 7), dtype=bool))
    for name in ("height.tif", "height.npz"):
        heights.write(folder / name)
    tifffile.imwrite(folder / "height2.tiff", rng.uniform(0, 1, (6, 7)), compression="zlib")
    body = trimesh.creation.box((2.0, 3.0, 4.0))
    for name in ("mesh.stl", "mesh.obj", "mesh.ply", "mesh.3mf"):
        body.export(folder / name)
    (folder / "text.stl").write_text(trimesh.exchange.stl.export_stl_ascii(body))
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


def trouble(folder: Path, files: dict[str, bytes], count: int, seed: int) -> list[str]:
    """What went otherwise than a scan or one sentence, over so many mutations."""
    rng = np.random.default_rng(seed)
    scans = [name for name in files if not name.endswith(".json")]
    found, read = [], 0
    for k in range(count):
        name = scans[k % len(scans)]
        beside = Path(name).with_suffix(".json").name
        changed = beside if beside in files and rng.random() < 0.3 else name
        for each in {name, beside} & set(files):
            data = mutated(files[each], rng) if each == changed else files[each]
            (folder / each).write_bytes(data)
        began = time.process_time()
        try:
            scan = read_scan(folder / name, frame="scanner", cell_mm=0.5)
            assert np.isfinite(scan.points_mm).all()
            assert scan.edge is None or len(scan.edge) == len(scan)
            read += 1
        except InputError as e:
            if "\n" in str(e) or str(folder) not in str(e):
                found.append(f"{k} {name}: the sentence is {str(e)!r}")
        except Exception as e:  # noqa: BLE001 what else there is, is what is asked
            found.append(f"{k} {name} ({changed}): {type(e).__name__}: {str(e)[:200]}")
        spent_s = time.process_time() - began
        if spent_s > 5:
            found.append(f"{k} {name} took {spent_s:.1f} s")
        (folder / name).unlink()
    assert read > count / 20, "nearly nothing was read: the mutations are too coarse"
    return found


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return good_files(tmp_path_factory.mktemp("good"))


def test_the_files_are_good_before_they_are_changed(tmp_path: Path, good: dict[str, bytes]) -> None:
    for name, data in good.items():
        (tmp_path / name).write_bytes(data)
    for name in good:
        if not name.endswith(".json"):
            assert len(read_scan(tmp_path / name, frame="scanner", cell_mm=0.5)) > 0


def test_a_changed_file_is_a_scan_or_one_sentence(tmp_path: Path, good: dict[str, bytes]) -> None:
    assert trouble(tmp_path, good, 1_000, seed=1) == []


@pytest.mark.slow
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("seed", range(2, 12))
def test_many_changed_files_are_scans_or_one_sentence(
    tmp_path: Path, good: dict[str, bytes], seed: int
) -> None:
    assert trouble(tmp_path, good, 100_000, seed=seed) == []
