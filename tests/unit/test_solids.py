"""Mesh files as they come: what other slicers take is taken, and nothing of it is lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from gcode.errors import InputError
from gcode.solids import read_solid


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
