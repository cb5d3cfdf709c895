"""A bare view of a walled part: what its own walls hide is not missing.

Regression: a corner broken off a 3 mm wall took along what other walls hid, up to 1,027 mm³ beside
48 that were gone; a third of views of such parts, none of which said where the scanner stood.
"""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest

from amrepair.deficit import compute_deficit
from amrepair.field.one_view import ways_of_view
from amrepair.field.options import OneViewOptions
from amrepair.frames import Transform, unit_vectors
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from tests.draws import draws
from tests.unit.loop_bench import solid_mesh
from tests.unit.test_occupancy import seen_from

PLACED = Transform.identity("build", "template")


def block(size: tuple[float, float, float], x_mm: float = 0.0) -> m3.Manifold:
    """A block from the bed up."""
    return m3.Manifold.cube(size).translate((x_mm, 0.0, 0.0))


ANGLE = block((22, 12, 3)) + block((22, 3, 10)) + block((3, 12, 10), 19)
CHANNEL = block((20, 18, 3)) + block((3, 18, 11)) + block((3, 18, 11), 17)
CASES = {
    "angle, outer corner": (ANGLE, (-0.81, 0.01, 0.59), (2, 1, 9)),
    "angle, inner edge": (ANGLE, (-0.73, -0.11, 0.67), (20, 1, 9)),
    "channel, edge": (CHANNEL, (0.42, -0.75, 0.51), (1, 9, 10)),
    "channel, corner": (CHANNEL, (0.5, 0.5, 0.7), (20, 11, 9)),
}


@pytest.mark.parametrize("case", draws(CASES, "angle, inner edge", "channel, edge"))
def test_what_a_wall_hides_is_not_missing(case: str) -> None:
    part, view, at_mm = CASES[case]
    tool = m3.Manifold.cube((5, 5, 4.5), True).rotate((20, 35, 50)).translate(at_mm)
    scan = Scan(seen_from(part - tool, view, seed=0), 0.04, "template")
    deficit = compute_deficit(scan, MeshSdf.from_mesh(solid_mesh(part)), build_from_template=PLACED)
    gone = part ^ tool
    assert (deficit.missing - gone).volume() < 0.3 * gone.volume()
    assert (deficit.missing ^ gone).volume() > 0.3 * gone.volume()


def faces_of(part: m3.Manifold, ways: np.ndarray) -> tuple[MeshSdf, tuple[np.ndarray, ...]]:
    """Places on a part, their normals, and which are in view from one of the ways."""
    template = MeshSdf.from_mesh(solid_mesh(part))
    places, normals = template.surface_points(0.8)
    seen = np.zeros(len(places), bool)
    for way in ways:
        along = places[:, None] + 0.3 * normals[:, None] + np.arange(0, 30, 0.3)[:, None] * way
        free = (template.distance(along.reshape(-1, 3)) > 0).reshape(len(places), -1).all(axis=1)
        seen |= free & (normals @ way > 0.2)
    return template, (places, normals, seen)


def test_one_view_tells_the_way_that_it_looked() -> None:
    way = unit_vectors(np.array([[0.42, -0.75, 0.51]]))
    template, surface = faces_of(CHANNEL, way)
    found = ways_of_view(template, surface, 1.0, OneViewOptions())
    assert len(found)
    assert np.rad2deg(np.arccos(found @ way[0])).min() < 8.0


def test_a_scan_from_all_sides_is_no_view() -> None:
    around = np.array([[0.7, 0.0, 0.7], [-0.7, 0.0, 0.7], [0.0, 0.7, 0.7], [0.0, -0.7, 0.7]])
    template, surface = faces_of(CHANNEL, around)
    assert not len(ways_of_view(template, surface, 1.0, OneViewOptions()))
