"""Delaunay triangles against qhull's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from gcode.slicing.delaunay_kernels import triangles
from gcode.slicing.medial_kernels import move_aside


def circles_of(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Radii of the circles through triangles."""
    a, b, c = (points[corners[:, k]] for k in range(3))
    u, v = b - a, c - a
    twice = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    sides = np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1) * np.linalg.norm(u - v, axis=1)
    return np.asarray(sides / np.maximum(2.0 * twice, 1e-300))


def as_qhull_has_them(points: np.ndarray) -> None:
    """But for those along the hull whose circles are larger than all points' extent."""
    own, across = triangles(points)
    extent = float(np.ptp(points, axis=0).max())
    theirs = Delaunay(points).simplices
    kept = {frozenset(t) for t in own[circles_of(points, own) < extent].tolist()}
    assert kept == {frozenset(t) for t in theirs[circles_of(points, theirs) < extent].tolist()}
    for t, (corners, others) in enumerate(zip(own.tolist(), across.tolist(), strict=True)):
        for k, other in enumerate(others):
            if other >= 0:
                assert corners[k] not in own[other]
                assert set(corners) - {corners[k]} <= set(own[other].tolist())
                assert t in across[other]
    u, v = points[own[:, 1]] - points[own[:, 0]], points[own[:, 2]] - points[own[:, 0]]
    assert (u[:, 0] * v[:, 1] > u[:, 1] * v[:, 0]).all()  # anticlockwise


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(3, 200), flat=st.floats(0.02, 1.0))
def test_of_points_at_random(seed: int, count: int, flat: float) -> None:
    rng = np.random.default_rng(seed)
    as_qhull_has_them(rng.uniform(50.0, 90.0, (count, 2)) * [1.0, flat])


@pytest.mark.parametrize("apart_mm", [0.05, 0.4, 1.5])
def test_of_parallel_walls_whose_points_all_but_lie_on_circles(apart_mm: float) -> None:
    x = np.arange(0.0, 60.0, 0.12)
    walls = [np.column_stack([x, np.full(len(x), y)]) for y in (80.0, 80.0 + apart_mm)]
    points = np.concatenate([walls[0], walls[1][::-1]])
    move_aside(points, 1e-5)
    as_qhull_has_them(points)


def test_of_rings_around_one_centre() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 500, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    points = np.concatenate([10.0 * ring, 9.5 * ring[::-1]]) + 100.0
    move_aside(points, 1e-5)
    as_qhull_has_them(points)


def test_fewer_than_three_points_have_none() -> None:
    corners, across = triangles(np.zeros((2, 2)))
    assert len(corners) == len(across) == 0
