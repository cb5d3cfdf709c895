"""Broken faces are turned whole until they close what was seen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from amrepair.field.turning import turned_to_close

APART_MM = 0.2
# (origin, along, across, normal into the pit) of a floor and four walls of a pit 8 × 6 × 2 mm
SIDES = {
    "floor": ((0, 0, 0), (8, 0, 0), (0, 6, 0), (0, 0, 1)),
    "west": ((0, 0, 0), (0, 6, 0), (0, 0, 2), (1, 0, 0)),
    "east": ((8, 0, 0), (0, 6, 0), (0, 0, 2), (-1, 0, 0)),
    "south": ((0, 0, 0), (8, 0, 0), (0, 0, 2), (0, 1, 0)),
}


def pit(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, outward normals with noise, and the number of the side of each."""
    points, normals, side = [], [], []
    for k, (origin, along, across, normal) in enumerate(SIDES.values()):
        u, v = np.array(along, float), np.array(across, float)
        n = int(np.linalg.norm(u) * np.linalg.norm(v) / APART_MM**2)
        points.append(np.array(origin) + rng.random((n, 1)) * u + rng.random((n, 1)) * v)
        askew = np.array(normal) + rng.normal(scale=0.12, size=(n, 3))
        normals.append(askew / np.linalg.norm(askew, axis=1, keepdims=True))
        side.append(np.full(n, k))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(side)


@given(wrong=st.sets(st.sampled_from((0, 1, 3))), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_faces_that_were_turned_the_wrong_way_close_the_pit_again(
    wrong: set[int], seed: int
) -> None:
    """Two walls that face each other say nothing of each other: one of them is known."""
    points, truth, side = pit(np.random.default_rng(seed))
    area = np.full(len(points), APART_MM**2)
    near = cKDTree(points).query(points, k=16)[1].astype(np.int64)
    turned = turned_to_close(
        np.where(np.isin(side, list(wrong))[:, None], -truth, truth),
        area,
        side == 2,
        np.arange(len(points)),
        near,
        seen_mm2=-(truth * area[:, None]).sum(axis=0),
    )
    right = (turned * truth).sum(axis=1) > 0
    assert right.mean() > 0.97


def test_what_closes_stays_as_it_is() -> None:
    points, truth, side = pit(np.random.default_rng(0))
    area = np.full(len(points), APART_MM**2)
    near = cKDTree(points).query(points, k=16)[1].astype(np.int64)
    seen = -(truth * area[:, None]).sum(axis=0)
    turned = turned_to_close(truth, area, side < 0, np.arange(len(points)), near, seen_mm2=seen)
    assert ((turned * truth).sum(axis=1) > 0).mean() == pytest.approx(1.0, abs=0.02)
