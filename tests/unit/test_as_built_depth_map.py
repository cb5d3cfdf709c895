"""A photographed depth map as what stands on the bed: put right by the bed, and checked against."""

from __future__ import annotations

import json
import random
import struct
import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import tifffile
from PIL import Image

from gcode.cli import main
from gcode.cli.options import standing_on_bed
from gcode.errors import InputError
from gcode.profiles import load_setup
from gcode.surfaces import HeightField

SHAPE, FOCAL = (240, 320), 300.0
BOX_MM = ((60.0, 90.0), (70.0, 100.0), 12.0)  # X, Y, height
TABLE_MM = 35.0  # around the bed, so far below it
EYE_MM, LOOKS_AT_MM = np.array([110.0, -60.0, 320.0]), np.array([100.0, 110.0, 0.0])


def turned(vector: np.ndarray) -> np.ndarray:
    """Rotation by a vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / max(angle, 1e-12)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def bed_from_camera() -> np.ndarray:
    forward = (LOOKS_AT_MM - EYE_MM) / np.linalg.norm(LOOKS_AT_MM - EYE_MM)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = EYE_MM
    return pose


def photographed(pose: np.ndarray) -> np.ndarray:
    """(rows, columns) depths along the camera's axis of a bare bed with a box on it, mm."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    rays = np.stack([(columns - 160.0) / FOCAL, (rows - 120.0) / FOCAL, np.ones(SHAPE)], -1)
    ways = rays @ pose[:3, :3].T
    eye = pose[:3, 3]
    depth = -eye[2] / ways[..., 2]
    seen = eye + depth[..., None] * ways
    off = (seen[..., :2] < 0).any(-1) | (seen[..., :2] > 220.0).any(-1)
    table = -(eye[2] + TABLE_MM) / ways[..., 2]
    under = eye + table[..., None] * ways
    hidden = (under[..., :2] > 0).all(-1) & (under[..., :2] < 220.0).all(-1)  # by the bed's edge
    depth = np.where(off, np.where(hidden, 0.0, table), depth)
    (x0, x1), (y0, y1), high = BOX_MM
    low, top = np.array([x0, y0, 0.0]), np.array([x1, y1, high])
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(low - eye) / ways, (top - eye) / ways])
    enter, leave = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    return np.where((enter < leave) & (enter > 0), enter, depth)


def written(
    folder: Path, *, suffix: str = ".png", told: np.ndarray | None = None, **other: object
) -> Path:
    """A depth map with noise of 0.2 mm, and the camera as `told`."""
    pose = bed_from_camera()
    depth = photographed(pose)
    depth = np.where(depth > 0, depth + np.random.default_rng(1).normal(0.0, 0.2, SHAPE), 0.0)
    depth[:4] = 0.0
    path = folder / f"bed{suffix}"
    if suffix == ".png":
        Image.fromarray(np.round(depth * 10).astype(np.uint16)).save(path)
    else:
        tifffile.imwrite(path, np.where(depth > 0, depth, np.nan).astype(np.float32))
    said = {
        "fx": FOCAL, "fy": FOCAL, "cx": 160.0, "cy": 120.0, "width": SHAPE[1], "height": SHAPE[0],
        "depth_scale_mm": 0.1 if suffix == ".png" else 1.0,
        "pose": (pose if told is None else told).tolist(),
    }  # fmt: skip
    path.with_suffix(".json").write_text(json.dumps(said | other))
    return path


def tilted(millimetres: float, degrees: float, seed: int) -> np.ndarray:
    """The pose, off by a tilt about the bed's middle and a height."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, 2 * np.pi)
    turn = turned(np.radians(degrees) * np.array([np.cos(angle), np.sin(angle), 0.0]))
    off, middle = np.eye(4), np.array([100.0, 110.0, 0.0])
    off[:3, :3] = turn
    off[:3, 3] = middle - turn @ middle + [0.0, 0.0, millimetres]
    return np.asarray(off @ bed_from_camera())


@pytest.mark.parametrize(
    ("suffix", "millimetres", "degrees"),
    [(".png", 0.0, 0.0), (".png", 4.0, 1.5), (".tif", -6.0, 2.0), (".png", -3.0, 2.5)],
)
def test_the_bed_puts_height_and_tilt_right(
    suffix: str, millimetres: float, degrees: float, tmp_path: Path
) -> None:
    path = written(tmp_path, suffix=suffix, told=tilted(millimetres, degrees, seed=3))
    field = standing_on_bed(path, load_setup("generic_marlin").printer)
    (x0, x1), (y0, y1), high = BOX_MM
    x, y = np.meshgrid(np.arange(x0 + 2, x1 - 2, 2.0), np.arange(y0 + 2, y1 - 2, 2.0))
    on_box = field.sample(np.column_stack([x.ravel(), y.ravel()]))
    assert np.median(on_box) == pytest.approx(high, abs=0.7)  # the highest pixel of each cell
    x, y = np.meshgrid(np.arange(x1 + 30, x1 + 60, 3.0), np.arange(y0, y1, 3.0))
    bare = field.sample(np.column_stack([x.ravel(), y.ravel()]))
    assert np.percentile(bare, 90) < 1.0
    assert field.top_mm < high + 3.0


@pytest.mark.parametrize(
    ("other", "why"),
    [
        ({"pose": None}, "does not say where the camera stands"),
        ({"width": 640}, "do not belong together"),
        ({"fx": 0}, "cannot be understood"),
        ({"pose": [[2.0 * (i == j) for j in range(4)] for i in range(4)]}, "no rigid motion"),
        ({"coeffs": [0.1, 0, 0, 0, 0]}, "distortion"),
    ],
)
def test_a_camera_that_does_not_tell_gets_one_sentence(
    other: dict[str, object], why: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=why) as error:
        standing_on_bed(written(tmp_path, **other))
    assert "\n" not in str(error.value)


def test_a_pose_that_is_far_off_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no bed within 10 mm and 3°"):
        standing_on_bed(written(tmp_path, told=tilted(18.0, 0.0, seed=0)))
    path = written(tmp_path)
    path.with_suffix(".json").unlink()
    with pytest.raises(InputError, match=r"needs the camera in bed\.json"):
        standing_on_bed(path)


def test_a_height_map_that_is_cut_off_is_not_read_as_a_bare_bed(tmp_path: Path) -> None:
    """regression: strips that were not there were zeros, and so nothing stood there."""
    path = tmp_path / "cut.tif"
    tifffile.imwrite(path, np.full((64, 64), 12.0, np.float32), rowsperstrip=8)
    data = bytearray(path.read_bytes())
    tag = struct.pack("<HHIH", 257, 3, 1, 64)
    at = data.find(tag if tag in data else struct.pack("<HHII", 257, 4, 1, 64))
    data[at : at + 12] = struct.pack("<HHII", 257, 4, 1, 640)
    path.write_bytes(data)
    with pytest.raises(InputError, match="in 80 pieces, and the file has 8") as error:
        HeightField.read(path, cell_mm=1.0)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("x_mm", "hits"), [(75.0, True), (170.0, False)])
def test_a_job_is_checked_against_the_photograph(
    x_mm: float,
    hits: bool,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = written(tmp_path, told=tilted(3.0, 1.0, seed=5))
    job, picture = tmp_path / "job.gcode", tmp_path / "contact.svg"
    lines = ["G21", "G90", "M83", "G1 Z40 F600", "G28 X Y", f"G1 X{x_mm} Y85 F6000", "G1 Z2 F600"]
    job.write_text("\n".join([*lines, "G1 Z40 F600"]) + "\n")
    words = f"check {job} --printer generic_marlin --as-built {path} --picture {picture}"
    monkeypatch.setattr(sys, "argv", ["gcode", *words.split()])
    with pytest.raises(SystemExit) as end:
        main()
    said = capsys.readouterr()
    assert "put right by its bed" in said.err
    assert bool(end.value.code) is hits
    assert ("First contact" in said.out + said.err) is hits
    if hits:
        assert ElementTree.parse(picture).getroot().tag.endswith("svg")


def fuzzed(folder: Path, count: int, seed: int) -> int:
    """How many of so many changed depth maps and cameras are refused; none may do anything else."""
    rng, refused = random.Random(seed), 0
    good = {}
    for suffix in (".png", ".tif"):
        path = written(folder, suffix=suffix)
        camera = path.with_suffix(".json")
        good[suffix] = {path: path.read_bytes(), camera: camera.read_bytes()}
    printer = load_setup("generic_marlin").printer
    for _ in range(count):
        files = good[rng.choice([".png", ".tif"])]
        changed = rng.choice(list(files))
        for path, data in files.items():
            out = bytearray(data)
            for _ in range(rng.randint(1, 3) if path == changed else 0):
                at = rng.randrange(len(out) + 1)
                if rng.random() < 0.3:
                    del out[at : at + rng.randint(1, 40)]
                elif rng.random() < 0.5:
                    out[at : at + 1] = bytes([rng.randrange(256)])
                else:
                    out[at:at] = rng.choice([b"9999999", b"-1", b"NaN", b"1e99", b"[]", b"null"])
            path.write_bytes(bytes(out))
        begun, said = time.process_time(), ""
        try:
            assert np.isfinite(standing_on_bed(next(iter(files)), printer).z_mm).all()
        except InputError as error:
            said = str(error)
        refused += bool(said)
        assert "\n" not in said
        assert time.process_time() - begun < 2.0
    return refused


@pytest.mark.filterwarnings("ignore")  # of the libraries, about broken files
def test_changed_depth_maps_are_read_or_refused(tmp_path: Path) -> None:
    assert 10 < fuzzed(tmp_path, 60, seed=1) < 60


@pytest.mark.slow
@pytest.mark.timeout(3000)
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seed", range(2, 12))
def test_many_changed_depth_maps_are_read_or_refused(tmp_path: Path, seed: int) -> None:
    assert 1_000 < fuzzed(tmp_path, 10_000, seed=seed) < 10_000
