"""A part that stands on the bed is not seen from below: that is unseen, not missing."""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest
import trimesh

import amrepair
import gcode
from amrepair.deficit import compute_deficit
from amrepair.frames import Transform
from amrepair.scans import Scan
from amrepair.template import MeshSdf


def mesh_of(solid: m3.Manifold) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))


@pytest.mark.slow
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


def seen_from_around(solid: m3.Manifold, seed: int) -> Scan:
    """A bare cloud of all of a solid but its foot, 0.3 mm apart, 0.04 mm of noise."""
    mesh = mesh_of(solid)
    points, faces = trimesh.sample.sample_surface(mesh, int(mesh.area / 0.3**2), seed=seed)
    noise = np.random.default_rng(seed).normal(scale=0.04, size=points.shape)
    low = np.asarray(points)[:, 2] < 0.02
    foot = low & (np.asarray(mesh.face_normals)[faces][:, 2] < -0.9)
    return Scan((np.asarray(points) + noise)[~foot], 0.04, "template")


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_wide_break_over_a_foot_that_nobody_saw_is_no_ceiling(seed: int) -> None:
    # regression: the opening of the foot was larger than that of the break, whose floor was turned
    # to face it: 10,294 mm3 below it were missing, and the 7,135 mm3 above stood
    part = m3.Manifold.cube((36.0, 34.0, 10.0))
    for x_mm in (11.0, 25.0):
        bore = m3.Manifold.cylinder(40.0, 3.0, 3.0, 48, True).rotate((90.0, 0.0, 0.0))
        part -= bore.translate((x_mm, 17.0, 4.5))
    broken = m3.Manifold.cube((46.0, 40.0, 10.0)).translate((-5.0, 10.0, 6.5))
    template = MeshSdf.from_mesh(mesh_of(part))
    scan = seen_from_around(part - broken, seed)
    deficit = compute_deficit(
        scan, template, build_from_template=Transform.identity("build", "template")
    )
    gone = part ^ broken
    assert deficit.missing_mm3 == pytest.approx(gone.volume(), rel=0.01)
    assert (deficit.missing ^ gone).volume() > 0.98 * gone.volume()
