"""3D-ADAM's layout and a user's own folder: what is written here is what the readers give back."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from amrepair.bench import run_bench
from amrepair.bench.adam3d import read_part
from amrepair.bench.cells import Cell, _judge
from amrepair.bench.dataset import LAYOUTS, open_dataset
from amrepair.bench.samples import UNLABELLED, Format
from amrepair.errors import InputError

ROWS, COLUMNS = 60, 80


def table_and_block(tilt: float = 0.1, height: float = 20.0) -> tuple[np.ndarray, np.ndarray]:
    """A block on a tilted table as a camera's x y z image, and which pixels show the block."""
    y, x = np.mgrid[0:ROWS, 0:COLUMNS].astype(np.float64)
    block = (np.abs(x - 40) < 15) & (np.abs(y - 30) < 10)
    z = 300.0 + tilt * x - np.where(block, height, 0.0)
    return np.stack([x, y, z], axis=2), block


def write_adam(root: Path, split: str, label: str, stem: str, grid: np.ndarray) -> Path:
    folder = root / "1m1" / split / label
    (folder / "xyz").mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(folder / "xyz" / f"{stem}.tiff", grid.astype(np.float32), photometric="rgb")
    return folder


@pytest.fixture
def adam(tmp_path: Path) -> Path:
    rng = np.random.default_rng(1)
    for stem in ("001_C", "002_C"):
        grid, _ = table_and_block()
        grid[:, :, 2] += rng.normal(0, 0.05, (ROWS, COLUMNS))
        write_adam(tmp_path, "train", "good", stem, grid)
        write_adam(tmp_path, "test", "good", stem, grid)
    grid, _ = table_and_block()
    grid[:, :, 2] += rng.normal(0, 0.05, (ROWS, COLUMNS))
    grid[0, :5] = 0.0  # gaps, as the published files have them
    grid[25, 40] = np.nan
    folder = write_adam(tmp_path, "test", "cut", "001_C", grid)
    mask = np.zeros((ROWS, COLUMNS), np.uint8)
    mask[28:32, 35:45] = 255
    (folder / "ground_truth").mkdir()
    Image.fromarray(mask).save(folder / "ground_truth" / "001_C.png")
    return tmp_path


def test_adam_points_are_the_part_without_its_table(adam: Path) -> None:
    (one,) = open_dataset(adam, "3d-adam").classes
    assert one.name == "1m1"
    assert [(s.name, s.kind, s.anomalous) for s in one.test] == [
        ("cut_001_C", "cut", True),
        ("good_001_C", "good", False),
        ("good_002_C", "good", False),
    ]
    cloud = one.test[0].load()
    _, block = table_and_block()
    # all but the pixel without depth, and of the table what three standard deviations leave: 1 %
    shown = int(block.sum()) - 1
    assert shown <= len(cloud.points) < shown + 0.02 * ROWS * COLUMNS
    high = cloud.points[:, 2] < 300.0 + 0.1 * cloud.points[:, 0] - 10.0
    assert int(high.sum()) == shown
    assert int(cloud.labels.sum()) == 40
    assert cloud.labels[high].sum() == 40
    assert len(one.read_train(one.train[0])) >= shown


def test_adam_without_a_table_keeps_every_pixel(tmp_path: Path) -> None:
    y, x = np.mgrid[0:ROWS, 0:COLUMNS].astype(np.float64)
    ball = np.stack([x, y, 100 + ((x - 40) ** 2 + (y - 30) ** 2) / 40], axis=2)
    folder = write_adam(tmp_path, "train", "good", "1", ball)
    assert len(read_part(folder / "xyz" / "1.tiff")) == ROWS * COLUMNS


def test_adam_mask_of_another_size_is_refused(adam: Path) -> None:
    Image.new("L", (8, 8)).save(adam / "1m1" / "test" / "cut" / "ground_truth" / "001_C.png")
    with pytest.raises(InputError, match="8 × 8 pixels, its scan 80 × 60"):
        open_dataset(adam, "3d-adam").classes[0].test[0].load()


@pytest.mark.parametrize("content", [b"", b"II*\0 nothing more", b"no tiff at all"])
def test_adam_damaged_scan_is_refused(adam: Path, content: bytes) -> None:
    (adam / "1m1" / "test" / "cut" / "xyz" / "001_C.tiff").write_bytes(content)
    with pytest.raises(InputError, match="cannot be read") as caught:
        open_dataset(adam, "3d-adam").classes[0].test[0].load()
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_adam_runs_through_the_bench_in_two_processes(adam: Path, tmp_path: Path) -> None:
    report = run_bench(
        adam, format="3d-adam", methods=["btf-raw"], out=tmp_path / "out", seeds=[0, 1], jobs=2
    )
    assert [row.samples for row in report.rows] == [3, 3]
    assert "not run" not in report.markdown_path.read_text()  # nothing was published on it here


def write_xyz(path: Path, points: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, points, fmt="%.6f")


def test_a_folder_of_ones_own(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 10, (50, 3)).round(6)
    labels = rng.integers(0, 2, 50)
    write_xyz(tmp_path / "sound" / "a.xyz", points)
    for name in ("good/s1", "crack/s2", "crack/s3", "s4", "s5"):
        write_xyz(tmp_path / "test" / f"{name}.xyz", points)
    (tmp_path / "masks").mkdir()
    np.savetxt(tmp_path / "masks" / "s2.txt", labels, fmt="%d")
    order = rng.permutation(50)
    np.savetxt(tmp_path / "masks" / "s4.txt", np.column_stack([points, labels])[order])
    (one,) = open_dataset(tmp_path, "folder").classes
    clouds = {s.name: s.load().labels for s in one.test}
    assert {s.name: s.kind for s in one.test} == {
        "good_s1": "good", "crack_s2": "crack", "crack_s3": "crack", "s4": "defect", "s5": "good",
    }  # fmt: skip
    assert clouds["crack_s2"].tolist() == clouds["s4"].tolist() == labels.tolist()
    assert set(clouds["crack_s3"]) == {UNLABELLED}
    assert set(clouds["s5"]) == {0}
    assert pickle.loads(pickle.dumps(one)).test[0].load().labels.tolist() == labels.tolist()


def test_several_classes_and_a_mesh(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0, 10, (50, 3))
    for name in ("cup", "arm"):
        write_xyz(tmp_path / name / "sound" / "a.xyz", points)
        write_xyz(tmp_path / name / "test" / "good" / "b.xyz", points)
    (tmp_path / "arm" / "sound" / "part.stl").write_text("solid\nendsolid\n")
    arm, cup = open_dataset(tmp_path, "folder").classes
    assert (arm.name, cup.name) == ("arm", "cup")
    assert arm.mesh is not None
    assert cup.mesh is None
    (tmp_path / "arm" / "sound" / "other.stl").write_text("solid\nendsolid\n")
    with pytest.raises(InputError, match="2 meshes"):
        open_dataset(tmp_path, "folder")


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        ("1\n0\n", "2 labels for the 50 points"),
        ("2\n" * 50, "labels of a mask are 0 or 1"),
        ("one\n" * 50, "mask cannot be read"),
        ("1 2\n" * 50, "rows of truth"),
    ],
)
def test_masks_that_do_not_fit_are_refused(tmp_path: Path, mask: str, message: str) -> None:
    points = np.random.default_rng(0).uniform(0, 10, (50, 3))
    write_xyz(tmp_path / "sound" / "a.xyz", points)
    write_xyz(tmp_path / "test" / "crack" / "b.xyz", points)
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "b.txt").write_text(mask)
    with pytest.raises(InputError, match=message):
        open_dataset(tmp_path, "folder").classes[0].test[0].load()


def test_points_that_nobody_labelled_are_not_judged(tmp_path: Path) -> None:
    """Regression: -1 counted as a third class."""
    points = np.random.default_rng(0).uniform(0, 10, (50, 3))
    write_xyz(tmp_path / "sound" / "a.xyz", points)
    for name in ("good/a", "crack/b", "crack/c"):
        write_xyz(tmp_path / "test" / f"{name}.xyz", points)
    (tmp_path / "masks").mkdir()
    np.savetxt(tmp_path / "masks" / "c.txt", np.arange(50) % 2, fmt="%d")
    (one,) = open_dataset(tmp_path, "folder").classes
    cell = Cell("btf-raw", replace(one, mesh=None), Format.FOLDER, 0,
                tmp_path / "out")  # fmt: skip
    cell.folder.mkdir(parents=True)
    for sample in one.test:
        labels = sample.load().labels
        np.savez(
            cell.folder / f"{sample.name}.npz", label=labels, score=(labels > 0).astype(float),
            whole=float(sample.anomalous), seconds=1.0, residual_mm=np.nan, aligned=True,
        )  # fmt: skip
    fit = dict.fromkeys(
        ("seconds", "sigma_mm", "cd", "emd", "cd_squared", "to_surface", "from_surface"), 0.0
    )
    row = _judge(cell, fit)
    assert row.p_auroc == 1.0
    assert row.o_auroc == 1.0


def test_a_folder_that_is_not_there_says_where_the_data_set_is_to_be_had(tmp_path: Path) -> None:
    for name, layout in LAYOUTS.items():
        with pytest.raises(InputError) as caught:
            open_dataset(tmp_path / "absent", str(name))
        assert layout.source in str(caught.value)
        assert "\n" not in str(caught.value)
