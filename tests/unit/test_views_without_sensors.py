"""Views of a part without sensor positions: what nobody saw is not missing.

Regression: with all walls unseen, or one oblique view, a pocket made the whole part missing (1,043
of 13.75 mm³ from above, 59 of 13.75 and 73 of 50 mm³ aslant).
"""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest

from amrepair.deficit import compute_deficit
from amrepair.detect.holes import is_closed, spoken_of
from amrepair.frames import Transform
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from tests.unit.loop_bench import scan_of, solid_mesh

BLOCK = m3.Manifold.cube((16.0, 12.0, 6.6))
TEMPLATE = MeshSdf.from_mesh(solid_mesh(BLOCK))
PLACED = Transform.identity("build", "template")
VIEWS = {"from above": ((0.0, 0.0, 1.0), 0.5), "aslant": ((0.3, 0.4, 0.85), 0.05)}
CUTS = {
    "pocket": ((5.0, 3.0, 6.05), (5.0, 5.0, 1.0)),
    "pocket beside a wall": ((1.0, 3.0, 5.6), (5.0, 5.0, 2.0)),
    "edge": ((-1.0, 3.0, 5.6), (4.0, 5.0, 2.0)),
    "corner": ((-1.0, -1.0, 5.1), (5.0, 5.0, 2.0)),
}


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("cut", CUTS)
def test_only_what_is_broken_is_missing(cut: str, view: str) -> None:
    corner, size = CUTS[cut]
    gone = m3.Manifold.cube(size).translate(corner) ^ BLOCK
    cloud = scan_of(BLOCK - gone)
    assert cloud.normals is not None
    toward, least = VIEWS[view]
    seen = cloud.normals @ np.array(toward) > least
    normals = cloud.normals[seen] if view == "aslant" else None
    scan = Scan(cloud.points_mm[seen], cloud.sigma_mm, "template", normals)
    deficit = compute_deficit(scan, TEMPLATE, build_from_template=PLACED)
    # the walls of the cut are not all seen: a tenth may be given up
    assert deficit.missing_mm3 == pytest.approx(gone.volume(), rel=0.1)


def test_a_hole_that_no_broken_face_speaks_of_says_nothing() -> None:
    pin, wall = np.array([[8.0, 6.0, 6.6]]), np.array([[0.0, 6.0, 1.0]])
    floor, up = np.array([[8.0, 6.0, 5.0]]), np.array([[0.0, 0.0, 1.0]])
    spoken, looked_at = spoken_of(TEMPLATE, np.concatenate([pin, wall]), floor, up, spacing_mm=0.2)
    assert spoken.tolist() == looked_at.tolist() == [True, False]


@pytest.mark.parametrize(("seen", "closed"), [((0.0, 0.0, -25.0), True), ((0.0, 0.0, 90.0), False)])
def test_faces_close_a_whole_scan_and_no_view(
    seen: tuple[float, float, float], closed: bool
) -> None:
    faces = np.array([[0.0, 0.0, 25.0]])
    assert is_closed(np.array(seen), np.zeros(3), faces) is closed
