"""Views that contradict the others are named, measured and left out; views that agree are not."""

from __future__ import annotations

import numpy as np
import pytest

from amrepair.observe.incidence import incidence
from amrepair.observe.rays import MIN_COSINE
from amrepair.regions import detect
from amrepair.regions.error_calibration import NORMAL_NOISE
from amrepair.scans import RangeGrid, Scan
from tests.analytic import AnalyticTemplate, sample_surface, sphere
from tests.draws import draws

BALL_MM, VIEWS = 20.0, 4


@pytest.fixture(scope="module")
def ball() -> AnalyticTemplate:
    return sphere((0, 0, 0), BALL_MM)


def views(
    ball: AnalyticTemplate,
    seed: int,
    count: int = VIEWS,
    *,
    off_mm: float = 0.0,
    of: int = 0,
    wave_mm: float = 0.0,
) -> Scan:
    """Views from all around, each of its half; one of them lies aside by so much, along x.

    Each errs on its own by three waves, so many millimetres high, which hang together over 6 mm.
    """
    rng = np.random.default_rng(seed)
    clouds, ways = [], []
    for k in range(count):
        turn = 2 * np.pi * k / count
        way = np.array([np.sin(turn), 0.3, np.cos(turn)]) / np.hypot(1.0, 0.3)
        points, normals = sample_surface(ball.body, 0.5, seed=10 * seed + k)
        seen = normals @ way > 0.1
        noise = rng.normal(scale=0.03, size=(int(seen.sum()), 1))
        if wave_mm:
            waves = np.sin(2 * np.pi * points[seen] / 12.0 + rng.uniform(0.0, 2 * np.pi, 3))
            noise += wave_mm * waves.sum(axis=1, keepdims=True)
        shift = np.array([off_mm if k == of else 0.0, 0.0, 0.0])
        clouds.append(points[seen] + noise * normals[seen] + shift)
        ways.append(200.0 * way)
    index = np.repeat(np.arange(count), [len(cloud) for cloud in clouds])
    points = np.concatenate(clouds)
    return Scan(points, 0.04, "template", sensors_mm=np.array(ways), sensor_index=index)


@pytest.mark.parametrize("of", draws([0, 2], 2))
def test_the_view_is_named_measured_and_left_out(ball: AnalyticTemplate, of: int) -> None:
    found = detect(views(ball, 1, off_mm=1.0, of=of), ball)
    (one,) = found.contradicting
    assert one.view == of
    assert 0.3 < one.apart_mm < 1.0  # a shift of 1 mm, seen at all angles
    assert f"View {of + 1} contradicts the others by 0." in found.told()[0]
    assert "the result is without it" in found.told()[0]
    assert one.to_json()["view"] == of + 1
    assert found.regions == ()  # what it said is no defect, either
    assert len(found.label) == len(found.points_mm)


def test_of_two_views_it_is_the_one_that_lies_off_the_template(ball: AnalyticTemplate) -> None:
    (one,) = detect(views(ball, 2, count=2, off_mm=1.2, of=1), ball).contradicting
    assert one.view == 1


@pytest.mark.parametrize("seed", range(3))
def test_views_that_agree_are_all_kept(ball: AnalyticTemplate, seed: int) -> None:
    found = detect(views(ball, seed, off_mm=0.05), ball)
    assert found.contradicting == ()
    assert found.regions == ()


def test_a_dent_that_several_views_see_is_no_contradiction(ball: AnalyticTemplate) -> None:
    scan = views(ball, 3)
    points = scan.points_mm.copy()
    deep = np.maximum(1.5 - (points[:, 0] ** 2 + points[:, 1] ** 2) / 10.0, 0.0)
    points[:, 2] -= np.where(points[:, 2] > 0, deep, 0.0)
    found = detect(Scan(points, 0.04, "template", None, scan.sensors_mm, scan.sensor_index), ball)
    assert found.contradicting == ()
    assert [region.label.name for region in found.regions] == ["MISSING"]


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_where_the_pose_is_told_views_that_err_on_their_own_are_no_defect(
    ball: AnalyticTemplate, seed: int
) -> None:
    # regression: of a layer, what views disagree by was left out of its error
    scan = views(ball, seed, wave_mm=0.08)  # two false regions, before it counted
    found = detect(scan, ball, pose="told", calibration=NORMAL_NOISE)
    assert found.regions == ()
    assert found.calibration == NORMAL_NOISE


def test_a_range_image_is_one_view_however_many_places_its_sensor_passed() -> None:
    points = np.stack(np.meshgrid(np.arange(6.0), np.arange(4.0), [0.0]), axis=-1).reshape(-1, 3)
    index = np.repeat(np.arange(4), 6)
    grid = RangeGrid(np.arange(24, dtype=np.int32).reshape(4, 6), "pushbroom")
    sensors = np.full((4, 3), 100.0)
    told = Scan(points, 0.04, "scanner", None, sensors, index)
    assert told.view_index is not None
    assert told.view_index.tolist() == index.tolist()
    assert Scan(points, 0.04, "scanner", None, sensors, index, grids=(grid,)).view_index is None
    halves = tuple(
        RangeGrid(np.arange(12, dtype=np.int32).reshape(2, 6) + 12 * k, "perspective")
        for k in range(2)
    )
    two = Scan(points, 0.04, "scanner", None, sensors, index, grids=halves).view_index
    assert two is not None
    assert two.tolist() == [0] * 12 + [1] * 12


def test_incidence_is_what_the_sensor_or_the_single_view_says() -> None:
    rng = np.random.default_rng(4)
    normal = rng.normal(size=(4000, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    way = np.array([0.36, 0.48, 0.8])
    cosine = np.maximum(normal @ way, MIN_COSINE)
    told = incidence(normal, 300.0 * np.broadcast_to(way, normal.shape))
    assert told == pytest.approx(cosine)
    assert (incidence(normal, None) == 1.0).all()  # seen from all around: nobody knows
    half = normal @ way > 0.15
    found = incidence(normal[half], None)
    assert np.abs(found - cosine[half]).max() < 0.2  # the way is known to some degrees
