"""Boxes of what is missing."""

from __future__ import annotations

import numpy as np

from amrepair.deficit.boxes import Box, _merged


def box(x_mm: float) -> Box:
    return Box(np.array([[x_mm, 0.0, 0.0], [x_mm + 2.0, 2.0, 2.0]]), 0.2, is_film=False)


def test_boxes_that_overlap_become_one_whichever_comes_first() -> None:
    """regression: a box was looked for by comparing arrays, and a loop's look ended in that."""
    boxes = [box(10.0), box(0.0), box(20.0), box(1.0), box(21.0)]
    found = sorted(tuple(b.corners_mm[:, 0].tolist()) for b in _merged(boxes))
    assert found == [(0.0, 3.0), (10.0, 12.0), (20.0, 23.0)]
