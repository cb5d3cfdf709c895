"""Level sets against analytic truth: volume, closedness, distance to the surface."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from amrepair.errors import TemplateError
from amrepair.template.extract import extract_mesh
from amrepair.template.mesh_sdf import MeshSdf


@pytest.fixture(scope="module")
def ball() -> MeshSdf:
    return MeshSdf.from_mesh(trimesh.creation.icosphere(subdivisions=4, radius=10.0))


@pytest.mark.parametrize("level_mm", [-0.5, 0.0, 0.5])
def test_a_level_of_a_ball_is_a_ball(ball: MeshSdf, level_mm: float) -> None:
    mesh = extract_mesh(ball, 0.4, level_mm=level_mm)
    truth_mm3 = 4 / 3 * np.pi * (10.0 + level_mm) ** 3
    assert mesh.is_watertight
    # chords of 0.4 mm voxels and of the icosphere itself each lose about 0.1 %
    assert mesh.volume == pytest.approx(truth_mm3, rel=0.005)
    radius_mm = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radius_mm - 10.0 - level_mm).max() < 0.03


def test_a_layer_is_cut_flat(ball: MeshSdf) -> None:
    mesh = extract_mesh(ball.below_z(2.0), 0.4)
    assert mesh.is_watertight
    assert mesh.vertices[:, 2].max() == pytest.approx(2.0, abs=0.05)


def test_an_empty_level_is_refused(ball: MeshSdf) -> None:
    with pytest.raises(TemplateError, match="no surface at level -50"):
        extract_mesh(ball, 0.5, level_mm=-50.0)
