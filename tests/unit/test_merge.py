"""Templates from scans, against analytic truth: poses, surface, outliers, spread, gaps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from amrepair.errors import AlignmentError, InputError, TemplateError
from amrepair.frames import rotation_from_vector
from amrepair.merge import fit_from_scans
from amrepair.merge.cloud import outward, planes, spacing_of
from amrepair.merge.fuse import Cloud, Fused, _poisson, fuse
from amrepair.merge.place import Placement, place
from amrepair.merge.views import View
from amrepair.regions import Label, detect
from amrepair.regions.error_calibration import NORMAL_NOISE
from amrepair.scans import Scan
from amrepair.template import LearnedSdf, MeshSdf, load_template
from tests.analytic import (
    AnalyticTemplate,
    box,
    cylinder,
    difference,
    sample_surface,
    union,
)

SIGMA_MM = 0.03


@pytest.fixture(scope="module")
def part() -> AnalyticTemplate:
    """A plate with a tower and a through hole: no symmetry, every kind of edge."""
    body = union(box((0, 0, 0), (40, 25, 8)), cylinder((30, 15, 4), 6, 14))
    return difference(body, cylinder((10, 9, -1), 4, 12))


def points_of(
    part: AnalyticTemplate, count: int, seed: int, sigma_mm: float = SIGMA_MM
) -> np.ndarray:
    """About `count` points in the part's frame."""
    spacing_mm = float(np.sqrt(part.body.surface_area() / count))
    points, _ = sample_surface(part.body, spacing_mm, seed=seed)
    return points + np.random.default_rng(seed).normal(0, sigma_mm, points.shape)


def pose(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(100 + seed)
    axis = rng.normal(size=3)
    turn = rotation_from_vector(2.5 * axis / np.linalg.norm(axis)) if seed else np.eye(3)
    return turn, rng.normal(size=3) * 50.0 * (seed > 0)


def placed(points: np.ndarray, seed: int) -> Scan:
    turn, shift = pose(seed)
    return Scan(points @ turn.T + shift, 0.04, "scanner", source=f"scan{seed}")


def joined(clouds: list[np.ndarray], part: AnalyticTemplate) -> Cloud:
    """Scans that stand in one frame already, and face as the part does: what tells is not fused."""
    spacing = [spacing_of(c) for c in clouds]
    normals = np.concatenate([planes(c, s).normals for c, s in zip(clouds, spacing, strict=True)])
    points = np.concatenate(clouds)
    together = spacing_of(points)
    scan = np.repeat(np.arange(len(clouds)), [len(c) for c in clouds])
    truth = part.distance_and_gradient(points)[1]
    facing = np.where((normals * truth).sum(axis=1, keepdims=True) < 0.0, -normals, normals)
    return Cloud(points, facing, scan, len(clouds), together, SIGMA_MM, max(spacing))


def placed_together(scans: list[Scan]) -> Placement:
    rng = np.random.default_rng(0)
    return place([View.of(scan, rng) for scan in scans], rng)


def fused_error(fused: Fused, part: AnalyticTemplate, away: float = 0.0) -> np.ndarray:
    """|distance to the true surface| on the fused one."""
    points, _ = trimesh.sample.sample_surface(fused.mesh, 20_000, seed=3)
    return np.abs(part.distance(np.asarray(points)))


def test_noise_and_spacing_are_measured(part: AnalyticTemplate) -> None:
    points = points_of(part, 40_000, 0)
    spacing_mm = spacing_of(points)
    # random points of density ρ: spacing is defined as 1 / sqrt(ρ)
    assert spacing_mm == pytest.approx(np.sqrt(part.body.surface_area() / 40_000), rel=0.1)
    assert planes(points, spacing_mm).sigma_mm == pytest.approx(SIGMA_MM, rel=0.2)


def test_normals_point_outwards_also_in_the_hole(part: AnalyticTemplate) -> None:
    points = points_of(part, 8_000, 1)
    spacing_mm = spacing_of(points)
    normals = outward(points, planes(points, spacing_mm).normals, spacing_mm, SIGMA_MM)
    gradient = part.distance_and_gradient(points)[1]
    agree = (normals * gradient).sum(axis=1)
    assert (agree > 0).mean() > 0.995  # planes through an edge lie across it
    hole = (np.linalg.norm(points[:, :2] - (10, 9), axis=1) < 4.2) & (points[:, 2] > 1)
    hole &= points[:, 2] < 7
    assert (agree[hole] > 0).mean() > 0.99


@pytest.mark.slow
def test_both_sides_of_a_thin_wall_are_told_apart() -> None:
    """A duct with walls of 1.5 mm, points a millimetre apart: planes, sides, and the noise."""
    duct = difference(box((0, 0, 0), (50, 26, 20)), box((-1, 1.5, 1.5), (51, 24.5, 18.5)))
    points = sample_surface(duct.body, 1.0, seed=0)[0]
    points += np.random.default_rng(0).normal(0.0, 0.05, points.shape)
    spacing_mm = spacing_of(points)
    plane = planes(points, spacing_mm)
    assert plane.sigma_mm < 2.0 * 0.05  # edges and corners are everywhere
    normals = outward(points, plane.normals, spacing_mm, plane.sigma_mm)
    agree = (normals * duct.distance_and_gradient(points)[1]).sum(axis=1)
    assert (agree < -0.3).mean() < 0.03


def test_a_hollow_that_one_scan_alone_saw_into_is_kept() -> None:
    """The others have a wall above it, which the scan has, too: that contradicts nothing."""
    step = difference(box((0, 0, 0), (40, 30, 12)), box((10, 8, 4), (30, 22, 13)))
    clouds = []
    for seed in range(3):
        points = sample_surface(step.body, 1.4, seed=seed)[0]
        points += np.random.default_rng(seed).normal(0.0, 0.03, points.shape)
        floor = (abs(points - (20, 15, 4)) < (9.9, 6.9, 0.5)).all(axis=1)
        shelf = (points[:, 2] > 3.0) & (points[:, 2] < 11.0) & floor
        clouds.append(points if seed == 0 else points[~shelf])
    assert fuse(joined(clouds, step)).rejected < 20


@pytest.mark.slow
def test_scans_find_each_other(part: AnalyticTemplate) -> None:
    scans = [placed(points_of(part, 15_000, s), s) for s in range(3)]
    found = placed_together(scans)
    assert set(found.poses) == {0, 1, 2}
    corners = np.array(part.bounds_mm)
    for s, matrix in found.poses.items():
        turn, shift = pose(s)
        back = (corners @ turn.T + shift) @ matrix[:3, :3].T + matrix[:3, 3]
        assert np.abs(back - corners).max() < 0.02  # σ over the root of 12,000, and its lever


def test_a_template_from_scans_is_the_part(tmp_path: Path) -> None:
    body = union(box((0, 0, 0), (26, 17, 6)), cylinder((19, 10, 3), 4, 9))
    part = difference(body, cylinder((7, 6, -1), 3, 9))
    scans = [placed(points_of(part, 7_000, s), s) for s in range(2)]
    made = fit_from_scans(scans, seed=0)
    truth, _ = sample_surface(part.body, 0.5, seed=9)
    error_mm = np.abs(made.template.distance(truth))
    # 11 µm from 800,000 points (measurements); a twentieth of them leaves more of the noise
    assert error_mm.mean() < 0.02
    assert np.quantile(error_mm, 0.9) < 0.05  # the rest is edges, rounded by a fit's radius
    assert made.sigma_mm == pytest.approx(SIGMA_MM, rel=0.25)
    assert made.fused.unseen_ratio < 0.002
    assert made.template.coverage is None or (made.template.spread_mm(truth) < 1.0).all()
    assert made.template.solid().volume() == pytest.approx(part.body.volume(), rel=0.003)
    assert "2 of 2 scans merged" in made.template.metadata["notes"]
    made.template.save(tmp_path / "t.safetensors")
    again = load_template(tmp_path / "t.safetensors")
    assert isinstance(again, LearnedSdf)
    assert np.array_equal(again.spread_mm(truth), made.template.spread_mm(truth))


def test_a_defect_of_one_scan_is_outvoted(part: AnalyticTemplate) -> None:
    clouds = [points_of(part, 16_000, s) for s in range(4)]
    spot = np.array([20.0, 20.0, 8.0])
    near = np.linalg.norm(clouds[2] - spot, axis=1) < 3.0
    clouds[2][near & (clouds[2][:, 2] > 7.5), 2] += 1.5  # a bulge
    rim = np.linalg.norm(clouds[3] - (34, 3, 8), axis=1) < 3.0
    clouds[3][rim & (clouds[3][:, 2] > 7.5), 2] -= 0.15  # a dent, within reach of the fit
    fused = fuse(joined(clouds, part))
    assert fused.rejected > 100
    error_mm = fused_error(fused, part)
    assert np.quantile(error_mm, 0.999) < 0.2
    assert error_mm.max() < 0.5  # specks at edges; the bulge has 1.5
    assert error_mm.mean() < 0.02
    # the two that are defective stand out, each where it is
    assert fused.outvoted_mm2[2] > 5.0 * fused.outvoted_mm2[:2].max()
    assert np.linalg.norm(fused.outvoted_at_mm[2] - spot) < 3.0


@pytest.mark.slow
def test_where_normal_parts_differ_the_spread_says_so(part: AnalyticTemplate) -> None:
    clouds = [points_of(part, 20_000, s) for s in range(4)]
    for cloud, lift in zip(clouds, (-0.15, -0.05, 0.05, 0.15), strict=True):
        top = (np.linalg.norm(cloud[:, :2] - (30, 15), axis=1) < 5.5) & (cloud[:, 2] > 17.5)
        cloud[top, 2] += lift
    fused = fuse(joined(clouds, part))
    assert fused.spread is not None
    truth_mm = float(np.std((-0.15, -0.05, 0.05, 0.15), ddof=1))
    middle = np.array([[30.0, 15.0, 18.0]])
    assert fused.spread.at(middle)[0] == pytest.approx(truth_mm, rel=0.3)
    flat = np.array([[20.0, 12.0, 0.0], [5.0, 20.0, 8.0], [20.0, 0.0, 4.0]])
    assert fused.spread.at(flat).max() < 0.02


def test_detection_forgives_what_normal_parts_differ_by(part: AnalyticTemplate) -> None:
    class Varying(AnalyticTemplate):
        def spread_mm(self, points_mm: np.ndarray) -> np.ndarray:
            return np.where(points_mm[:, 0] > 20, 0.1, 0.0)

    template = Varying(part.field, part.body)
    points, normals = sample_surface(part.body, 0.6, seed=2)
    scan = Scan(points + 0.35 * normals, 0.03, "template", normals)
    # a whole part that is 0.35 mm too large everywhere: by more than it may be, but on the right
    found = detect(scan, template, calibration=NORMAL_NOISE, pose="told")
    right, left = points[:, 0] > 22, points[:, 0] < 18
    assert (found.label[left] == int(Label.EXCESS)).mean() > 0.6  # corners are cut by no surface
    assert (found.label[right] == int(Label.OK)).mean() > 0.9  # 0.35 − 3 × 0.1 < 0.16


@pytest.mark.slow
def test_what_no_scan_saw_is_closed_and_said(part: AnalyticTemplate) -> None:
    clouds = []
    for s in range(2):
        cloud = points_of(part, 30_000, s)
        clouds.append(cloud[cloud[:, 2] > 1.0])  # stands on a table
    fused = fuse(joined(clouds, part))
    assert fused.mesh.is_volume
    assert fused.unseen_ratio > 0.2
    top = np.array([[20.0, 5.0, 8.0], [30.0, 15.0, 18.0]])
    assert np.abs(MeshSdf.from_mesh(fused.mesh).distance(top)).max() < 0.05


def halves(part: AnalyticTemplate, first_mm: float, second_mm: float) -> list[Scan]:
    """All that lies left of one plane, and all that lies right of another."""
    found = []
    for s, (low, high) in enumerate(((-1.0, first_mm), (second_mm, 41.0))):
        cloud = points_of(part, 20_000, s)
        found.append(placed(cloud[(cloud[:, 0] > low) & (cloud[:, 0] < high)], s))
    return found


@pytest.mark.slow
def test_overlapping_partial_scans_find_each_other(part: AnalyticTemplate) -> None:
    found = placed_together(halves(part, 34.0, 5.0))
    turn, shift = pose(1)
    corners = np.array(part.bounds_mm)
    back = (corners @ turn.T + shift) @ found.poses[1][:3, :3].T + found.poses[1][:3, 3]
    assert np.abs(back - corners).max() < 0.1


@pytest.mark.slow
def test_a_plate_is_not_laid_on_its_other_half(part: AnalyticTemplate) -> None:
    # regression: the pose of the largest overlap was taken, which turns one half onto the other
    with pytest.raises(AlignmentError, match="contradict"):
        placed_together(halves(part, 26.0, 12.0))


@pytest.mark.slow
def test_scans_of_different_parts_are_refused(part: AnalyticTemplate) -> None:
    ball = np.random.default_rng(0).normal(size=(8_000, 3))
    ball *= 22.0 / np.linalg.norm(ball, axis=1, keepdims=True)
    scans = [placed(points_of(part, 8_000, 0), 0), Scan(ball, 0.04, "scanner", source="ball")]
    with pytest.raises((AlignmentError, TemplateError), match="overlap"):
        fit_from_scans(scans)


def test_bad_scans_are_refused_in_words(part: AnalyticTemplate) -> None:
    good = placed(points_of(part, 8_000, 0), 0)
    with pytest.raises(InputError, match="at least one scan"):
        fit_from_scans([])
    with pytest.raises(InputError, match="needs at least 2,000"):
        fit_from_scans([Scan(np.zeros((1, 3)), 0.04, "scanner")])
    metres = Scan(good.points_mm * 1e-3, 0.04, "scanner", source="metres.ply")
    with pytest.raises(InputError, match=r"metres\.ply .*\(metres for millimetres"):
        fit_from_scans([good, placed(points_of(part, 8_000, 1), 1), metres])
    repeated = Scan(np.repeat(good.points_mm[:50], 100, axis=0), 0.04, "scanner", source="same")
    with pytest.raises(InputError, match="only 50 different points"):
        fit_from_scans([repeated])


@pytest.mark.slow
def test_the_smooth_closure_is_the_same_every_time() -> None:
    # regression: threads of the Poisson solver added up in any order, and templates differed
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(60_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 2] > -0.6]
    points = 20.0 * normals + 0.05 * rng.normal(size=normals.shape)
    one, other = (_poisson(points, normals).mesh for _ in range(2))
    assert np.array_equal(one.vertices, other.vertices)
