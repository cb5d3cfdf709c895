"""The planned template's own arithmetic, against plain references."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from amrepair.template import planned_kernels as kernels


@pytest.fixture(params=range(3))
def solid(request: pytest.FixtureRequest) -> np.ndarray:
    """Boxes thrown together; the top is open."""
    rng = np.random.default_rng(request.param)
    shape = np.array([23, 31, 11])
    made = np.zeros(shape, bool)
    for _ in range(6):
        low = rng.integers(0, shape - 2)
        high = low + rng.integers(1, 9, 3)
        made[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
    made[:, :, -2:] = False
    return made


def test_distances_are_those_of_scipy(solid: np.ndarray) -> None:
    for sought in (True, False):
        found = np.sqrt(kernels.squared_distances(solid, sought))
        wanted = ndimage.distance_transform_edt(solid != sought)
        np.testing.assert_allclose(found, wanted, atol=1e-5)  # float32


def test_where_nothing_is_sought_for_everything_is_far() -> None:
    found = kernels.squared_distances(np.zeros((4, 5, 3), bool), True)
    assert (found >= kernels.FAR2).all()


@pytest.mark.parametrize("every", [1, 7])
def test_open_faces_are_those_of_shifted_copies(solid: np.ndarray, every: int) -> None:
    padded = np.pad(solid, 1)
    padded[:, :, 0] = padded[:, :, 1]  # the lowest slice goes on downwards
    wanted, found, count = [], [], 0
    room = np.empty((solid.size, 3))
    for axis in range(3):
        for side in (-1, 1):
            beside = np.roll(padded, -side, axis=axis)[1:-1, 1:-1, 1:-1]
            normal = 0.5 * side * np.eye(3)[axis]
            wanted.append(np.argwhere(solid & ~beside) + 0.5 + normal)
            faces, kept = kernels.open_faces(solid, axis, side, every, count, room)
            found.append(room[:kept].copy())
            count += faces
    np.testing.assert_array_equal(np.concatenate(found), np.concatenate(wanted)[::every])
