"""What nobody saw, against the truth: neither less than that is unknown, nor more."""

from __future__ import annotations

import numpy as np
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from amrepair.merge.fuse import coverage_of
from amrepair.merge.options import DEFAULT_FUSE

SPACING_MM = 0.4
EDGE_MM = 0.25  # of the meshes' triangles, at most
# A disc of three spacings reaches so far past a random border by chance: 13 points would lie in
# that cap of it, and the chance that none does is 2 in a million.
BEYOND_MM = 2.5 * SPACING_MM
REACH_MM = DEFAULT_FUSE.seen_spacings * SPACING_MM


def scattered(mesh: trimesh.Trimesh, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random points of a surface, `SPACING_MM` apart in the mean, and its normals there."""
    count = int(mesh.area / SPACING_MM**2)
    points, face = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.asarray(points), np.asarray(mesh.face_normals)[face]


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 1000), st.floats(1.5, 4.5), st.floats(-1.0, 1.0), st.floats(0.0, 6.28))
def test_a_cap_of_a_ball(seed: int, radius_mm: float, height: float, turn: float) -> None:
    ball = trimesh.creation.icosphere(5, 6.0)
    level = np.sqrt(1.0 - height**2)
    middle_mm = 6.0 * np.array([level * np.cos(turn), level * np.sin(turn), height])

    def inside_mm(points: np.ndarray) -> np.ndarray:
        """How far within the border of what nobody saw."""
        return np.asarray(radius_mm - np.linalg.norm(points - middle_mm, axis=1))

    points, normals = scattered(ball, seed)
    seen = inside_mm(points) < 0
    coverage = coverage_of(ball, points[seen], normals[seen], REACH_MM)
    asked, outward = scattered(ball, seed + 1)
    unknown = coverage.unknown_at(asked, np.zeros(len(asked)), outward)
    depth_mm = inside_mm(asked)
    assert unknown[depth_mm > 2.0 * EDGE_MM].all()
    assert not unknown[depth_mm < -BEYOND_MM].any()
    # no point that was seen is unknown, but for how coarse the pieces are
    assert unknown[depth_mm < 0].sum() * SPACING_MM**2 < 2 * np.pi * radius_mm * SPACING_MM
    area_mm2 = np.pi * radius_mm**2  # of a cap, by its chord
    assert abs(coverage.unseen_mm2 - area_mm2) < 2 * np.pi * radius_mm * SPACING_MM


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 1000), st.floats(0.3, 2.0), st.booleans())
def test_the_other_side_of_a_wall_says_nothing_of_this_one(
    seed: int, thick_mm: float, flipped: bool
) -> None:
    wall = trimesh.creation.box(bounds=[(0, 0, 0), (10, 8, thick_mm)])
    vertices, faces = trimesh.remesh.subdivide_to_size(wall.vertices, wall.faces, EDGE_MM)
    wall = trimesh.Trimesh(vertices, faces)

    def inside_mm(points: np.ndarray) -> np.ndarray:
        """How far within the half of the upper side that nobody saw; −inf elsewhere."""
        return np.where(points[:, 2] > thick_mm - 1e-6, points[:, 0] - 5.0, -np.inf)

    points, normals = scattered(wall, seed)
    seen = inside_mm(points) < 0
    points, normals = points[seen], normals[seen]
    if flipped:  # a cloud's own normals may be the wrong way round
        normals = np.where(np.arange(len(normals))[:, None] % 7 == 0, -normals, normals)
    coverage = coverage_of(wall, points, normals, REACH_MM)
    asked, outward = scattered(wall, seed + 1)
    unknown = coverage.unknown_at(asked, np.zeros(len(asked)), outward)
    depth_mm = inside_mm(asked)
    # a disc at the rim has half its area on this side
    off_rim = (np.abs(asked[:, :2] - (5.0, 4.0)) < (5.0 - REACH_MM, 4.0 - REACH_MM)).all(axis=1)
    assert unknown[off_rim & (depth_mm > 2.0 * EDGE_MM)].all()
    assert not unknown[off_rim & (depth_mm < -BEYOND_MM)].any()


def test_what_lies_off_farther_than_the_guess_is_near_is_unknown() -> None:
    plate = trimesh.creation.box(bounds=[(0, 0, 0), (20, 12, 5)])
    vertices, faces = trimesh.remesh.subdivide_to_size(plate.vertices, plate.faces, EDGE_MM)
    plate = trimesh.Trimesh(vertices, faces)
    points, normals = scattered(plate, 0)
    seen = ~((points[:, 2] > 5.0 - 1e-6) & (points[:, 0] > 10.0))
    coverage = coverage_of(plate, points[seen], normals[seen], REACH_MM)
    below_mm = np.array([0.0, 0.5, 0.5, 3.0, 3.0])
    x_mm = np.array([8.0, 9.8, 8.0, 8.0, 5.0])
    asked = np.column_stack([x_mm, np.full(5, 6.0), 5.0 - below_mm])
    outward = np.tile([0.0, 0.0, 1.0], (5, 1))
    unknown = coverage.unknown_at(asked, -below_mm, outward)
    assert unknown.tolist() == [False, True, False, True, False]
