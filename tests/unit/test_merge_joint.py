"""Joint refinement of placed scans, and whether what is said of their poses is true."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from manifold3d import Manifold
from scipy.spatial import cKDTree

from amrepair.frames import moved, rotation_from_vector, ways_across
from amrepair.merge.fit import _said_weak
from amrepair.merge.fuse import Cloud, widened
from amrepair.merge.joint import slacks, together
from amrepair.merge.kept import KeptAnswers
from amrepair.merge.views import Surface, View
from amrepair.scans import Scan
from amrepair.template.learned import Tolerance
from tests.analytic import box, difference, sample_surface
from tests.draws import draws

SIGMA_MM = 0.03
SPACING_MM = 0.35
WALLS = box((0, 0, 0), (30, 20, 10)).body
STEP = difference(box((0, 0, 0), (30, 20, 10)), box((20, -1, 4), (31, 21, 6))).body  # has a slot
SLOPES = Manifold.cylinder(10.0, 15.0, 10.0, 5)  # of a pyramid: any three hold a scan


def look(
    body: Manifold, seed: int, way: tuple[float, float, float], deepest: float = -0.05
) -> View:
    """Points of the faces that look that way or across it, in the part's frame.

    The sensor went round: it saw each face from the nearest of four places, half from the side.
    """
    points, normals = sample_surface(body, SPACING_MM, seed=seed)
    rng = np.random.default_rng(seed)
    keep = normals @ np.array(way) >= deepest
    keep &= rng.random(len(points)) < 0.8
    noisy = points[keep] + rng.normal(0.0, SIGMA_MM, (int(keep.sum()), 3))
    across = np.array(ways_across(np.array(way)))
    round_ = np.array(way) / np.linalg.norm(way) + np.concatenate([across, -across])
    told = Scan(noisy, SIGMA_MM, "scanner", sensors_mm=1_000.0 * round_ + noisy.mean(axis=0),
                sensor_index=np.argmax(normals[keep] @ round_.T, axis=1),
                source=f"look{seed}")  # fmt: skip
    view = View.of(told, rng)
    # each estimated normal to the side of the true one
    order = np.lexsort(noisy.T[::-1])
    true = normals[keep][order]
    side = np.sign((view.surface.normals * true).sum(axis=1))
    return replace(view, surface=Surface.of(view.surface.points_mm,
                                            view.surface.normals * side[:, None]))  # fmt: skip


def shifted(shift: Sequence[float] | np.ndarray, turn_rad: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(np.array([0.0, 0.0, turn_rad]))
    pose[:3, 3] = shift
    return pose


UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)


def test_a_slip_along_shared_walls_is_said() -> None:
    """From above and from below of a box: the walls alone are shared, and hold no height."""
    pieces = [look(WALLS, 0, UP), look(WALLS, 1, DOWN)]
    found = slacks(pieces, [np.eye(4), np.eye(4)], np.random.default_rng(0))
    worst = max(found, key=lambda slack: slack.sigma_mm)
    assert worst.sigma_mm > 3.0 * SIGMA_MM
    assert abs(worst.axis[2]) > 0.99
    # across the walls both are held to a fraction of the noise
    x = worst.across(np.array([[30.0, 10.0, 5.0]]), np.array([[1.0, 0.0, 0.0]]))
    assert x[0] < 0.5 * SIGMA_MM


def test_a_level_face_that_both_see_holds_the_height() -> None:
    """The ledge of a step, seen by both, is all that differs."""
    ledge = look(STEP, 0, UP), look(STEP, 1, DOWN, deepest=-2.0)
    found = slacks(list(ledge), [np.eye(4), np.eye(4)], np.random.default_rng(0))
    assert max(slack.sigma_mm for slack in found) < SIGMA_MM


@pytest.mark.slow
@pytest.mark.parametrize("seeds", draws([range(3), range(8)], range(3)), ids=len)
def test_what_is_said_of_poses_is_true(seeds: range) -> None:
    """Draws of noise, points and start: errors across the surface over what is said."""
    ratios = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        ways = (UP, (0.9, 0.1, 0.4), (-0.5, 0.8, 0.4))
        pieces = [look(SLOPES, 10 * seed + k, way) for k, way in enumerate(ways)]
        start = [np.eye(4), *(shifted(rng.normal(0.0, 0.1, 3), 0.003) for _ in range(2))]
        poses, _ = together(pieces, start, rng)
        said = slacks(pieces, poses, rng)
        home = int(np.argmin([np.trace(slack.covariance) for slack in said]))
        for k in {0, 1, 2} - {home}:
            here, normals = moved(pieces[k].surface.points_mm, poses[k]), pieces[k].surface.normals
            off = here - moved(pieces[k].surface.points_mm, poses[home])
            across = np.abs((off * (normals @ poses[k][:3, :3].T)).sum(axis=1))
            ratios.append(float(across.max()) / said[k].sigma_mm)
    assert np.mean(np.array(ratios) <= 3.0) >= 0.97
    assert np.median(ratios) > 0.2  # nor is it said to be unsure where it is not


def test_scans_that_slip_as_a_group_do_not_wait_for_each_other() -> None:
    """Two on each other wholly and on the third by a ledge: one by one, neither would move."""
    pieces = [look(STEP, 0, UP), *(look(STEP, k, DOWN, deepest=-2.0) for k in (1, 2))]
    off = shifted((0.0, 0.0, 0.25))
    poses, rmse_mm = together(pieces, [np.eye(4), off, off], np.random.default_rng(0))
    assert max(abs(pose[2, 3]) for pose in poses) < 0.01
    # of a point over a plane through another: both have noise
    assert rmse_mm == pytest.approx(np.sqrt(2.0) * SIGMA_MM, rel=0.25)


@pytest.mark.slow
def test_a_sensor_that_errs_at_grazing_angles_hardly_swells_the_part() -> None:
    """Sixteen sides seen by eight looks, each side farther out the nearer to edge-on it was seen.

    Every look gains by moving outward, so that what it saw head-on lies on what its neighbours saw
    too far out: by 0.17 mm where all pairs count alike, by 0.07 mm as they do.
    """
    drum = Manifold.cylinder(20.0, 20.0, 20.0, 16)
    ways = [(np.cos(a), np.sin(a), 0.3) for a in 2.0 * np.pi * np.arange(8) / 8]
    pieces = [erring(drum, k, way) for k, way in enumerate(ways)]
    poses, _ = together(pieces, [np.eye(4)] * len(ways), np.random.default_rng(0))
    outward = [pose[:2, 3] @ way[:2] for pose, way in zip(poses, ways, strict=True)]
    assert np.mean(outward) < 0.1


def erring(body: Manifold, seed: int, way: tuple[float, float, float]) -> View:
    """One sensor's look, 0.3 mm (1 - cosine of incidence)^4 outside of the part."""
    points, normals = sample_surface(body, SPACING_MM, seed=seed)
    ahead = np.array(way) / np.linalg.norm(way)
    cosine = normals @ ahead
    keep = cosine > 0.1
    off = 0.3 * (1.0 - cosine[keep]) ** 4
    rng = np.random.default_rng(seed)
    seen = points[keep] + normals[keep] * (off + rng.normal(0.0, SIGMA_MM, len(off)))[:, None]
    scan = Scan(seen, SIGMA_MM, "scanner", sensors_mm=1_000.0 * ahead[None],
                sensor_index=np.zeros(len(seen), np.int64), source=f"look{seed}")  # fmt: skip
    return View.of(scan, rng)


def test_what_a_tree_answered_is_kept_as_long_as_it_holds() -> None:
    """Places that wander by steps of all sizes: the same pairs as of a tree asked each time."""
    rng = np.random.default_rng(0)
    tree = cKDTree(rng.uniform(0.0, 10.0, (400, 3)))
    places = rng.uniform(-2.0, 12.0, (500, 3))
    kept = KeptAnswers.of(tree, 0.8, len(places))
    for step_mm in (0.0, 0.5, 0.1, 0.02, 0.02, 0.3, 0.004, 0.02):
        places = places + step_mm * rng.normal(size=places.shape)
        distance, index = tree.query(places, distance_upper_bound=0.8)
        near = np.flatnonzero(np.isfinite(distance))
        some, found = kept.nearest(places)
        assert np.array_equal(some, near)
        assert np.array_equal(found, index[near])


def test_both_sides_of_a_thin_wall_are_no_pair() -> None:
    """A wall of one spacing, seen from either side: no view is drawn through it."""
    plate = box((0, 0, 0), (30, 20, 0.4)).body
    pieces = [look(plate, 0, UP), look(plate, 1, DOWN)]
    poses, _ = together(pieces, [np.eye(4), np.eye(4)], np.random.default_rng(0))
    assert abs(poses[1][2, 3]) < 0.1


def test_a_weak_scan_is_named_with_direction_and_size() -> None:
    pieces = [look(WALLS, 0, UP), look(WALLS, 1, DOWN)]
    said = slacks(pieces, [np.eye(4), np.eye(4)], np.random.default_rng(0))
    weak = {k: slack for k, slack in enumerate(said) if slack.sigma_mm > SIGMA_MM}
    scans = [Scan(p.surface.points_mm, SIGMA_MM, "scanner", source=p.name) for p in pieces]
    sentences = _said_weak(scans, weak)
    assert len(sentences) == 1
    name = pieces[next(iter(weak))].name
    assert sentences[0].startswith(f"{name} is held along (")
    assert f"1.00) to {next(iter(weak.values())).sigma_mm:.2f} mm only" in sentences[0]
    assert "; " not in sentences[0]  # the file's notes are parted by it


def test_tolerance_grows_where_only_a_weak_scan_looked() -> None:
    """Cells that two firm scans and a weak one saw keep theirs; the weak one's own grow."""
    rng = np.random.default_rng(0)
    points = [rng.uniform((0, 0, 0), (10, 10, 1), (2_000, 3)) for _ in range(2)]
    points.append(rng.uniform((0, 0, 0), (30, 10, 1), (6_000, 3)))
    scan = np.repeat([0, 1, 2], [len(p) for p in points])
    every = np.concatenate(points)
    cloud = Cloud(every, np.tile([0.0, 0.0, 1.0], (len(every), 1)), scan, 3, 0.2, SIGMA_MM, 0.2)
    spread = Tolerance(np.zeros(3), 1.0, np.full((30, 10, 1), 0.03, np.float32))
    wider = widened(spread, cloud, np.where(scan == 2, 0.2, 0.0))
    assert wider.spread_mm[:8] == pytest.approx(0.03)
    assert wider.spread_mm[12:] == pytest.approx(np.hypot(0.03, 0.2))
