"""Calibration: the pose is found from any turn, its residual is stated, and doubt is refused."""

from __future__ import annotations

import json
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
import trimesh

from amrepair.errors import AlignmentError, InputError
from amrepair.frames import Transform, rotation_from_vector
from amrepair.loop.calibrate import (
    TARGET_MM,
    PoseCalibration,
    calibrate,
    read_calibration,
    target_solid,
    write_calibration,
)
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from gcode.profiles import load_printer

PRINTER = load_printer("prusa_mk3s")


def template_of(solid: m3.Manifold) -> MeshSdf:
    mesh = solid.to_mesh64()
    return MeshSdf.from_mesh(
        trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))
    )


def points_of(solid: m3.Manifold, rng: np.random.Generator) -> np.ndarray:
    """What is seen from above: the target's top and sides, and the bed around."""
    mesh = solid.to_mesh64()
    made = trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))
    points, faces = trimesh.sample.sample_surface(made, 25_000, seed=int(rng.integers(1000)))
    points = np.asarray(points)[np.asarray(made.face_normals)[faces][:, 2] > -0.5]
    x0, y0, _, x1, y1, _ = solid.bounding_box()
    bed = np.column_stack(
        [rng.uniform(x0 - 20, x1 + 20, 30_000), rng.uniform(y0 - 20, y1 + 20, 30_000),
         np.zeros(30_000)]
    )  # fmt: skip
    free = np.ones(len(bed), bool)
    for piece in solid.decompose():
        for box in (piece.bounding_box(),):
            within = (bed[:, 0] > box[0]) & (bed[:, 0] < box[3])
            free &= ~(within & (bed[:, 1] > box[1]) & (bed[:, 1] < box[4]))
    return np.concatenate([points, bed[free]])


def pose_of(rng: np.random.Generator) -> Transform:
    """Any turn about the vertical, a tilt of up to 20°, far away."""
    tilt = rng.normal(size=3)
    tilt *= rng.uniform(0.0, 0.35) / np.linalg.norm(tilt)
    rotation = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    return Transform.from_rotation_translation(
        "build", "scanner", rotation=rotation @ rotation_from_vector(tilt),
        translation_mm=rng.uniform(-200.0, 200.0, 3),
    )  # fmt: skip


@pytest.mark.parametrize(("seed", "height_mm"), [(0, TARGET_MM), (1, 0.2)])
def test_the_pose_is_found_from_any_turn(seed: int, height_mm: float) -> None:
    rng = np.random.default_rng(seed)
    solid = target_solid(PRINTER).scale((1.0, 1.0, height_mm / TARGET_MM))
    truth = pose_of(rng)
    points = truth.inverse().apply(points_of(solid, rng))
    noisy = points + rng.normal(scale=0.03, size=points.shape)
    found = calibrate(Scan(noisy, 0.03, "scanner"), template_of(solid))
    corners = np.array([[50.0, 50.0, 0.0], [200.0, 50.0, 0.0], [50.0, 160.0, 0.0]])
    off = found.build_from_scanner.apply(truth.inverse().apply(corners)) - corners
    assert np.abs(off).max() < 0.1
    assert 0.0 < found.residual_mm < 0.06
    assert found.bed_mm == pytest.approx(0.03, abs=0.01)
    assert found.runner_up > 1.5


def test_what_looks_the_same_when_turned_is_refused() -> None:
    rng = np.random.default_rng(2)
    square = m3.Manifold.cube((60.0, 60.0, 1.0)).translate((80.0, 70.0, 0.0))
    points = pose_of(rng).inverse().apply(points_of(square, rng))
    with pytest.raises(AlignmentError, match="another turn"):
        calibrate(Scan(points, 0.03, "scanner"), template_of(square))


def test_another_target_is_refused_with_its_residual() -> None:
    rng = np.random.default_rng(3)
    other = target_solid(PRINTER).scale((1.08, 0.95, 1.0))
    points = pose_of(rng).inverse().apply(points_of(other, rng))
    with pytest.raises(AlignmentError, match=r"mm off where it should be|fits .* no turn"):
        calibrate(Scan(points, 0.03, "scanner"), template_of(target_solid(PRINTER)))


def test_a_bare_bed_and_a_cloud_without_a_bed_are_refused() -> None:
    rng = np.random.default_rng(4)
    bed = np.column_stack([rng.uniform(0, 200, (9000, 2)), rng.normal(scale=0.02, size=9000)])
    target = template_of(target_solid(PRINTER))
    with pytest.raises(AlignmentError, match="above the bed"):
        calibrate(Scan(bed, 0.02, "scanner"), target)
    with pytest.raises(AlignmentError, match="no plane"):
        calibrate(Scan(rng.uniform(0, 90, (5000, 3)), 0.02, "scanner"), target)


def test_the_file_is_what_the_loop_reads(tmp_path: Path) -> None:
    pose = pose_of(np.random.default_rng(5))
    path = tmp_path / "calibration.json"
    write_calibration(path, PoseCalibration(pose, 0.04, 0.03, 2.0, 500), {"printer": "x"})
    found, unit = read_calibration(path)
    assert np.abs(found.matrix - pose.matrix).max() < 1e-12
    assert unit is None
    assert json.loads(path.read_text())["residual_mm"] == 0.04
    found, unit = read_calibration(None)
    assert np.array_equal(found.matrix, np.eye(4))
    assert unit is None
    said = json.loads(path.read_text())
    path.write_text(json.dumps(said | {"scan_unit": "m"}))
    assert read_calibration(path)[1] == "m"
    path.write_text(json.dumps(said | {"scan_unit": "ell"}))
    with pytest.raises(InputError, match="scans are in 'ell'; known are mm, cm, m"):
        read_calibration(path)
    path.write_text("no JSON")
    with pytest.raises(InputError, match="cannot be read"):
        read_calibration(path)
    said["build_from_scanner"][0][0] *= 1.1
    path.write_text(json.dumps(said))
    with pytest.raises(InputError, match="no rigid motion"):
        read_calibration(path)
