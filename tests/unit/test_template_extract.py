"""Level sets against analytic truth: volume, closedness, distance to the surface."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest
import trimesh

from amrepair.errors import TemplateError
from amrepair.template.cut import CutTemplate
from amrepair.template.extract import extract_mesh
from amrepair.template.mesh_sdf import MeshSdf
from amrepair.template.port import Template
from gcode.solids import as_manifold, is_valid
from tests.draws import draws


@pytest.fixture(scope="module")
def ball() -> MeshSdf:
    return MeshSdf.from_mesh(trimesh.creation.icosphere(subdivisions=4, radius=10.0))


@pytest.mark.parametrize("level_mm", draws([-0.5, 0.0, 0.5], 0.5))
def test_a_level_of_a_ball_is_a_ball(ball: MeshSdf, level_mm: float) -> None:
    mesh = extract_mesh(ball, 0.4, level_mm=level_mm)
    truth_mm3 = 4 / 3 * np.pi * (10.0 + level_mm) ** 3
    assert mesh.is_watertight
    # chords of 0.4 mm voxels and of the icosphere itself each lose about 0.1 %
    assert mesh.volume == pytest.approx(truth_mm3, rel=0.005)
    radius_mm = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radius_mm - 10.0 - level_mm).max() < 0.03


@pytest.mark.parametrize("voxel_mm", [0.4, 0.5])
@pytest.mark.parametrize(
    "shape",
    [trimesh.creation.box((20.0, 16.0, 8.0)), trimesh.creation.cylinder(6.0, 12.0)],
    ids=["box", "cylinder"],
)
def test_a_surface_on_the_grid_is_closed(shape: trimesh.Trimesh, voxel_mm: float) -> None:
    exact = MeshSdf.from_mesh(shape)  # its faces lie on nodes of the grid
    made = extract_mesh(exact, voxel_mm)
    solid = as_manifold(np.asarray(made.vertices), np.asarray(made.faces))
    assert is_valid(solid)
    assert solid.genus() == 0
    # edges are cut off by a chord of a voxel
    assert solid.volume() == pytest.approx(float(shape.volume), rel=0.01)


@pytest.mark.parametrize(
    ("voxel_mm", "level_mm", "said"), [(0.5, np.nan, "level is nan"), (np.nan, 0.0, "voxel is nan")]
)
def test_what_is_no_number_is_refused(voxel_mm: float, level_mm: float, said: str) -> None:
    ball = MeshSdf.from_mesh(trimesh.creation.icosphere(2, 5.0))
    with pytest.raises(TemplateError, match=said):
        extract_mesh(ball, voxel_mm, level_mm=level_mm)


class Leaking:
    """A ball that says it is smaller than it is, as a network does that was taught too little."""

    bounds_mm = np.array([[-5.0, -5.0, -3.0], [5.0, 5.0, 5.0]])

    def distance(self, points_mm: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(points_mm, axis=1) - 5.0)


def test_what_reaches_beyond_the_box_is_closed_there() -> None:
    # regression: a shortened network's surface left the part's box and no mesh of it was closed
    made = extract_mesh(cast(Template, Leaking()), 0.5)
    solid = as_manifold(np.asarray(made.vertices), np.asarray(made.faces))
    assert is_valid(solid)
    # the ball but for a cap 2 mm high, of which the grid's margin shows two voxels and a half
    low_mm = made.vertices[:, 2].min()
    assert -4.0 <= low_mm <= -3.0
    cap_mm = 5.0 + low_mm
    truth_mm3 = 4 / 3 * np.pi * 5.0**3 - np.pi * cap_mm**2 * (5.0 - cap_mm / 3)
    assert solid.volume() == pytest.approx(truth_mm3, rel=0.02)  # chords of a voxel


def test_a_layer_is_cut_flat(ball: MeshSdf) -> None:
    mesh = extract_mesh(CutTemplate(ball, 2.0), 0.4)
    assert mesh.is_watertight
    assert mesh.vertices[:, 2].max() == pytest.approx(2.0, abs=0.05)


def test_an_empty_level_is_refused(ball: MeshSdf) -> None:
    with pytest.raises(TemplateError, match="no surface at level -50"):
        extract_mesh(ball, 0.5, level_mm=-50.0)
