"""Range images: each format gives the same grid, and the grid tells sensor, gaps and edges.

Truth is a ball on a plane, by intersection of rays (`tests/range_images.py`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from beartype.roar import BeartypeCallHintViolation

from amrepair.errors import InputError
from amrepair.frames import Transform
from amrepair.scans import EDGE, FLYING, RangeGrid, Scan, read_scan, write_ply
from amrepair.scans.viewpoint import ViewpointOptions, _along_the_way, _pixels, _pushbrooms
from tests.draws import draws
from tests.range_images import (
    CAMERA_MM,
    HOLE,
    PIXEL_MM,
    SHAPE,
    RangeImage,
    in_camera,
    orthographic,
    perspective,
    ptx_station,
    pushbroom,
    write_depth_map,
    write_pcd_grid,
    write_ply_grid,
)

BUNNY = ("bun000", "bun045", "bun090", "bun180", "bun270", "bun315", "chin", "ear_back", "top2",
         "top3")  # fmt: skip
KINDS: dict[str, Callable[[], RangeImage]] = {
    "perspective": perspective, "orthographic": orthographic, "pushbroom": pushbroom,
}  # fmt: skip


def told(scan: Scan) -> RangeGrid:
    """The only grid of a scan."""
    assert scan.grids is not None
    assert len(scan.grids) == 1
    return scan.grids[0]


def picture(scan: Scan, bit: int) -> np.ndarray:
    """The flags as an image; False in gaps."""
    grid = told(scan)
    assert scan.edge is not None
    return np.where(grid.index >= 0, scan.edge[grid.index] & bit, 0) > 0


def write_ptx(path: Path, xyz: np.ndarray) -> None:
    path.write_text(ptx_station(xyz))


WRITERS: dict[str, Callable[[Path, np.ndarray], None]] = {
    "ascii.ply": lambda p, xyz: write_ply_grid(p, xyz, "ascii"),
    "little.ply": lambda p, xyz: write_ply_grid(p, xyz, "binary_little_endian"),
    "big.ply": lambda p, xyz: write_ply_grid(p, xyz, "binary_big_endian"),
    "ascii.pcd": lambda p, xyz: write_pcd_grid(p, xyz, "ascii"),
    "binary.pcd": lambda p, xyz: write_pcd_grid(p, xyz, "binary"),
    "packed.pcd": lambda p, xyz: write_pcd_grid(p, xyz, "binary_compressed"),
    "a.ptx": write_ptx,
    "a.png": lambda p, xyz: write_depth_map(p, xyz, count_mm=0.01),
    "b.png": lambda p, xyz: write_depth_map(p, xyz, count_mm=0.01, style="open3d"),
    "a.tif": lambda p, xyz: write_depth_map(p, xyz, count_mm=0.01),
    "a.tiff": lambda p, xyz: write_depth_map(p, xyz, count_mm=0),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_gives_the_same_grid(tmp_path: Path, name: str) -> None:
    image = perspective()
    xyz = in_camera(image)
    WRITERS[name](tmp_path / name, xyz)
    scan = read_scan(tmp_path / name, frame="scanner")
    grid = told(scan)
    assert np.array_equal(grid.index >= 0, image.seen)
    assert sorted(grid.points) == list(range(len(scan)))
    # depth maps of 0.01 mm a count are off by half of that along a ray that is at most 20° aside
    off = np.abs(scan.points_mm[grid.index[image.seen]] - xyz[image.seen]).max()
    assert off < (0.006 if "png" in name or "tif" in name else 1e-4)
    assert grid.kind == "perspective"
    assert scan.sensors_mm is not None
    assert scan.sensor_index is not None
    assert np.abs(scan.sensors_mm[scan.sensor_index]).max() < 1e-9


@pytest.mark.parametrize("name", ["ascii.ply", "binary.pcd", "a.png"])
def test_flying_pixels_and_edges_are_found(tmp_path: Path, name: str) -> None:
    image = perspective()
    WRITERS[name](tmp_path / name, in_camera(image))
    scan = read_scan(tmp_path / name, frame="scanner")
    edge, flying = picture(scan, EDGE), picture(scan, FLYING)
    assert flying[image.flying].all()
    # else only the ball's rim, where it is seen more grazing than 70° (a pixel is no point)
    away = image.xyz - np.array([0.0, 0.0, 10.0])
    to_sensor = image.sensor_mm - image.xyz
    cosine = (away * to_sensor).sum(axis=2) / 10 / np.linalg.norm(to_sensor, axis=2)
    grazing = image.ball & (cosine < np.cos(np.deg2rad(70)))
    assert not (flying & ~image.flying & ~grazing).any()
    around_hole = np.zeros(SHAPE, bool)
    around_hole[HOLE[0].start - 1 : HOLE[0].stop + 1, HOLE[1].start - 1 : HOLE[1].stop + 1] = True
    around_hole &= image.seen
    assert edge[around_hole].all()
    shown = image.ball | image.flying
    near = np.zeros(SHAPE, bool)
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            near |= np.roll(shown, (dr, dc), axis=(0, 1))
    beside = near & ~shown  # the plane's pixels next to the ball
    assert edge[beside].mean() > 0.95
    assert not edge[~near & ~around_hole].any()
    assert not edge[image.ball & (cosine > 0.5)].any()


@pytest.mark.parametrize("kind", KINDS)
def test_the_sensor_is_told_by_the_grid(tmp_path: Path, kind: str) -> None:
    image = KINDS[kind]()
    xyz = in_camera(image) if kind == "perspective" else image.xyz
    write_ply_grid(tmp_path / "a.ply", xyz, "binary_little_endian")
    scan = read_scan(tmp_path / "a.ply", frame="scanner")
    assert told(scan).kind == kind
    assert scan.sensors_mm is not None
    assert scan.sensor_index is not None
    sensors = scan.sensors_mm[scan.sensor_index]
    if kind == "perspective":
        assert np.abs(sensors).max() == 0
        return
    true = np.broadcast_to(image.sensor_mm, sensors.shape).copy()
    if kind == "pushbroom":
        true[:, 0] = scan.points_mm[:, 0]
        # single precision, and the place of a stretch for each point in it
        assert np.abs(sensors - true)[:, 1:].max() < 0.5
    # a ray is right to a pixel over the depth that was seen: 20 mm
    got, want = (s - scan.points_mm for s in (sensors, true))
    if kind == "orthographic":
        want[:, :2] = 0
    turn = np.linalg.norm(np.cross(got, want), axis=1)
    turn /= np.linalg.norm(got, axis=1) * np.linalg.norm(want, axis=1)
    assert turn.max() * 20 < PIXEL_MM * 1.01


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_an_orthographic_view_knows_its_side_by_the_rims(tmp_path: Path, side: float) -> None:
    write_pcd_grid(tmp_path / "a.pcd", orthographic(side).xyz)
    scan = read_scan(tmp_path / "a.pcd", frame="scanner")
    assert scan.sensors_mm is not None
    assert np.sign(scan.sensors_mm[:, 2]).tolist() == [side]


def box_on_plane() -> np.ndarray:
    xyz = orthographic().xyz.copy()
    xyz[..., 2] = np.where((np.abs(xyz[..., :2]) < 8).all(axis=2), 12.0, 0.0)
    return xyz


def bent() -> np.ndarray:
    """A camera's, then bent: no rays are straight."""
    xyz = in_camera(perspective())
    return xyz + np.stack([0.02 * xyz[..., 1] ** 2, 0 * xyz[..., 0], 0 * xyz[..., 0]], axis=2)


@pytest.mark.parametrize("made", [box_on_plane, bent])
def test_what_the_grid_does_not_tell_stays_unknown(
    tmp_path: Path, made: Callable[[], np.ndarray]
) -> None:
    write_pcd_grid(tmp_path / "a.pcd", made())
    scan = read_scan(tmp_path / "a.pcd", frame="scanner")
    assert scan.sensors_mm is None
    assert told(scan).kind == "unknown"
    assert picture(scan, EDGE)[4:9, 9:15].any()  # the hole's edge is known all the same


TURN = trimesh.transformations.rotation_matrix(0.6, [1.0, 2.0, 0.5])[:3, :3]
AWAY_MM = np.array([30.0, -70.0, 20.0])


@pytest.mark.parametrize("noise_mm", [0.0, 0.05])
@pytest.mark.parametrize("made", [perspective, pushbroom])
def test_a_turned_view_is_told_all_the_same(
    tmp_path: Path, made: Callable[[], RangeImage], noise_mm: float
) -> None:
    """The dragon's range images are such: a sheet of light that moved askew to every axis."""
    image = made()
    noise = np.random.default_rng(0).normal(0, noise_mm, image.xyz.shape)
    write_pcd_grid(tmp_path / "a.pcd", (image.xyz + noise) @ TURN.T + AWAY_MM)
    scan = read_scan(tmp_path / "a.pcd", frame="scanner")
    assert scan.sensors_mm is not None
    assert scan.sensor_index is not None
    true = np.broadcast_to(image.sensor_mm, scan.points_mm.shape).copy()
    back = (scan.points_mm - AWAY_MM) @ TURN
    if made is pushbroom:
        true[:, 0] = back[:, 0]
    got, want = (scan.sensors_mm[scan.sensor_index] - AWAY_MM) @ TURN - back, true - back
    turn = np.linalg.norm(np.cross(got, want), axis=1)
    turn /= np.linalg.norm(got, axis=1) * np.linalg.norm(want, axis=1)
    assert (got * want).sum(axis=1).min() > 0
    # a ray is right to a pixel over the depth that was seen: 20 mm
    assert np.quantile(turn, 0.95) * 20 < PIXEL_MM * 1.01


def test_a_turned_picture_of_a_wall_tells_no_sensor(tmp_path: Path) -> None:
    """Any camera, and any slits, make a picture of a plane: a homography says nothing of rays."""
    rows, columns = np.meshgrid(np.arange(40.0), np.arange(50.0), indexing="ij")
    x, y = (columns - 25) / 60, (rows - 20) / 60
    z = 300.0 / (1.0 + 0.3 * x - 0.2 * y)
    noise = np.random.default_rng(1).normal(0, 0.02, (*z.shape, 3))
    wall = np.stack([x * z, y * z, z], axis=2) + noise
    write_pcd_grid(tmp_path / "a.pcd", wall @ TURN.T + AWAY_MM)
    assert read_scan(tmp_path / "a.pcd", frame="scanner").sensors_mm is None


def test_a_flat_wall_fits_two_models_and_is_not_guessed(tmp_path: Path) -> None:
    rows, columns = np.meshgrid(np.arange(40.0), np.arange(50.0), indexing="ij")
    wall = np.stack([columns, rows, np.full(rows.shape, 300.0)], axis=2)
    write_pcd_grid(tmp_path / "a.pcd", wall)
    assert read_scan(tmp_path / "a.pcd", frame="scanner").sensors_mm is None


def test_the_users_word_goes_before_the_grid(tmp_path: Path) -> None:
    write_ply_grid(tmp_path / "a.ply", pushbroom().xyz, "ascii")
    scan = read_scan(tmp_path / "a.ply", frame="scanner", sensor_at=(1.0, 2.0, 300.0))
    assert scan.sensors_mm is not None
    assert scan.sensors_mm.tolist() == [[1.0, 2.0, 300.0]]
    with pytest.raises(InputError, match="which of them saw each point"):
        read_scan(
            tmp_path / "a.ply", frame="scanner", sensor_at=np.array([[0, 0, 9.0], [1, 0, 9.0]])
        )


def test_a_pcd_viewpoint_is_read_in_either_frame(tmp_path: Path) -> None:
    image = perspective()
    view = f"0 0 {CAMERA_MM:g} 0 1 0 0"  # half a turn about x: the camera looks down
    for xyz, sensor in ((image.xyz, image.sensor_mm), (in_camera(image), np.zeros(3))):
        write_pcd_grid(tmp_path / "a.pcd", xyz, viewpoint=view)
        scan = read_scan(tmp_path / "a.pcd", frame="scanner")
        assert told(scan).kind == "perspective"
        assert scan.sensors_mm is not None
        assert np.allclose(scan.sensors_mm, sensor)


def test_noughts_of_an_organised_cloud_are_gaps(tmp_path: Path) -> None:
    image = perspective()
    write_pcd_grid(tmp_path / "a.pcd", np.nan_to_num(in_camera(image)))
    assert np.array_equal(told(read_scan(tmp_path / "a.pcd", frame="s")).index >= 0, image.seen)


def test_ptx_places_its_stations_and_tells_metres(tmp_path: Path) -> None:
    image = perspective()
    turn = trimesh.transformations.rotation_matrix(0.7, [0.0, 0.0, 1.0], point=None)
    turn[:3, 3] = (2.0, -1.0, 0.5)  # metres
    own = in_camera(image)
    text = ptx_station(own) + ptx_station(own, turn.T) + ptx_station(own, place_m="1 2 3")
    (tmp_path / "a.ptx").write_text(text)
    scan = read_scan(tmp_path / "a.ptx", frame="scanner")
    assert scan.grids is not None
    assert scan.sensors_mm is not None
    assert len(scan.grids) == 3
    assert np.allclose(scan.sensors_mm, [[0, 0, 0], [2000, -1000, 500], [1000, 2000, 3000]])
    n = int(image.seen.sum())
    moved = own[image.seen] @ turn[:3, :3].T + turn[:3, 3] * 1000
    assert np.allclose(scan.points_mm[scan.grids[1].index[image.seen]], moved, atol=1e-4)
    assert np.array_equal(scan.grids[1].index[image.seen], np.arange(n, 2 * n))
    assert np.array_equal(scan.sensor_index, np.repeat([0, 1, 2], n))  # type: ignore[arg-type]


def test_a_plys_unit_is_taken_at_its_word(tmp_path: Path) -> None:
    metres = in_camera(perspective()) / 1000
    write_ply_grid(tmp_path / "a.ply", metres, "ascii")
    write_ply_grid(tmp_path / "b.ply", metres, "ascii", header="comment unit m\n")
    write_ply_grid(tmp_path / "c.ply", metres, "ascii", header="comment unit furlong\n")
    plain, told_m = (read_scan(tmp_path / f"{k}.ply", frame="s") for k in "ab")
    assert np.allclose(plain.points_mm * 1000, told_m.points_mm)
    assert np.array_equal(plain.edge, told_m.edge)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="furlong"):
        read_scan(tmp_path / "c.ply", frame="s")


def test_a_sheet_of_rays_has_no_more_places_than_sheets() -> None:
    """regression: 1.3 TB for the places of a file with one damaged depth."""
    image = pushbroom()
    points, grid = image.xyz[image.seen], RangeGrid.of_seen(image.seen)
    seen = _pixels(points, grid, len(points))
    assert seen is not None
    (fit,) = _pushbrooms(seen, ViewpointOptions())
    assert fit.slits is not None
    points[3, 2] = 1e12
    found = _along_the_way(points, grid, points, fit.slits)
    assert len(found.sensors_mm) <= image.seen.shape[1]
    assert found.sensor_index.max() < len(found.sensors_mm)


def test_a_vertex_in_two_pixels_is_damage(tmp_path: Path) -> None:
    """regression: another vertex was then in none, and its sensor's number was left to chance."""
    path = tmp_path / "twice.ply"
    write_ply_grid(path, pushbroom().xyz, "ascii")
    path.write_text(re.sub(r"1 \d+((\n0)*\n)$", r"1 0\1", path.read_text()))
    with pytest.raises(InputError, match=r"two pixels .* name one vertex"):
        read_scan(path, frame="scanner")


def test_a_depth_map_stands_where_its_pose_says(tmp_path: Path) -> None:
    image = perspective()
    write_depth_map(tmp_path / "a.png", in_camera(image), count_mm=0.01)
    said = json.loads((tmp_path / "a.json").read_text())
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = CAMERA_MM
    (tmp_path / "a.json").write_text(json.dumps({**said, "pose": pose.tolist()}))
    scan = read_scan(tmp_path / "a.png", frame="build")
    assert scan.sensors_mm is not None
    assert np.allclose(scan.sensors_mm, image.sensor_mm)
    assert np.abs(scan.points_mm - image.xyz[image.seen]).max() < 0.006


CAMERAS = {
    "fx": ({"fx": None}, "cannot be understood"),
    "size": ({"width": 79}, "do not belong together"),
    "bent": ({"coeffs": [0.1, 0, 0, 0, 0]}, "distortion"),
    "scale": ({"depth_scale_mm": -1}, "depth scale"),
    "pose": ({"pose": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "rigid"),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_a_camera_that_cannot_be_is_refused(tmp_path: Path, name: str) -> None:
    write_depth_map(tmp_path / "a.png", in_camera(perspective()), count_mm=0.01)
    said = json.loads((tmp_path / "a.json").read_text())
    changed, words = CAMERAS[name]
    (tmp_path / "a.json").write_text(json.dumps({**said, **changed}))
    with pytest.raises(InputError, match=words):
        read_scan(tmp_path / "a.png", frame="s")


def test_a_png_needs_its_camera_and_a_tiff_without_one_is_a_height_map(tmp_path: Path) -> None:
    write_depth_map(tmp_path / "a.png", in_camera(perspective()), count_mm=0.01)
    write_depth_map(tmp_path / "b.tif", in_camera(perspective()), count_mm=0)
    (tmp_path / "a.json").unlink()
    with pytest.raises(InputError, match=r"a\.json beside it"):
        read_scan(tmp_path / "a.png", frame="s")
    (tmp_path / "b.json").write_text('{"layer": 12}')  # somebody else's
    scan = read_scan(tmp_path / "b.tif", frame="s", cell_mm=0.5)
    assert np.ptp(scan.points_mm[:, 0]) == pytest.approx(0.5 * (SHAPE[1] - 1))
    (tmp_path / "b.json").write_text("{broken")
    with pytest.raises(InputError, match=r"b\.json"):
        read_scan(tmp_path / "b.tif", frame="s", cell_mm=0.5)


def test_fractions_without_a_scale_are_not_guessed(tmp_path: Path) -> None:
    write_depth_map(tmp_path / "a.tif", in_camera(perspective()), count_mm=0)
    said = json.loads((tmp_path / "a.json").read_text())
    del said["depth_scale_mm"]
    (tmp_path / "a.json").write_text(json.dumps(said))
    with pytest.raises(InputError, match="depth_scale_mm"):
        read_scan(tmp_path / "a.tif", frame="s")


def test_depth_scales_of_open3d_and_realsense_are_the_same(tmp_path: Path) -> None:
    write_depth_map(tmp_path / "a.png", in_camera(perspective()), count_mm=0.01)
    said = json.loads((tmp_path / "a.json").read_text())
    del said["depth_scale_mm"]
    found = []
    for scale in (100_000, 1e-5):  # counts a metre, metres a count
        (tmp_path / "a.json").write_text(json.dumps({**said, "depth_scale": scale}))
        found.append(read_scan(tmp_path / "a.png", frame="s").points_mm)
    assert np.allclose(*found)


def test_moves_and_subsets_keep_what_stays_true(tmp_path: Path) -> None:
    write_ply_grid(tmp_path / "a.ply", pushbroom().xyz, "ascii")
    scan = read_scan(tmp_path / "a.ply", frame="scanner")
    assert scan.edge is not None
    moved = scan.moved(
        Transform.from_rotation_translation(
            "build", "scanner", rotation=np.eye(3), translation_mm=np.array([1.0, 2.0, 3.0])
        )
    )
    assert moved.grids == scan.grids
    assert np.array_equal(moved.edge, scan.edge)  # type: ignore[arg-type]
    keep = scan.points_mm[:, 0] > 0
    for chosen in (keep, np.flatnonzero(keep)):
        some = scan.subset(chosen)
        assert some.grids is None
        assert np.array_equal(some.edge, scan.edge[keep])  # type: ignore[arg-type]
        assert np.array_equal(some.sensor_index, scan.sensor_index[keep])  # type: ignore[index, arg-type]
    write_ply(scan, tmp_path / "b.ply")
    back = read_scan(tmp_path / "b.ply", frame="scanner")
    assert np.array_equal(back.edge, scan.edge)  # type: ignore[arg-type]
    assert np.array_equal(back.sensors_mm, scan.sensors_mm)  # type: ignore[arg-type]


def test_flags_and_grids_that_do_not_match_are_refused() -> None:
    scan = Scan(np.zeros((3, 3)), 0.03, "s")
    with pytest.raises(
        (InputError, BeartypeCallHintViolation), match="edge"
    ):  # shapes are checked before
        replace(scan, edge=np.zeros(2, np.uint8))
    with pytest.raises(InputError, match="names point 3"):
        replace(scan, grids=(RangeGrid(np.array([[0, 3]], np.int32)),))
    with pytest.raises(InputError, match="shape"):
        RangeGrid(np.array([[-2]], np.int32))


GRIDS = {
    "obj_info num_cols 80": ("obj_info num_cols 81", "damaged"),
    "obj_info num_rows 60\n": ("", "num_rows"),
    "\n1 4787\n": ("\n1 4788\n", "neither a gap"),
    "\n1 4786\n1 4787\n": ("\n", "cut off"),
    "\n1 4786\n": ("\n2 4786\n", "neither a gap|cut off"),
    "\n1 4785\n": ("\n1 4x85\n", "words"),
}


@pytest.mark.parametrize("old", GRIDS)
def test_a_grid_that_does_not_hold_is_refused(tmp_path: Path, old: str) -> None:
    write_ply_grid(tmp_path / "a.ply", in_camera(perspective()), "ascii")
    text = (tmp_path / "a.ply").read_text()
    assert text.count(old) == 1
    new, words = GRIDS[old]
    (tmp_path / "a.ply").write_text(text.replace(old, new))
    with pytest.raises(InputError, match=words):
        read_scan(tmp_path / "a.ply", frame="s")


@pytest.mark.parametrize("name", draws(BUNNY, "bun000", "bun090", "chin", "top3"))
def test_a_real_scanner_is_where_its_grid_says(data_dir: Path, name: str) -> None:
    """Cyberware's sheet of light moved along x, and looked from about 1.3 m before the bunny."""
    path = data_dir / "real" / "bunny" / f"{name}.ply"
    if not path.is_file():
        pytest.skip("the range images of the bunny are not here")
    scan = read_scan(path, frame="scanner")
    grid = told(scan)
    assert grid.kind == "pushbroom"
    assert grid.index.shape == (400, 512)
    assert scan.sensors_mm is not None
    assert scan.sensor_index is not None
    assert scan.edge is not None
    assert (np.abs(scan.sensors_mm[:, 2] - 1.35) < 0.2).all()
    # normals of the grid's own triangles: all of what is no edge faces the sensor
    i = grid.index
    whole = (i[:-1, :-1] >= 0) & (i[:-1, 1:] >= 0) & (i[1:, :-1] >= 0)
    corner = i[:-1, :-1][whole]
    a, b = (scan.points_mm[j[whole]] - scan.points_mm[corner] for j in (i[:-1, 1:], i[1:, :-1]))
    normal = np.cross(a, b)
    inner = scan.edge[corner] == 0
    faces = (normal * (scan.sensors_mm[scan.sensor_index[corner]] - scan.points_mm[corner])).sum(1)
    assert (faces[inner] > 0).mean() > 0.999
    assert 0.03 < (scan.edge > 0).mean() < 0.15


def test_rays_of_a_real_scanner_do_not_pass_through_the_part(data_dir: Path) -> None:
    """On the side that was found 1 % of the rays meet the merged bunny, on the other 99 %."""
    folder = data_dir / "real" / "bunny"
    if not (folder / "bun_zipper.ply").is_file():
        pytest.skip("the range images of the bunny are not here")
    scan = read_scan(folder / "bun000.ply", frame="scanner")  # it lies in the merged one's frame
    assert scan.sensors_mm is not None
    assert scan.sensor_index is not None
    some = np.arange(0, len(scan), 20)
    points, sensors = scan.points_mm[some], scan.sensors_mm[scan.sensor_index[some]]
    body = trimesh.load(folder / "bun_zipper.ply", force="mesh")
    body = trimesh.Trimesh(body.vertices * 1000, body.faces, process=False)
    blocked = []
    for sensor in (sensors, 2 * points.mean(axis=0) - sensors):
        way = sensor - points
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        blocked.append(body.ray.intersects_any((points + 1e-3 * way) * 1000, way).mean())
    assert blocked[0] < 0.03
    assert blocked[1] > 0.9
