"""Mesh files as they come: what other slicers take is taken, and nothing of it is lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from gcode.errors import InputError
from gcode.solids import read_solid, read_triangles, weld


def test_bodies_that_touch_along_an_edge_stay_apart(tmp_path: Path) -> None:
    """Welding them makes an edge of four faces, which bounds nothing."""
    one, other = trimesh.creation.box((2.0, 2.0, 2.0)), trimesh.creation.box((2.0, 2.0, 2.0))
    other.apply_translation((2.0, 2.0, 0.0))
    path = tmp_path / "touching.3mf"
    trimesh.util.concatenate([one, other]).export(path)
    assert read_solid(path).volume() == pytest.approx(16.0)


def test_a_sliver_without_area_holds_a_surface_together(tmp_path: Path) -> None:
    """Dropped as degenerate, it left a crack."""
    box = trimesh.creation.box((4.0, 4.0, 4.0))
    faces = np.asarray(box.faces).tolist()
    a, b, c = faces.pop(0)
    middle = len(box.vertices)
    vertices = np.vstack([box.vertices, (box.vertices[a] + box.vertices[b]) / 2])
    faces += [[a, middle, c], [middle, b, c], [a, b, middle]]
    path = tmp_path / "sliver.stl"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    assert read_solid(path).volume() == pytest.approx(64.0)


def test_bodies_that_overlap_count_once(tmp_path: Path) -> None:
    one, other = trimesh.creation.box((2.0, 2.0, 2.0)), trimesh.creation.box((2.0, 2.0, 2.0))
    other.apply_translation((1.0, 0.0, 0.0))
    path = tmp_path / "overlapping.stl"
    trimesh.util.concatenate([one, other]).export(path)
    assert read_solid(path).volume() == pytest.approx(12.0)


def test_a_hole_is_refused(tmp_path: Path) -> None:
    box = trimesh.creation.box((4.0, 4.0, 4.0))
    path = tmp_path / "open.stl"
    trimesh.Trimesh(box.vertices, box.faces[:-1], process=False).export(path)
    with pytest.raises(InputError, match="no closed surface"):
        read_solid(path)


@given(
    places=st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=3, max_size=30),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=50, deadline=None)
def test_welding_joins_what_trimesh_joins(places: list[tuple[int, int, int]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid = np.array(places, dtype=np.float64) / 3.0
    vertices = np.repeat(grid, 2, axis=0) + rng.choice([0.0, 1e-12, -0.0], (2 * len(grid), 3))
    faces = rng.integers(0, len(vertices), (len(grid), 3))
    ours, ours_faces = weld(vertices, faces, 8)
    peer = trimesh.Trimesh(vertices, faces, process=False)
    peer.merge_vertices(merge_tex=True, merge_norm=True)
    np.testing.assert_allclose(ours[ours_faces], vertices[faces], atol=1e-11)
    assert len(ours) == len(np.unique(np.asarray(peer.faces)))
    assert (
        ours_faces == _by_first_use(np.asarray(peer.faces), np.asarray(peer.vertices), ours)
    ).all()


def _by_first_use(faces: np.ndarray, vertices: np.ndarray, ours: np.ndarray) -> np.ndarray:
    """The peer's faces, with our numbers of the same places."""
    number = {tuple(np.round(v, 8) + 0.0): k for k, v in enumerate(ours)}
    return np.array([[number[tuple(np.round(vertices[v], 8) + 0.0)] for v in f] for f in faces])


def test_places_of_one_slot_stay_two() -> None:
    """So many that a table of any size has several in each slot."""
    rng = np.random.default_rng(0)
    vertices = rng.integers(-40, 40, (50_000, 3)).astype(np.float64)
    faces = np.arange(len(vertices) // 3 * 3).reshape(-1, 3)
    joined, new = weld(vertices, faces, 8)
    np.testing.assert_array_equal(joined[new], vertices[faces])
    assert len(joined) == len(np.unique(vertices[faces.ravel()], axis=0))


def test_a_binary_stl_file_is_read_as_trimesh_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(2, 3.0).export(path)
    vertices, faces = read_triangles(path)
    peer = trimesh.load_mesh(path, process=False)
    np.testing.assert_array_equal(vertices[faces], peer.triangles)


def test_an_stl_file_of_text_is_read(tmp_path: Path) -> None:
    path = tmp_path / "box.stl"
    trimesh.creation.box((2.0, 3.0, 4.0)).export(path, file_type="stl_ascii")
    assert read_solid(path).volume() == pytest.approx(24.0)
