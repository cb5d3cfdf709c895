"""A part whose upper layers lie aside does not lean: its pose is that of what it stands on."""

from __future__ import annotations

from dataclasses import replace

import manifold3d as m3
import numpy as np
import pytest
import trimesh

from amrepair.align import align
from amrepair.align.options import DEFAULT_ALIGN
from amrepair.align.standing import stood_up
from amrepair.frames import Transform, motion_about, rotation_from_vector, turned_rad
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from tests.draws import draws
from tests.unit.loop_bench import solid_mesh

AT_MM = np.array([60.0, 50.0, 0.0])


def angle() -> m3.Manifold:
    """Two walls on a foot, 10 × 18 × 40 mm."""
    whole = m3.Manifold.cube((10.0, 18.0, 40.0))
    return whole - m3.Manifold.cube((12.0, 9.0, 40.0)).translate((-1.0, 5.0, 9.0))


STANDS = replace(DEFAULT_ALIGN, stands_upright=True)
PART = MeshSdf.from_mesh(solid_mesh(angle()))


def scan_of(aside_mm: float, share: float) -> Scan:
    """Of the part on the bed; what is higher than a share of its height lies aside."""
    part, cut_mm = angle(), 40.0 * share
    upper = part.trim_by_plane((0.0, 0.0, 1.0), cut_mm).translate(
        (0.8 * aside_mm, 0.6 * aside_mm, 0)
    )
    mesh = solid_mesh(part.trim_by_plane((0.0, 0.0, -1.0), -cut_mm) + upper)
    points, _ = trimesh.sample.sample_surface(mesh, 20_000, seed=0)
    points = np.asarray(points)[np.asarray(points)[:, 2] > 0.2]  # the bed hides its foot
    noise = np.random.default_rng(0).normal(0.0, 0.04, points.shape)
    return Scan(points + noise + AT_MM, 0.04, "build")


@pytest.mark.parametrize(("aside_mm", "share"), [(1.0, 0.6), (1.0, 0.5), (2.0, 0.5)])
def test_where_it_stands_is_told_it_does_not_lean(aside_mm: float, share: float) -> None:
    # regression: it leant by 2 degrees, which fits neither half, and "agreed with its template"
    guess = Transform.from_rotation_translation(
        "template", "build", rotation=np.eye(3), translation_mm=-AT_MM
    )
    found = align(scan_of(aside_mm, share), PART, guess=guess, options=STANDS)
    assert np.rad2deg(turned_rad(found.template_from_scan.rotation)) < 0.3


@pytest.mark.parametrize("aside_mm", draws([0.7, 1.0], 0.7))
def test_found_anywhere_on_the_bed_it_does_not_lean(aside_mm: float) -> None:
    found = align(scan_of(aside_mm, 0.65), PART, options=STANDS)
    lean = np.rad2deg(np.arccos(np.abs(found.template_from_scan.rotation[:, 2]).max()))
    assert lean < 0.3


def test_a_part_that_leans_is_told_to_lean() -> None:
    scan = scan_of(0.0, 0.6)
    lean = motion_about(AT_MM, np.array([0.0, 0.03, 0.0]), np.zeros(3))
    leaning = Scan(scan.points_mm @ lean[:3, :3].T + lean[:3, 3], 0.04, "build")
    found = align(leaning, PART, options=STANDS)
    told = found.template_from_scan.rotation[:, 2]
    assert np.arccos(np.abs(told).max()) == pytest.approx(0.03, abs=0.002)


@pytest.mark.parametrize("turned", [np.zeros(3), np.array([0.5 * np.pi, 0.0, 0.0])])
def test_a_pose_is_stood_up_on_the_face_that_is_nearly_down(turned: np.ndarray) -> None:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(turned)
    # down on the bed is a face of the part in either pose
    upright = np.linalg.inv(pose) if turned.any() else pose
    lean = motion_about(np.array([5.0, 9.0, 20.0]), np.array([0.02, -0.03, 0.0]), np.zeros(3))
    leaning = lean @ upright
    found = stood_up(PART, leaning, np.array([5.0, 9.0, 20.0]), np.deg2rad(3.0))
    assert np.abs(found[:3, 2]).max() == pytest.approx(1.0, abs=1e-6)
    assert turned_rad(found[:3, :3] @ leaning[:3, :3].T) < 0.04
    far = lean @ lean @ leaning
    assert stood_up(PART, far, np.zeros(3), np.deg2rad(3.0)) is far


def disc(facets: int, turned_deg: float) -> MeshSdf:
    """A round plate on its rim, 60 mm across and 8 mm thick, with a hole aside of its middle."""
    across = m3.Manifold.cylinder(8.0, 30.0, 30.0, facets).rotate((0.0, 0.0, turned_deg))
    hole = m3.Manifold.cylinder(10.0, 4.0, 4.0, 64).translate((-15.0, -12.0, -1.0))
    return MeshSdf.from_mesh(solid_mesh((across - hole).rotate((90.0, 0.0, 0.0))))


@pytest.mark.parametrize("turned_deg", [0.0, 1.0])
def test_a_round_rim_has_no_face_to_stand_on(turned_deg: float) -> None:
    # regression: a crop of a disc that stood on its rim was turned by 2 degrees, onto the largest
    # of its rim's equal facets, then "has come off and moved"
    round_part = disc(180, turned_deg)
    pose = motion_about(np.zeros(3), np.array([0.0, 1e-3, 0.0]), np.zeros(3))
    found = stood_up(round_part, pose, np.zeros(3), np.deg2rad(3.0))
    assert np.rad2deg(turned_rad(found[:3, :3] @ pose[:3, :3].T)) < STANDS.upright_deg


def test_a_round_foot_beside_a_flat_one_is_not_stood_on() -> None:
    foot = m3.Manifold.cube((10.0, 30.0, 20.0)).translate((3.0, 0.0, 0.0))
    rims = m3.Manifold.cylinder(30.0, 3.0, 3.0, 360).rotate((-90.0, 0.0, 0.0))
    rounded = foot + rims.translate((3.0, 0.0, 3.0)) + rims.translate((13.0, 0.0, 3.0))
    part = MeshSdf.from_mesh(solid_mesh(rounded))
    for lean_rad in (0.035, -0.035):
        pose = motion_about(np.zeros(3), np.array([0.0, lean_rad, 0.0]), np.zeros(3))
        found = stood_up(part, pose, np.array([8.0, 15.0, 10.0]), np.deg2rad(3.0))
        assert np.abs(found[:3, 2]).max() == pytest.approx(1.0, abs=1e-6)
