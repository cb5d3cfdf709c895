"""Published layouts with their quirks, in small folders written exactly as they are."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from amrepair.bench.dataset import open_dataset
from amrepair.errors import InputError


def write_pcd_ascii(path: Path, points: np.ndarray, digits: int = 6) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    n = len(points)
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\n"
        f"TYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {n}\nDATA ascii\n"
    )
    rows = "\n".join(" ".join(f"{v:.{digits}f}" for v in row) for row in points)
    path.write_text(head + rows + "\n")


def write_pcd_binary(path: Path, points: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    n = len(points)
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\n"
        f"TYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {n}\nDATA binary\n"
    )
    path.write_bytes(head.encode() + points.astype("<f4").tobytes())


def write_truth(path: Path, points: np.ndarray, labels: np.ndarray, sep: str = " ") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        "".join(
            sep.join([*(f"{v:.6f}" for v in p), f"{label:.6f}"]) + "\n"
            for p, label in zip(points, labels, strict=True)
        )
    )


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def real3d(tmp_path: Path, rng: np.random.Generator) -> Path:
    folder = tmp_path / "Real3D-AD-PCD" / "chicken"
    for i in range(4):
        write_pcd_binary(folder / "train" / f"{i}_template.pcd", rng.normal(size=(20, 3)))
    write_pcd_binary(folder / "train" / "notes_extra.pcd", rng.normal(size=(5, 3)))
    for name in ("142_good", "142_good_cut", "143_good_copy", "9_template", "7_temp"):
        write_pcd_binary(folder / "test" / f"{name}.pcd", rng.normal(size=(11, 3)))
    for name, count in (("705_bulge", 30), ("706_sink", 12), ("706_sink_cut", 9)):
        points = rng.normal(size=(count, 3))
        write_pcd_binary(folder / "test" / f"{name}.pcd", points[: count - 3])  # counts differ
        write_truth(folder / "gt" / f"{name}.txt", points, np.arange(count) % 2)
    return tmp_path


def test_real3d_names_and_geometry(real3d: Path) -> None:
    found = open_dataset(real3d, "real3d-ad")
    (chicken,) = found.classes
    assert [path.name for path in chicken.train] == [f"{i}_template.pcd" for i in range(4)]
    assert {s.name: s.kind for s in chicken.test} == {
        "142_good": "good",
        "142_good_cut": "good",
        "143_good_copy": "good",
        "705_bulge": "bulge",
        "706_sink": "sink",
        "706_sink_cut": "sink",
    }
    clouds = {s.name: s.load() for s in chicken.test}
    assert clouds["142_good"].labels.tolist() == [0] * 11
    # the txt is the geometry: all 30 points, although the pcd has 27
    assert len(clouds["705_bulge"].points) == 30
    assert clouds["705_bulge"].labels.tolist() == [i % 2 for i in range(30)]


def test_real3d_prototype_files_and_the_class_folder_itself(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    write_pcd_binary(tmp_path / "fish" / "train" / "1_prototype.pcd", rng.normal(size=(5, 3)))
    write_pcd_binary(tmp_path / "fish" / "test" / "2_good.pcd", rng.normal(size=(5, 3)))
    (fish,) = open_dataset(tmp_path, "real3d-ad").classes
    assert [path.name for path in fish.train] == ["1_prototype.pcd"]


def test_real3d_truth_with_any_white_space(tmp_path: Path, rng: np.random.Generator) -> None:
    write_pcd_binary(tmp_path / "fish" / "train" / "1_template.pcd", rng.normal(size=(5, 3)))
    write_pcd_binary(tmp_path / "fish" / "test" / "2_sink.pcd", rng.normal(size=(2, 3)))
    (tmp_path / "fish" / "gt").mkdir()
    (tmp_path / "fish" / "gt" / "2_sink.txt").write_text("1 2\t3  1.0\n\n 4 5 6 0\n")
    cloud = open_dataset(tmp_path, "real3d-ad").classes[0].test[0].load()
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.labels.tolist() == [1, 0]


def test_real3d_truth_of_a_piece_is_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    # regression: a txt that was cut short counted as the whole sample
    write_pcd_binary(tmp_path / "fish" / "train" / "1_template.pcd", rng.normal(size=(5, 3)))
    write_pcd_binary(tmp_path / "fish" / "test" / "2_sink.pcd", rng.normal(size=(40, 3)))
    write_truth(tmp_path / "fish" / "gt" / "2_sink.txt", rng.normal(size=(9, 3)), np.arange(9) % 2)
    with pytest.raises(InputError, match="9 rows of truth for the 40 points") as caught:
        open_dataset(tmp_path, "real3d-ad").classes[0].test[0].load()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("variant", "sep"), [("pcd", ","), ("new_pcd", ","), ("16384", " ")])
@pytest.mark.parametrize("below", ["", "dataset", "dataset/{variant}"])
def test_shapenet_variants_and_separators(
    tmp_path: Path, rng: np.random.Generator, variant: str, sep: str, below: str
) -> None:
    folder = tmp_path / "dataset" / variant / "ashtray0"
    points = rng.uniform(-1, 1, (40, 3)).round(6)
    labels = rng.integers(0, 2, 40)
    for i in range(4):
        write_pcd_ascii(folder / "train" / f"ashtray0_template{i}.pcd", points)
    write_pcd_ascii(folder / "test" / "ashtray0_positive3.pcd", points)
    write_pcd_ascii(folder / "test" / "ashtray0_template0.pcd", points)
    write_pcd_ascii(folder / "test" / "ashtray0_bulge0.pcd", points)
    shuffled = rng.permutation(40)
    write_truth(folder / "GT" / "ashtray0_bulge0.txt", points[shuffled], labels[shuffled], sep)
    found = open_dataset(tmp_path / below.format(variant=variant), "anomaly-shapenet")
    (ashtray,) = found.classes
    assert [(s.name, s.anomalous) for s in ashtray.test] == [
        ("ashtray0_bulge0", True),
        ("ashtray0_positive3", False),
    ]
    assert len(ashtray.train) == 4
    cloud = ashtray.test[0].load()
    assert np.array_equal(cloud.labels, labels)  # in the cloud's order, not the file's
    assert not ashtray.test[1].load().labels.any()


def one_class(root: Path, name: str, stem: str, points: np.ndarray, digits: int = 6) -> Path:
    folder = root / "dataset" / "pcd" / name
    write_pcd_ascii(folder / "train" / f"{name}_template0.pcd", points, digits)
    write_pcd_ascii(folder / "test" / f"{stem}.pcd", points, digits)
    return folder


def test_shapenet_vase_is_matched_to_seven_decimals(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    # neighbours 2e-7 apart: the same to six decimals
    points = np.repeat(rng.uniform(-0.5, 0.5, (20, 3)).round(6), 2, axis=0)
    points[1::2, 0] += 2e-7
    labels = np.tile([0, 1], 20)
    folder = one_class(tmp_path, "vase3", "vase3_hole1", points, digits=9)
    order = rng.permutation(40)
    (folder / "GT").mkdir()
    (folder / "GT" / "vase3_hole1.txt").write_text(
        "".join(",".join([*(f"{v:.7f}" for v in points[i]), str(labels[i])]) + "\n" for i in order)
    )
    cloud = open_dataset(tmp_path, "anomaly-shapenet").classes[0].test[0].load()
    assert np.array_equal(cloud.labels, labels)


@pytest.mark.parametrize("rows", [55, 70])
def test_shapenet_wrong_counts_take_the_nearest_row(
    tmp_path: Path, rng: np.random.Generator, rows: int
) -> None:
    points = rng.uniform(0, 1, (60, 3)).round(6)
    labels = (points[:, 0] > 0.5).astype(int)
    folder = one_class(tmp_path, "helmet1", "helmet1_bulge2", points)
    extra = points[rng.integers(0, 60, 10)]
    all_rows = np.concatenate([points, extra])[:rows]
    write_truth(
        folder / "GT" / "helmet1_bulge2.txt", all_rows, (all_rows[:, 0] > 0.5).astype(int), ","
    )
    cloud = open_dataset(tmp_path, "anomaly-shapenet").classes[0].test[0].load()
    assert len(cloud.labels) == 60
    known = slice(0, min(rows, 60))
    assert np.array_equal(cloud.labels[known], labels[known])


def test_shapenet_desk_truth_lies_under_the_bare_name(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    points = rng.uniform(0, 1, (30, 3)).round(6)
    labels = rng.integers(0, 2, 30)
    folder = one_class(tmp_path, "desk0", "desk0_crack1", points)
    write_truth(folder / "GT" / "desk_crack1.txt", points, labels, ",")
    sample = open_dataset(tmp_path, "anomaly-shapenet").classes[0].test[0]
    assert sample.kind == "crack"
    assert np.array_equal(sample.load().labels, labels)


def test_shapenet_normal_shape_as_a_mesh(tmp_path: Path, rng: np.random.Generator) -> None:
    one_class(tmp_path, "cup0", "cup0_positive0", rng.uniform(0, 1, (30, 3)))
    assert open_dataset(tmp_path, "anomaly-shapenet").classes[0].mesh is None
    folder = tmp_path / "dataset" / "obj" / "cup0"
    (folder / "test").mkdir(parents=True)
    (folder / "test" / "cup0_bulge0.obj").write_text("v 0 0 0\n")
    assert open_dataset(tmp_path, "anomaly-shapenet").classes[0].mesh is None
    (folder / "train").mkdir()
    (folder / "train" / "cup0_template0.obj").write_text("v 0 0 0\n")
    mesh = open_dataset(tmp_path, "anomaly-shapenet").classes[0].mesh
    assert mesh is not None
    assert mesh.name == "cup0_template0.obj"


def test_truth_of_another_shape_is_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    points = rng.uniform(0, 1, (30, 3)).round(6)
    folder = one_class(tmp_path, "cup0", "cup0_bulge0", points)
    write_truth(folder / "GT" / "cup0_bulge0.txt", points + 5, np.zeros(30), ",")
    with pytest.raises(InputError, match="another cloud"):
        open_dataset(tmp_path, "anomaly-shapenet").classes[0].test[0].load()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "these have 0 values"),
        ("1 2 3\n", "these have 3 values"),
        ("1 2 3 nan\n", "not finite"),
        ("1 2 three 1\n", "cannot be read"),
        ("1 2 3 1\n1 2 3\n", "cannot be read"),
        (None, "no such truth file"),
    ],
)
def test_damaged_truth_is_refused_in_one_sentence(
    tmp_path: Path, rng: np.random.Generator, text: str | None, message: str
) -> None:
    write_pcd_binary(tmp_path / "fish" / "train" / "1_template.pcd", rng.normal(size=(5, 3)))
    write_pcd_binary(tmp_path / "fish" / "test" / "2_sink.pcd", rng.normal(size=(2, 3)))
    (tmp_path / "fish" / "gt").mkdir()
    if text is not None:
        (tmp_path / "fish" / "gt" / "2_sink.txt").write_text(text)
    sample = open_dataset(tmp_path, "real3d-ad").classes[0].test[0]
    with pytest.raises(InputError, match=message) as caught:
        sample.load()
    assert "\n" not in str(caught.value)


def test_corrupt_clouds_are_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    folder = tmp_path / "fish"
    write_pcd_binary(folder / "train" / "1_template.pcd", rng.normal(size=(5, 3)))
    write_pcd_binary(folder / "test" / "2_good.pcd", rng.normal(size=(50, 3)))
    whole = (folder / "test" / "2_good.pcd").read_bytes()
    (folder / "test" / "2_good.pcd").write_bytes(whole[:-100])
    (folder / "test" / "3_good.pcd").write_bytes(b"\x00" * 200)
    nan = struct.pack("<3f", float("nan"), 0.0, 0.0)
    (folder / "test" / "4_good.pcd").write_bytes(whole[:-12] + nan)
    for sample in open_dataset(tmp_path, "real3d-ad").classes[0].test:
        with pytest.raises(InputError):
            sample.load()


def test_folders_that_are_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no class of the real3d-ad layout"):
        open_dataset(tmp_path, "real3d-ad")
    with pytest.raises(InputError, match="no such folder"):
        open_dataset(tmp_path / "absent", "real3d-ad")
    with pytest.raises(InputError, match="format 'mvtec' is unknown"):
        open_dataset(tmp_path, "mvtec")
    (tmp_path / "a" / "train").mkdir(parents=True)
    (tmp_path / "a" / "test").mkdir()
    with pytest.raises(InputError, match="no training cloud"):
        open_dataset(tmp_path, "real3d-ad")
