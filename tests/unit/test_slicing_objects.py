"""Bodies that lie apart in plan are labelled in a job; what lies one within the other is one."""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest

from gcode.meshes import closed_mesh
from gcode.profiles import load_setup
from gcode.reader import objects_of, read_job
from gcode.slicing.job import plan_part
from gcode.slicing.objects import boxes_apart_mm
from gcode.writer import write

SETUP = load_setup("prusa_mk3s", "pla", "repair_0.20")


def cube(x_mm: float, size_mm: float = 6.0, high_mm: float = 0.4) -> m3.Manifold:
    return m3.Manifold.cube((size_mm, size_mm, high_mm)).translate((100.0 + x_mm, 100.0, 0.0))


def test_beads_are_labelled_by_the_body_that_they_make() -> None:
    solid = m3.Manifold.compose([cube(30.0), cube(0.0), cube(14.0)])
    program = write(plan_part(solid, SETUP).toolpath, SETUP, title="three")
    job = read_job(program)
    found = objects_of(job)
    assert set(found.names) == {"body_1", "body_2", "body_3"}
    middle = 0.5 * (job.beads.start_mm + job.beads.end_mm)[:, 0] - 100.0
    own = found.of_bead >= 0
    for name, x_mm in (("body_1", 0.0), ("body_2", 14.0), ("body_3", 30.0)):
        its = found.of_bead == found.names.index(name)
        assert its.sum() > 10
        assert ((middle[its] > x_mm) & (middle[its] < x_mm + 6.0)).all()
    # the rest is the skirt, around all of them
    assert not np.isin(job.beads.role[own], job.beads.role[~own]).any()


def hollow() -> m3.Manifold:
    return cube(0.0, 20.0, 8.0) - cube(4.0, 8.0, 4.0).translate((0.0, 4.0, 2.0))


@pytest.mark.parametrize(
    ("solid", "count"),
    [
        (cube(0.0), 0),
        (m3.Manifold.compose([cube(0.0), cube(6.3)]), 0),  # their beads nearly touch
        (hollow(), 0),  # a cavity is no body
        (m3.Manifold.compose([cube(0.0), cube(10.0)]), 2),
        (m3.Manifold.compose([cube(0.0), cube(3.0).translate((0.0, 0.0, 1.0)), cube(20.0)]), 2),
    ],
    ids=["one", "near", "hollow", "two", "one over another"],
)
def test_what_lies_apart_in_plan_is_an_object(solid: m3.Manifold, count: int) -> None:
    assert len(boxes_apart_mm(closed_mesh(solid), 0.45)) == count
