"""Closed meshes against manifold3d: the same solids, cut in the same places."""

from __future__ import annotations

import time
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from gcode import meshes_kernels as kernels
from gcode.meshes import Cuts, bodies_apart, closed_mesh, mesh_of
from gcode.solids import _as_it_is, read_closed, read_solid

Solid = manifold3d.Manifold


def some_solid(seed: int) -> manifold3d.Manifold:
    """Blocks and balls put together and taken away, aslant."""
    rng = np.random.default_rng(seed)
    solid = Solid.sphere(6.0, 24)
    for _ in range(4):
        tool = Solid.cube(tuple(rng.uniform(2.0, 7.0, 3)), True)
        tool = tool.rotate(tuple(rng.uniform(0.0, 90.0, 3))).translate(tuple(rng.uniform(-5, 5, 3)))
        solid = solid + tool if rng.random() < 0.5 else solid - tool
    return solid


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.02, 0.98))
@settings(max_examples=40, deadline=None)
def test_cuts_are_manifold3d_s(seed: int, share: float) -> None:
    solid = some_solid(seed)
    z0, z1 = solid.bounding_box()[2], solid.bounding_box()[5]
    corners = mesh_of(solid)[0][:, 2]
    # between corners, and at the height of one: what touches a plane from above is not cut by it
    for height in (z0 + share * (z1 - z0), float(corners[int(share * len(corners))])):
        cuts = Cuts.of(closed_mesh(solid), np.array([height]))
        own, theirs = cuts.at(0), solid.slice(height)
        assert own.area() == pytest.approx(theirs.area(), abs=1e-9)
        assert (own - theirs).area() + (theirs - own).area() == pytest.approx(0.0, abs=1e-6)
        assert cuts.at(0).area() == own.area()  # asked again


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_volume_and_box_are_manifold3d_s(seed: int) -> None:
    solid = some_solid(seed)
    mesh = closed_mesh(solid).translate((1.0, 2.0, 3.0))
    assert mesh.volume() == pytest.approx(solid.volume(), rel=1e-12)
    assert mesh.bounding_box() == solid.translate((1.0, 2.0, 3.0)).bounding_box()


@given(seed=st.integers(0, 2**32 - 1), lost=st.integers(0, 2))
@settings(max_examples=30, deadline=None)
def test_half_edges_meet_their_opposites(seed: int, lost: int) -> None:
    """Every one the one that runs the other way; where a face is gone, none is closed."""
    faces = mesh_of(some_solid(seed))[1].astype(np.int32)
    rng = np.random.default_rng(seed)
    faces = np.roll(rng.permutation(faces), int(rng.integers(3)), axis=1)[lost:].copy()
    across, shared = kernels.paired(faces)
    if lost:
        assert shared == -1
        return
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    assert shared >= 0
    assert (across[across] == np.arange(len(across))).all()
    assert (start[across] == end).all()


@pytest.mark.parametrize("seed", range(4))
def test_pairs_of_two_are_those_that_chains_find(seed: int) -> None:
    faces = mesh_of(some_solid(seed))[1].astype(np.int32)
    faces = np.ascontiguousarray(np.random.default_rng(seed).permutation(faces))
    across, shared = kernels.paired(faces)
    expected, also_shared = kernels._paired_in_order(faces)
    assert shared == also_shared
    assert (across == expected).all()


@pytest.mark.parametrize("turned", ["one face", "a corner twice"])
def test_what_is_not_oriented_is_not_closed(turned: str) -> None:
    faces = mesh_of(Solid.cube((1.0, 1.0, 1.0)))[1].astype(np.int32).copy()
    if turned == "one face":
        faces[3] = faces[3][::-1]
    else:
        faces[3, 1] = faces[3, 0]
    assert kernels.paired(faces)[1] == -1


def test_a_fan_of_many_faces_is_paired_at_once() -> None:
    """Time in proportion to faces, wherever they meet: 200,000 round one corner."""
    n = 100_000
    round_it = np.arange(n, dtype=np.int32)
    after = np.roll(round_it, -1)
    up = np.stack([round_it, after, np.full(n, n, np.int32)], axis=1)
    down = np.stack([after, round_it, np.full(n, n + 1, np.int32)], axis=1)
    assert kernels.paired(np.concatenate([up, down]))[1] == 0


@pytest.mark.parametrize("apart", [True, False])
def test_an_edge_of_many_faces_is_paired_at_once(apart: bool) -> None:
    """regression: 80,000 faces round one edge, a file of 4 MB, took 10 s; now 0.02 s."""
    n = 40_000
    one, other = np.array([[0, 1, 2]], np.int32), np.array([[0, 2, 1]], np.int32)
    pairs = [one.repeat(n, axis=0), other.repeat(n, axis=0)]
    faces = np.concatenate(pairs) if apart else np.stack(pairs, axis=1).reshape(-1, 3)
    begun = time.process_time()
    assert kernels.paired(faces)[1] == 3 * (n - 1)
    assert time.process_time() - begun < 2.0


def body(size_mm: float, at_mm: float) -> trimesh.Trimesh:
    box = trimesh.creation.box((size_mm,) * 3)
    box.apply_translation((at_mm, 0.0, 0.0))
    return box


@pytest.mark.parametrize(
    ("bodies", "simple"),
    [
        ([body(2.0, 0.0)], True),
        ([body(2.0, 0.0), body(2.0, 5.0)], True),
        ([body(2.0, 0.0), body(2.0, 1.0)], False),  # overlap
        ([body(4.0, 0.0), body(2.0, 0.0)], False),  # one within the other, both matter
        ([body(2.0, 0.0), trimesh.Trimesh(body(2.0, 0.0).vertices + 2.0, body(2.0, 0.0).faces)],
         False),  # touch in a corner
    ],
)  # fmt: skip
def test_a_file_means_the_same_read_either_way(
    bodies: list[trimesh.Trimesh], simple: bool, tmp_path: Path
) -> None:
    path = tmp_path / "bodies.stl"
    trimesh.util.concatenate(bodies).export(path)
    assert (_as_it_is(path) is not None) == simple
    mesh, solid = read_closed(path), read_solid(path)
    assert mesh.volume() == pytest.approx(solid.volume(), rel=1e-9)
    for height in (-0.3, 0.7):
        own = Cuts.of(mesh, np.array([height])).at(0)
        assert own.area() == pytest.approx(solid.slice(height).area(), abs=1e-9)


def test_a_cavity_is_no_second_body() -> None:
    outer, inner = body(4.0, 0.0), body(2.0, 0.0)
    inner.invert()
    both = trimesh.util.concatenate([outer, inner])
    mesh = bodies_apart(np.asarray(both.vertices), np.asarray(both.faces))
    assert mesh is not None
    assert mesh.volume() == pytest.approx(64.0 - 8.0)
    assert Cuts.of(mesh, np.array([0.5])).at(0).area() == pytest.approx(16.0 - 4.0)


def test_pieces_of_a_large_file_share_their_corners(tmp_path: Path) -> None:
    """More triangles than are read at a time, and more places than the first table holds."""
    mesh = trimesh.creation.icosphere(7, 20.0)  # 327,680
    path = tmp_path / "ball.stl"
    mesh.export(path)
    read = _as_it_is(path)
    assert read is not None
    assert len(read.faces) == len(mesh.faces)
    assert len(read.vertices_mm) == len(mesh.vertices)
    assert np.allclose(read.vertices_mm[read.faces], mesh.triangles, atol=1e-5)
