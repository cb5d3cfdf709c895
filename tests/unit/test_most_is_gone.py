"""A print that stopped early: most of the part is missing, and no sensor is known.

Regression: of a block of 16 mm that ended at 5 mm a slab under the broken face was told to be
missing, sealed in walls that were seen, 145 of 5,376 mm³: unseen surface that faces upwards cost
nothing, as none was seen at all, and the labelled surface lay a hair off the broken one, so that
each of its places seemed shut in.
"""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest
import trimesh

from amrepair.deficit import compute_deficit
from amrepair.frames import Transform
from amrepair.regions import detect
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from tests.unit.loop_bench import solid_mesh

BLOCK = m3.Manifold.cube((24, 20, 16))
PARTS = {
    "block": BLOCK,
    "with a hollow above": BLOCK - m3.Manifold.cube((10, 8, 6)).translate((7, 6, 7)),
}


@pytest.mark.parametrize("name", PARTS)
def test_what_lies_over_the_broken_face_is_gone_and_not_what_lies_under(name: str) -> None:
    whole = PARTS[name]
    rest = whole.trim_by_plane((0, 0, -1), -5.0)
    mesh = solid_mesh(rest)
    points, _ = trimesh.sample.sample_surface(mesh, int(mesh.area / 0.06), seed=0)
    points = points + np.random.default_rng(0).normal(0.0, 0.04, points.shape)
    scan = Scan(points, 0.04, "template")
    template = MeshSdf.from_mesh(solid_mesh(whole))
    missing = compute_deficit(
        scan,
        template,
        detect(scan, template, pose="told"),
        build_from_template=Transform.identity("build", "template"),
    ).missing
    assert (missing ^ (whole - rest)).volume() > 0.9 * (whole - rest).volume()
    assert (missing ^ rest).volume() < 0.01 * rest.volume()
