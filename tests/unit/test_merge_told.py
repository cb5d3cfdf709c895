"""Poses that files and turntables tell, and what is made of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from amrepair.errors import InputError
from amrepair.frames import moved, rotation_from_vector
from amrepair.merge.place import place
from amrepair.merge.told import _about, of_views, read_poses
from amrepair.merge.views import View
from amrepair.scans import Scan
from tests.analytic import box, cylinder, sample_surface, union

BODY = union(box((0, 0, 0), (40, 25, 8)), cylinder((30, 15, 4), 6, 14))
SIGMA_MM = 0.03


def pose_of(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_vector(rng.normal(size=3)), rng.normal(0, 40, 3)
    return pose


def scan_of(name: str, view_from_part: np.ndarray, seed: int, sigma_mm: float = SIGMA_MM) -> Scan:
    points, _ = sample_surface(BODY.body, 0.45, seed=seed)
    points = points + np.random.default_rng(seed).normal(0.0, sigma_mm, points.shape)
    return Scan(moved(points, view_from_part), sigma_mm, "scanner", source=name)


@pytest.mark.parametrize("kind", ["conf", "aln", "json", "views"])
def test_every_kind_of_file_tells_the_same(kind: str, tmp_path: Path) -> None:
    poses = {f"v{k}.ply": pose_of(k) for k in range(3)}
    path = tmp_path / f"poses.{kind if kind in {'conf', 'aln'} else 'json'}"
    if kind == "conf":
        lines = ["camera 0 0 0  0 0 0 1"]
        for name, pose in poses.items():
            turn = Rotation.from_matrix(pose[:3, :3].T).as_quat()
            lines.append(" ".join(["bmesh", name, *map(repr, map(float, [*pose[:3, 3], *turn]))]))
        path.write_text("\n".join(lines))
    elif kind == "aln":
        rows = {
            n: "\n".join(" ".join(map(repr, map(float, r))) for r in p) for n, p in poses.items()
        }
        said = "\n".join(f"{name}\n#\n{text}" for name, text in rows.items())
        path.write_text(f"{len(poses)}\n{said}\n0\n")
    else:
        told = {name: pose.tolist() for name, pose in poses.items()}
        path.write_text(json.dumps({"views": told} if kind == "views" else told))
    found = read_poses(path)
    assert set(found) == set(poses)
    for name, pose in poses.items():
        assert found[name] == pytest.approx(pose, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("p.txt", "", "poses are read from"),
        ("p.json", "{", "is no file of poses"),
        ("p.json", "{}", "tells no pose"),
        ("p.json", '{"a": [1, 2]}', "is no file of poses"),
        ("p.json", json.dumps({"a": np.diag([2.0, 1, 1, 1]).tolist()}), "no rigid motion"),
        ("p.json", json.dumps({"a": np.diag([-1.0, 1, 1, 1]).tolist()}), "no rigid motion"),
        ("p.conf", "bmesh a x 0 0 0 0 0 1", "is no file of poses"),
    ],
)
def test_bad_files_of_poses_end_in_a_sentence(
    tmp_path: Path, name: str, text: str, said: str
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=said):
        read_poses(tmp_path / name)


@pytest.mark.slow
def test_a_rotation_written_the_other_way_round_is_turned() -> None:
    """As the Stanford bunny's file has it of two views: the views decide, also on the unit."""
    rng = np.random.default_rng(0)
    poses = [np.eye(4), pose_of(1), pose_of(2)]
    views = [View.of(scan_of(f"v{k}.ply", p, k), rng) for k, p in enumerate(poses)]
    told = {f"v{k}.ply": np.linalg.inv(p) for k, p in enumerate(poses)}
    for pose in told.values():
        pose[:3, 3] /= 1000.0
    told["v2.ply"][:3, :3] = told["v2.ply"][:3, :3].T.copy()
    placed = of_views(told, views, 1000.0)
    for k, pose in enumerate(poses):
        assert placed[k] == pytest.approx(np.linalg.inv(pose), abs=1e-9)


@pytest.mark.slow
def test_a_told_pose_that_is_wrong_is_found_anew() -> None:
    rng = np.random.default_rng(0)
    poses = [np.eye(4), pose_of(1), pose_of(2)]
    views = [View.of(scan_of(f"v{k}.ply", p, k), rng) for k, p in enumerate(poses)]
    told = {f"v{k}.ply": np.linalg.inv(p) for k, p in enumerate(poses)}
    told["v2.ply"] = pose_of(9)
    found = place(views, rng, told=told)
    assert set(found.poses) == {0, 1, 2}
    for k, pose in enumerate(poses):
        there = moved(views[k].thin.points_mm, found.poses[k])
        true = moved(views[k].thin.points_mm, np.linalg.inv(pose))
        assert np.abs(there - true).max() < 0.05


def test_turns_about_an_axis_come_from_one_pair() -> None:
    centre, axis = np.array([30.0, -12.0, 5.0]), np.array([0.1, 0.2, 1.0])
    axis = axis / np.linalg.norm(axis)
    pair = np.eye(4)
    pair[:3, :3] = rotation_from_vector(np.deg2rad(40.0) * axis)
    pair[:3, 3] = centre - pair[:3, :3] @ centre
    placed = _about(pair, np.deg2rad(40.0), 9)
    assert placed[1] == pytest.approx(pair, abs=1e-9)
    # nine turns of 40° come round
    assert placed[8] @ pair == pytest.approx(np.eye(4), abs=1e-9)


@pytest.mark.slow
def test_a_depth_camera_with_a_millimetre_of_noise_finds_its_views() -> None:
    """Limits are in units of the noise: 1 mm on a part of 120 mm, as 0.03 mm on one of 40 mm."""
    rng = np.random.default_rng(0)
    views = []
    poses = [np.eye(4), pose_of(3)]
    for k, pose in enumerate(poses):
        points, _ = sample_surface(BODY.body, 0.35, seed=k)
        points = 3.0 * points
        points += np.random.default_rng(k).normal(0.0, 1.0, points.shape)
        views.append(View.of(Scan(moved(points, pose), 1.0, "scanner", source=f"v{k}"), rng))
    assert [view.sigma_mm for view in views] == pytest.approx([1.0, 1.0], rel=0.3)
    found = place(views, rng)
    assert set(found.poses) == {0, 1}
    corners = 3.0 * np.array([[0, 0, 0], [40, 25, 8], [0, 25, 0], [40, 0, 8]], float)
    # of thousands of points with 1 mm of noise each
    assert np.abs(moved(corners, found.poses[1] @ poses[1]) - corners).max() < 0.5
