"""Views of a merged cloud are told apart by the order of its points, or nothing is said of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from amrepair.arrays import Numbers, Points
from amrepair.frames import cells_of
from amrepair.observe.order import views_in_order, views_of
from amrepair.regions import detect
from amrepair.scans import Scan, read_scan
from tests.analytic import AnalyticTemplate, sphere
from tests.draws import draws

BALL_MM = 20.0


def view(way: Points, step_mm: float, rng: np.random.Generator) -> Points:
    """What a scanner sees of the ball from afar, row by row; each view has rows of its own."""
    beside = np.cross(way, [1.0, 0.0, 0.0] if abs(way[0]) < 0.9 else [0.0, 1.0, 0.0])
    beside /= np.linalg.norm(beside)
    turn = rng.uniform(0.0, 2 * np.pi)
    beside = np.cos(turn) * beside + np.sin(turn) * np.cross(way, beside)
    axis = np.arange(-BALL_MM, BALL_MM, step_mm) + rng.uniform(0.0, step_mm)
    row, column = (at.ravel() for at in np.meshgrid(axis, axis, indexing="ij"))
    met = row**2 + column**2 < 0.95 * BALL_MM**2
    height = np.sqrt(BALL_MM**2 - row[met] ** 2 - column[met] ** 2)
    seen = np.column_stack([row[met], column[met], height])
    points = seen @ np.array([beside, np.cross(way, beside), way])
    return np.asarray(points + rng.normal(scale=0.03, size=(len(points), 1)) * points / BALL_MM)


def views(count: int, seed: int, step_mm: float = 0.4) -> tuple[Points, Numbers]:
    """Views from random sides, one after the other, and which of them saw each point."""
    rng = np.random.default_rng(seed)
    ways = rng.normal(size=(count, 3))
    ways[1::2] += 2.0 * ways[: count // 2 * 2 : 2]  # every second sees much of what the first saw
    clouds = [view(way / np.linalg.norm(way), step_mm, rng) for way in ways]
    return np.concatenate(clouds), np.repeat(np.arange(count), [len(c) for c in clouds])


@settings(max_examples=8, deadline=None)
@given(count=st.integers(2, 9), seed=st.integers(0, 100), every=st.integers(1, 4))
def test_points_are_told_to_be_of_one_view_or_of_two(count: int, seed: int, every: int) -> None:
    points, truth = (told[::every] for told in views(count, seed))
    one, other = cKDTree(points).query_pairs(0.5 * every, output_type="ndarray").T
    of_two = truth[one] != truth[other]
    assume(of_two.mean() > 0.1)  # views that see nothing of each other are as good as one
    told = views_in_order(points)
    assert told is not None
    apart = told[one] != told[other]
    assert apart[of_two].mean() > 0.98  # all but a row or two at the views' ends
    assert apart[~of_two].mean() < 0.02


def mixed(points: Points) -> Points:
    return np.random.default_rng(1).permutation(points)


def by_height(points: Points) -> Points:
    return points[np.argsort(points[:, 2])]


def in_blocks(points: Points, edge_mm: float) -> Points:
    """As a cloud that was fused in blocks of a grid is written."""
    cells = cells_of(points, 0.0, edge_mm)
    return points[np.lexsort((cells[:, 2], cells[:, 1], cells[:, 0]))]


@pytest.mark.parametrize("edge_mm", draws([1.0, 3.0, 6.0, 12.0], 3.0))
def test_blocks_of_a_fused_cloud_are_no_views(edge_mm: float) -> None:
    assert views_in_order(in_blocks(views(6, 3)[0], edge_mm)) is None


def test_of_mixed_points_nothing_is_said() -> None:
    points = views(6, 4)[0]
    assert views_in_order(mixed(points)) is None
    assert views_in_order(by_height(points)) is None
    # regression: of points that lie sparsely nearly all pairs are far apart, mixed or not
    assert views_in_order(mixed(points)[::4]) is None


@pytest.mark.parametrize("step_mm", draws([0.15, 0.3, 1.0], 0.3, 1.0))
def test_rows_of_a_single_view_are_no_views(step_mm: float) -> None:
    assert views_in_order(views(1, 5, step_mm)[0]) is None


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_few_points_tell_nothing(count: int) -> None:
    assert views_in_order(np.zeros((count, 3))) is None
    assert views_in_order(np.arange(3.0 * count).reshape(-1, 3)) is None


def test_what_the_scan_says_itself_counts() -> None:
    points, truth = views(3, 6)
    index = np.arange(len(points)) % 2
    told = views_of(Scan(points, 0.03, "scanner", None, np.zeros((2, 3)), index))
    assert told is not None
    assert told.tolist() == index.tolist()
    untold = views_of(Scan(points, 0.03, "scanner"))
    assert untold is not None
    assert np.mean(untold != truth) < 0.01


@pytest.fixture(scope="module")
def ball() -> AnalyticTemplate:
    return sphere((0, 0, 0), BALL_MM)


def test_a_view_that_contradicts_the_others_is_found_without_its_sensor(
    ball: AnalyticTemplate,
) -> None:
    points, truth = views(6, 8)
    points = points + np.where((truth == 2)[:, None], [0.8, 0.0, 0.0], 0.0)
    found = detect(Scan(points, 0.03, "template"), ball)
    assert [one.view for one in found.contradicting] == [2]
    assert found.regions == ()


def test_what_one_view_says_otherwise_is_its_error(ball: AnalyticTemplate) -> None:
    # regression: without sensors an error that all of a view shares was a defect where no other
    # view saw the place
    points, truth = views(6, 9)
    away = points / np.linalg.norm(points, axis=1, keepdims=True)
    points = points - (0.25 * (truth == 3))[:, None] * away
    assert detect(Scan(points, 0.03, "template"), ball, pose="stands").regions == ()
    assert detect(Scan(mixed(points), 0.03, "template"), ball, pose="stands").regions != ()


def test_range_images_of_a_real_scanner(data_dir: Path) -> None:
    clouds = []
    for file in sorted((data_dir / "real" / "bunny").glob("bun[0-9]*.ply")):
        turn = Rotation.from_euler("y", float(file.stem[3:]), degrees=True)  # roughly in place
        clouds.append(turn.apply(np.array(read_scan(file, frame="scanner", unit="m").points_mm)))
    told = views_in_order(np.concatenate(clouds))
    assert told is not None
    truth = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    assert np.mean(told != truth) < 0.01
