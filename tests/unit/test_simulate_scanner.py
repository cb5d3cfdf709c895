"""The simulated scanner against solids of known shape."""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest

from amrepair.errors import ScannerError
from amrepair.scans.scanner import ScanRequest
from amrepair.simulate.parameters import ScannerModel
from amrepair.simulate.scanner import (
    SimulatedScanner,
    default_sensors_mm,
    seeded_pose,
)
from amrepair.simulate.world import World

REQUEST = ScanRequest("final", None, 8.0)
CENTRE = (30.0, 30.0)


def scanner(
    world: World, seed: int = 0, sigma_mm: float = 0.0, oblique: int = 4
) -> SimulatedScanner:
    return SimulatedScanner(
        world,
        pose=seeded_pose(np.random.default_rng(seed), centre_mm=CENTRE),
        sensors_mm=default_sensors_mm(CENTRE, oblique=oblique),
        rng=np.random.default_rng(seed),
        model=ScannerModel(sigma_mm=sigma_mm, spacing_mm=0.3),
    )


def seen_in_build(device: SimulatedScanner) -> np.ndarray:
    return device._pose.build_from_scanner_true.apply(device.scan(REQUEST).points_mm)


def box_world(turn_deg: float) -> tuple[World, m3.Manifold]:
    world = World((60.0, 60.0))
    box = m3.Manifold.cube((16, 12, 8)).translate((-8, -6, 0)).rotate((0, 0, turn_deg))
    box = box.translate((30.02, 30.05, 0))
    world.add(box)
    return world, box


@pytest.mark.parametrize("turn_deg", [0.0, 17.0, 40.0])
def test_walls_and_top_are_seen_where_they_are(turn_deg: float) -> None:
    world, _ = box_world(turn_deg)
    points = seen_in_build(scanner(world))
    angle = np.deg2rad(turn_deg)
    local = (points[:, :2] - (30.02, 30.05)) @ np.array(
        [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    )
    top = points[(points[:, 2] > 6) & (np.abs(local) < (7, 5)).all(axis=1)]
    assert len(top) > 500
    np.testing.assert_allclose(top[:, 2], 8.0, atol=0.01)
    middle = (points[:, 2] > 1) & (points[:, 2] < 7)
    for axis, half in ((0, 8.0), (1, 6.0)):
        other = np.abs(local[:, 1 - axis]) < (4.0, 6.0)[axis == 1]
        for sign in (-1, 1):
            wall = sign * local[middle & other & (sign * local[:, axis] > 1.0), axis]
            assert len(wall) > 100
            # a column's centre decides whether it is solid: the raster itself may be off by
            # half a column on a wall along the grid, and by much less on a turned one
            assert wall.mean() == pytest.approx(half, abs=0.064 if turn_deg == 0 else 0.015)


def test_no_bed_is_measured_between_what_stands_apart() -> None:
    # regression: one box held a part and the line that primes the nozzle at the bed's other edge
    world, _ = box_world(0.0)
    alone = len(seen_in_build(scanner(world)))
    world.add(m3.Manifold.cube((1, 50, 0.2)).translate((1, 5, 0)))
    x = seen_in_build(scanner(world))[:, 0]
    margin_mm = ScannerModel().bed_margin_mm
    line_mm, part_mm = 2.0 + margin_mm, 22.0 - margin_mm
    assert np.count_nonzero(x < line_mm + 0.1) > 1000
    assert np.count_nonzero((x > line_mm + 0.1) & (x < part_mm - 0.1)) == 0
    assert np.count_nonzero(x > part_mm - 0.1) == pytest.approx(alone, rel=0.01)


def test_what_no_ray_reaches_is_not_seen() -> None:
    world = World((60.0, 60.0))
    world.add(m3.Manifold.cube((10, 10, 2)).translate((25, 25, 10)))  # a plate in the air
    world.add(m3.Manifold.cube((2, 2, 10)).translate((29, 29, 0)))
    points = seen_in_build(scanner(world, oblique=0))
    under = (np.abs(points[:, :2] - 30.0) < 4.5).all(axis=1) & (points[:, 2] < 9.0)
    assert not under.any()
    assert (points[:, 2] > 11.9).sum() > 500


def test_noise_is_as_stated_and_points_carry_their_sensor() -> None:
    world, _ = box_world(0.0)
    device = scanner(world, sigma_mm=0.05, oblique=0)
    scan = device.scan(REQUEST)
    points = device._pose.build_from_scanner_true.apply(scan.points_mm)
    top = points[(np.abs(points[:, :2] - 30.0) < 5.0).all(axis=1), 2]
    assert top.std() == pytest.approx(0.05, rel=0.1)  # square incidence; 1000+ points
    assert scan.frame == "scanner"
    assert scan.sensors_mm is not None
    assert scan.sensor_index is not None
    np.testing.assert_allclose(
        device._pose.build_from_scanner_true.apply(scan.sensors_mm),
        default_sensors_mm(CENTRE, oblique=0),
    )


def test_calibration_is_off_by_as_much_as_stated() -> None:
    pose = seeded_pose(np.random.default_rng(3), centre_mm=CENTRE)
    error = pose.build_from_scanner_calibrated @ pose.build_from_scanner_true.inverse()
    moved = error.apply(np.array([[*CENTRE, 0.0]]))[0] - (*CENTRE, 0.0)
    assert np.linalg.norm(moved) == pytest.approx(0.1, abs=1e-9)
    angle = np.arccos(np.clip((np.trace(error.rotation) - 1) / 2, -1, 1))
    assert np.rad2deg(angle) == pytest.approx(0.05, rel=1e-3)


def test_same_seed_same_scan() -> None:
    world, _ = box_world(10.0)
    first, second, other = (scanner(world, s, 0.03).scan(REQUEST) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.points_mm, second.points_mm)
    assert first.points_mm.shape != other.points_mm.shape or not np.array_equal(
        first.points_mm, other.points_mm
    )


def test_empty_bed_and_low_sensor_are_refused() -> None:
    with pytest.raises(ScannerError, match="empty bed"):
        scanner(World((60.0, 60.0))).scan(REQUEST)
    world = World((60.0, 60.0))
    world.add(m3.Manifold.cube((5, 5, 250)).translate((30, 30, 0)))
    with pytest.raises(ScannerError, match="higher"):
        scanner(world).scan(REQUEST)


def test_dropouts_and_outliers_are_as_many_and_as_far_as_told() -> None:
    world, _ = box_world(0.0)

    def tops(model: ScannerModel) -> np.ndarray:
        device = SimulatedScanner(
            world,
            pose=seeded_pose(np.random.default_rng(0), centre_mm=CENTRE),
            sensors_mm=default_sensors_mm(CENTRE, oblique=0),
            rng=np.random.default_rng(0),
            model=model,
        )
        points = seen_in_build(device)
        inside = (np.abs(points[:, :2] - (30.02, 30.05)) < (7.0, 5.0)).all(axis=1)
        return points[inside, 2]

    whole = tops(ScannerModel(sigma_mm=0.0, spacing_mm=0.15))
    fewer = tops(ScannerModel(sigma_mm=0.0, spacing_mm=0.15, dropout_ratio=0.2))
    # from above the surface is square; some 6,000 points, so the share is good to half a per cent
    assert len(fewer) / len(whole) == pytest.approx(0.8, abs=0.02)
    shiny = ScannerModel(sigma_mm=0.0, spacing_mm=0.15, outlier_ratio=0.1, outlier_mm=0.4)
    off_mm = np.abs(tops(shiny) - 8.0)
    far = off_mm[off_mm > 0.02]
    assert len(far) / len(off_mm) == pytest.approx(0.1 * np.exp(-0.02 / 0.4), abs=0.015)
    assert far.mean() == pytest.approx(0.42, abs=0.06)  # beyond 0.02 mm, 0.4 mm more on average
