"""The checks of shapes (`tests/shapes.py`) see what they are for, and no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation

from amrepair import frames
from amrepair.scans import Scan
from tests import shapes


@pytest.fixture(autouse=True)
def _every_call(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shapes, "checked_every", 1)  # other tests may have called it before


def test_an_array_of_another_shape_is_refused_in_functions_methods_and_records() -> None:
    with pytest.raises(BeartypeCallHintViolation, match="rotation_of_quaternion"):
        frames.rotation_of_quaternion(np.zeros(3))
    here = frames.Transform.identity("build", "scanner")
    with pytest.raises(BeartypeCallHintViolation, match="apply"):
        here.apply(np.zeros((5, 2)))
    with pytest.raises(BeartypeCallHintViolation, match="points_mm"):
        Scan(np.zeros((5, 2)), 0.03, "s")


def test_one_letter_is_one_number_within_a_call_and_free_in_the_next() -> None:
    scan = Scan(np.zeros((5, 3)), 0.03, "s")
    with pytest.raises(BeartypeCallHintViolation, match="normals"):
        replace(scan, normals=np.zeros((4, 3)))
    assert len(replace(scan, points_mm=np.zeros((4, 3))).points_mm) == 4


def test_what_names_no_shape_is_called_as_it_is() -> None:
    assert not hasattr(frames.Transform.inverse, "__wrapped__")
    assert hasattr(frames.Transform.apply, "__wrapped__")
