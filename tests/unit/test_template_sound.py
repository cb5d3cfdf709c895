"""Learning from sound parts: against parts whose departures from the drawing are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from amrepair.errors import InputError
from amrepair.merge import learn_from_scans
from amrepair.regions import detect
from amrepair.regions.anomaly import Label
from amrepair.regions.options import RegionOptions
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from amrepair.template.fit import fit_fast
from amrepair.template.grid import GridSdf
from amrepair.template.options import FitOptions
from amrepair.template.sound import SoundOptions, _common, learn

SIZE_MM = np.array([40.0, 30.0, 16.0])
SIGMA_MM = 0.03
FOOT_MM, FOOT_HIGH_MM, SHRINK, ROUND_MM = 0.25, 1.0, 0.004, 0.6
SMALL_FIT = FitOptions(cells=80, samples=60_000)  # flat faces: a grid is exact there
TOLERANCE_MM = 0.05  # below what the foot departs by: 0.25 mm less shrinkage


@pytest.fixture(scope="module")
def drawn() -> GridSdf:
    box = trimesh.creation.box(extents=SIZE_MM)
    return fit_fast(MeshSdf.from_mesh(box), seed=0, options=SMALL_FIT)


def printed(
    seed: int, *, points: int = 15_000, dent_mm: float = 0.0, at: tuple[float, float] = (5.0, 3.0)
) -> np.ndarray:
    """A scan of the box as this printer makes it: shrunk by 0.4 %, with an elephant's foot.

    Its edges along Z are rounded to 0.6 mm.
    No two are alike: each is 0.02 mm larger or smaller. A dent is a ball's cap in the top.
    """
    rng = np.random.default_rng(seed)
    box = trimesh.creation.box(extents=SIZE_MM)
    place, face = trimesh.sample.sample_surface(box, points, seed=seed)
    place, normal = np.asarray(place), np.asarray(box.face_normals[face])
    place = (1 - SHRINK) * place + rng.normal(0, 0.02) * normal
    for axis in (0, 1):
        on = np.abs(normal[:, axis]) > 0.5
        inset = np.clip(SIZE_MM[1 - axis] / 2 - np.abs(place[:, 1 - axis]), 0.0, ROUND_MM)
        sink = ROUND_MM - np.sqrt(ROUND_MM**2 - (ROUND_MM - inset) ** 2)
        place[on] -= sink[on, None] * normal[on]
    foot = (np.abs(normal[:, 2]) < 0.5) & (place[:, 2] < -SIZE_MM[2] / 2 + FOOT_HIGH_MM)
    place[foot] += FOOT_MM * normal[foot]
    if dent_mm:
        radius = 4.0
        ball = (radius**2 + dent_mm**2) / (2 * dent_mm)  # a cap of that radius and depth
        away = np.linalg.norm(place[:, :2] - at, axis=1)
        top = (normal[:, 2] > 0.5) & (away < radius)
        place[top, 2] -= np.sqrt(ball**2 - away[top] ** 2) - (ball - dent_mm)
    return place + rng.normal(0, SIGMA_MM, place.shape)


def told(points: np.ndarray, template: GridSdf) -> list[tuple[Label, float, np.ndarray]]:
    options = RegionOptions(tolerance_mm=TOLERANCE_MM)
    found = detect(Scan(points, SIGMA_MM, "template", source="scan"), template, options=options)
    return [(r.label, r.depth_mm, r.box_mm.mean(axis=0)) for r in found.regions]


def test_a_foot_shrinkage_and_round_edges_are_learned_and_a_dent_is_not(drawn: GridSdf) -> None:
    learned, sound = learn(drawn, [printed(seed) for seed in range(5)])
    other = printed(10)
    wall = (other[:, 2] < -7.3) & (other[:, 2] > -7.8) & (other[:, 0] > 19.0)
    assert np.median(drawn.distance(other[wall])) > 0.12
    assert abs(np.median(learned.distance(other[wall]))) < 0.05
    assert told(printed(11), learned) == []
    found = told(printed(12, dent_mm=0.5), learned)
    assert [label for label, _, _ in found] == [Label.MISSING]
    assert np.abs(found[0][2][:2] - (5.0, 3.0)).max() < 1.5
    # the foot by the formula: 0.25 mm less 0.4 % of half the length, at sites of the foot alone
    place = sound.sites.place_mm
    foot = (place[:, 2] < -7.6) & (sound.sites.normal[:, 0] > 0.9)
    expected = FOOT_MM - SHRINK * SIZE_MM[0] / 2
    assert np.median(sound.offset_mm[foot]) == pytest.approx(expected, abs=0.05)
    assert not sound.outvoted_mm2.any()


def test_one_defective_scan_does_not_enter_and_is_named(drawn: GridSdf) -> None:
    scans = [printed(seed, dent_mm=1.0 if seed == 3 else 0.0) for seed in range(5)]
    learned, sound = learn(drawn, scans)
    assert np.flatnonzero(sound.outvoted_mm2 > 5.0).tolist() == [3]
    assert np.linalg.norm(sound.outvoted_at_mm[3][:2] - (5.0, 3.0)) < 1.5
    found = told(printed(12, dent_mm=1.0), learned)
    assert [label for label, _, _ in found] == [Label.MISSING]
    assert found[0][1] > 0.8


@pytest.mark.slow
def test_what_no_scan_saw_stays_as_it_was_drawn(drawn: GridSdf) -> None:
    half = [p[p[:, 0] < 0] for p in (printed(seed) for seed in range(3))]
    learned, sound = learn(drawn, half)
    right = np.array([[20.0, 0.0, 0.0], [20.0, 5.0, 3.0]])
    assert np.abs(learned.distance(right) - drawn.distance(right)).max() < 1e-6
    left = np.array([[-20.0, 0.0, 0.0]])
    assert learned.distance(left)[0] == pytest.approx(SHRINK * 20.0, abs=0.03)
    assert (sound.scans[sound.sites.place_mm[:, 0] > 3] == 0).all()


@pytest.mark.slow
def test_two_sides_of_a_thin_wall_learn_apart() -> None:
    wall = trimesh.creation.box(extents=(30.0, 0.8, 20.0))
    template = fit_fast(MeshSdf.from_mesh(wall), seed=0, options=SMALL_FIT)
    scans = []
    for seed in range(3):
        place, face = trimesh.sample.sample_surface(wall, 10_000, seed=seed)
        normal = wall.face_normals[face]
        place = place + np.where(normal[:, 1] > 0.5, 0.15, 0.0)[:, None] * normal
        scans.append(place + np.random.default_rng(seed).normal(0, 0.02, place.shape))
    learned, _ = learn(template, scans)
    at = np.array([[0.0, 0.4, 0.0], [0.0, -0.4, 0.0], [5.0, 0.4, 4.0], [5.0, -0.4, 4.0]])
    assert learned.distance(at) == pytest.approx([-0.15, 0.0, -0.15, 0.0], abs=0.04)


def test_prior_of_variances_is_found_again() -> None:
    """Variances drawn from the model itself: s² ~ s0² χ²(d) / d · d0 / χ²(d0)."""
    rng = np.random.default_rng(0)
    freedom, prior_freedom, prior = 4.0, 10.0, 0.05
    true = prior**2 * prior_freedom / rng.chisquare(prior_freedom, 40_000)
    seen = np.sqrt(true * rng.chisquare(freedom, 40_000) / freedom)
    found_freedom, found = _common(seen, np.full(40_000, freedom))
    assert found_freedom == pytest.approx(prior_freedom, rel=0.1)
    assert found == pytest.approx(prior, rel=0.02)


@pytest.mark.slow
def test_scans_in_poses_of_their_own_are_laid_first_and_a_foreign_one_is_left_out() -> None:
    rng = np.random.default_rng(5)
    box = trimesh.creation.box(extents=SIZE_MM)
    box = box.difference(trimesh.creation.box(extents=(6, 6, 30)).apply_translation((12, 8, 0)))
    scans = []
    for seed in range(4):
        clean = np.asarray(trimesh.sample.sample_surface(box, 30_000, seed=seed)[0])
        if seed < 3:
            low = clean[:, 2] < -SIZE_MM[2] / 2 + FOOT_HIGH_MM
            side = low & (np.abs(clean[:, 1]) > SIZE_MM[1] / 2 - 1e-6)
            clean[side, 1] += FOOT_MM * np.sign(clean[side, 1])
        else:
            clean *= (0.5, 1.3, 2.0)  # another part
        turn = Rotation.random(random_state=rng).as_matrix()
        points = clean @ turn.T + rng.uniform(-50, 50, 3) + rng.normal(0, SIGMA_MM, clean.shape)
        scans.append(Scan(points, SIGMA_MM, "scanner", source=f"scan {seed}"))
    fit = learn_from_scans(scans, box)
    assert list(fit.left_out) == [3]
    assert [pose is None for pose in fit.poses] == [False, False, False, True]
    foot = np.array([[x, y, -7.5] for x in (-10.0, 0.0, 10.0) for y in (-15.25, 15.25)])
    # 0.25 mm by the drawing; the foot's upper edge is blurred over the distance between sites
    assert np.abs(fit.template.distance(foot)).max() < 0.5 * FOOT_MM
    high = np.array([[0.0, 15.0, 4.0], [0.0, -15.0, 4.0], [-20.0, 3.0, 2.0]])
    assert np.abs(fit.template.distance(high)).max() < 0.03
    said = fit.as_json([scan.source for scan in scans])
    assert [bool(row["left_out"]) for row in said["scans"]] == [False, False, False, True]
    assert "learned from 3 of 4 scans" in fit.template.metadata["notes"]


def test_scans_that_say_nothing_are_refused(drawn: GridSdf) -> None:
    with pytest.raises(InputError, match="no scan"):
        learn(drawn, [])
    with pytest.raises(InputError, match="scan 2 has no surface"):
        learn(drawn, [printed(0), printed(1) + 500.0], SoundOptions())
