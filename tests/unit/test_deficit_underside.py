"""A part that stands on the bed is not seen from below: that is unseen, not missing."""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest
import trimesh

import amrepair
import gcode
from amrepair.scans import Scan
from amrepair.template import MeshSdf


def mesh_of(solid: m3.Manifold) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))


def test_the_underside_of_a_bare_cloud_is_not_missing() -> None:
    part = m3.Manifold.cube((30.0, 20.0, 6.0))
    part += m3.Manifold.cube((18.0, 20.0, 4.0)).translate((0.0, 0.0, 5.0))
    corner = m3.Manifold.cube((7.0, 8.0, 1.6)).translate((23.0, 0.0, 4.4))
    standing = mesh_of((part - corner).translate((100.0, 80.0, 0.0)))
    points, faces = trimesh.sample.sample_surface(standing, 60_000, seed=1)
    noise = np.random.default_rng(0).normal(scale=0.03, size=points.shape)
    seen = np.asarray(standing.face_normals)[faces][:, 2] > -0.5
    scan = Scan((np.asarray(points) + noise)[seen], 0.03, "build")
    site = amrepair.Site.of_part(MeshSdf.from_mesh(mesh_of(part)), gcode.load_setup())
    plan = amrepair.plan_repair(scan, site, title="repair")
    assert [region.type for region in plan.to_fill] == ["chip"]
    assert plan.deficit.missing_mm3 == pytest.approx(corner.volume(), rel=0.08)
