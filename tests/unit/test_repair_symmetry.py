"""A symmetric part fits a scan in several poses; where its damage lies tells them apart."""

from __future__ import annotations

import re
from dataclasses import replace

import manifold3d
import numpy as np
import pytest
import trimesh
from jaxtyping import Float

from amrepair.errors import AlignmentError
from amrepair.frames import Transform
from amrepair.repair import RepairPlan, Site, plan_repair
from amrepair.repair.symmetry import registration_of_damage
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from gcode.profiles import load_setup

SIZE_MM = np.array([30.0, 20.0, 8.0])
CHIP_MM = np.array([6.0, 5.0, 2.0])  # off the corner at the far end of all three axes
AT_MM = np.array([100.0, 90.0, 0.0])


def as_mesh(solid: manifold3d.Manifold) -> trimesh.Trimesh:
    made = solid.to_mesh64()
    return trimesh.Trimesh(np.asarray(made.vert_properties)[:, :3], np.asarray(made.tri_verts))


def stepped() -> manifold3d.Manifold:
    """A block with a step on it, so that it has a top: two turns look the same, not four."""
    step = manifold3d.Manifold.cube((20.0, 10.0, 3.0)).translate((5.0, 5.0, float(SIZE_MM[2])))
    return manifold3d.Manifold.cube(SIZE_MM.tolist()) + step


@pytest.fixture(scope="module")
def site() -> Site:
    placed = Transform.from_rotation_translation(
        "build", "template", rotation=np.eye(3), translation_mm=AT_MM
    )
    template = MeshSdf.from_mesh(as_mesh(stepped()))
    return Site.of_part(template, load_setup(), build_from_template=placed)


@pytest.fixture(scope="module")
def scan() -> Scan:
    """What a scanner sees from above and all sides, in a frame of its own."""
    chip = manifold3d.Manifold.cube((2 * CHIP_MM).tolist(), True).translate(SIZE_MM.tolist())
    broken = as_mesh(stepped() - chip)
    rng = np.random.default_rng(3)
    points, faces = trimesh.sample.sample_surface(broken, 15_000, seed=3)
    normals = broken.face_normals[faces]
    seen = normals[:, 2] > -0.5
    noisy = points[seen] + rng.normal(scale=0.02, size=(int(seen.sum()), 3))
    turned = trimesh.transformations.rotation_matrix(2.0, [0.3, 0.2, 0.9], [4.0, 5.0, 6.0])
    return Scan(
        trimesh.transform_points(noisy, turned), 0.02, "scanner",
        normals[seen] @ turned[:3, :3].T,
    )  # fmt: skip


SAID_MM, THERE_MM = (125.0, 110.0), (127.0, 107.5)
OTHER_SAID_MM, OTHER_THERE_MM = (101.0, 94.0), (103.0, 92.5)


@pytest.fixture(scope="module")
def plan(site: Site, scan: Scan) -> RepairPlan:
    told = replace(site, damage_at_mm=SAID_MM)
    return plan_repair(scan, told, title="x", rng=np.random.default_rng(0), strict=False)


def middle_mm(missing: manifold3d.Manifold) -> Float[np.ndarray, " 2"]:
    return np.asarray(missing.bounding_box()).reshape(2, 3).mean(axis=0)[:2]


def test_the_damage_is_repaired_where_it_was_said_to_be(plan: RepairPlan) -> None:
    assert plan.deficit.missing_mm3 == pytest.approx(float(np.prod(CHIP_MM)), rel=0.1)
    assert middle_mm(plan.deficit.missing) == pytest.approx(THERE_MM, abs=0.3)


def test_nobody_said_where_so_the_places_are_named(
    site: Site, scan: Scan, plan: RepairPlan
) -> None:
    with pytest.raises(AlignmentError, match=r"2 poses equally well.*--damage-at") as refused:
        registration_of_damage(scan, site, plan.registration, plan.deficit)
    places = re.findall(r"(\d+),(\d+)", str(refused.value))
    assert np.array(places, float) == pytest.approx(np.array([THERE_MM, OTHER_THERE_MM]), abs=1)


def test_of_two_places_the_one_that_was_said_is_taken(
    site: Site, scan: Scan, plan: RepairPlan
) -> None:
    same, other = (
        registration_of_damage(
            scan, replace(site, damage_at_mm=said_mm), plan.registration, plan.deficit
        )
        for said_mm in (SAID_MM, OTHER_SAID_MM)
    )
    assert same is plan.registration
    assert other.symmetric_alternatives == (plan.registration.template_from_scan,)
    assert site.build_from_template is not None
    build = [
        site.build_from_template @ found.template_from_scan for found in (other, plan.registration)
    ]
    moved = plan.deficit.missing.transform((build[0] @ build[1].inverse()).matrix[:3])
    assert middle_mm(moved) == pytest.approx(OTHER_THERE_MM, abs=0.3)


def test_a_place_between_two_of_them_tells_nothing(
    site: Site, scan: Scan, plan: RepairPlan
) -> None:
    x_mm, y_mm, _ = AT_MM + SIZE_MM / 2
    told = replace(site, damage_at_mm=(float(x_mm) + 0.5, float(y_mm)))
    with pytest.raises(AlignmentError, match=r"does not tell .* nearer by 3 mm"):
        registration_of_damage(scan, told, plan.registration, plan.deficit)
