"""What the bed beside a part tells of a scanner's errors, and that looks are judged by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from amrepair.regions.bed import by_beds, of_bed
from amrepair.regions.error_calibration import BED_BESIDE, NORMAL_BY_BED, Calibration
from amrepair.regions.options import RegionOptions
from amrepair.scans import Scan
from tests.analytic import sum_of_waves

PART_MM = np.array([[0.0, 0.0, 0.0], [30.0, 20.0, 8.0]])
TOLERANCE_MM = 0.16
OPTIONS = RegionOptions(process_sigma_mm=0.05)
SIGMA_MM = 0.03


def bed(seed: int, reach_mm: float = 15.0) -> np.ndarray:
    """(n, 3) a tilted bed around the part, as normal noise leaves it; the part's foot is unseen."""
    rng = np.random.default_rng(seed)
    low, high = PART_MM[0, :2] - reach_mm, PART_MM[1, :2] + reach_mm
    count = int(np.prod(high - low) / 0.15**2)
    points = np.column_stack([rng.uniform(low, high, (count, 2)), np.zeros(count)])
    points[:, 2] = 0.003 * points[:, 0] + 0.02 + rng.normal(0.0, SIGMA_MM, count)
    inside = ((points > PART_MM[0]) & (points < PART_MM[1]))[:, :2].all(axis=1)
    return points[~inside]


def patches(points_mm: np.ndarray, seed: int, share: float = 0.04) -> np.ndarray:
    """(n,) errors by patches of 1.5 mm, some of them far off to either side."""
    rng = np.random.default_rng([seed, 1])
    cell = np.floor(points_mm[:, :2] / 1.5).astype(int) + 100
    off = rng.exponential(0.3, (300, 300)) * rng.choice((-1.0, 1.0), (300, 300))
    off *= rng.random((300, 300)) < share
    return np.asarray(off[tuple(cell.T)])


def told(*looks: np.ndarray, options: RegionOptions = OPTIONS) -> Calibration | None:
    """What the bed tells in some looks; None where none shows enough of it."""
    scans = [Scan(points_mm.copy(), SIGMA_MM, "build") for points_mm in looks]
    beds = [of_bed(scan, PART_MM, TOLERANCE_MM, options) for scan in scans]
    seen = [bed for bed in beds if bed is not None]
    return by_beds(seen, options) if seen else None


@pytest.mark.parametrize("seed", range(3))
def test_a_bed_with_normal_noise_says_so(seed: int) -> None:
    points = bed(seed)
    assert told(points) == NORMAL_BY_BED
    # a skirt, as high as a thick first layer, lies on the bed and is no error of the scanner's
    skirt = np.abs(points[:, 0] + 5.0) < 0.4
    points[skirt, 2] += 0.3
    assert told(points) == NORMAL_BY_BED


@pytest.mark.parametrize("seed", range(3))
def test_errors_with_a_long_tail_are_learned_from_below_the_bed(seed: int) -> None:
    points = bed(seed)
    points[:, 2] += patches(points, seed)
    found = told(points)
    assert found is not None
    assert found.name == BED_BESIDE
    for width_mm in (None, 1.0):
        low, high = (found.far_off_in(width_mm, side, 1000) for side in (0, 1))
        assert low == high
        # what is left of patches of 0.3 mm in the mean beyond a tolerance of half of that
        assert 0.15 < low.spread_mm < 0.45
        assert low.exceeded_by(0.005) > 2.0 * low.spread_mm
    # a patch as narrow as that is none of a window of 8 mm
    assert found.far_off_in(8.0, 0, 1000).spread_mm == 0.0


def test_the_more_looks_show_the_bed_the_surer_it_tells() -> None:
    beds = [bed(seed) for seed in range(4)]
    for seed, points in enumerate(beds):
        points[:, 2] += patches(points, seed, share=0.01)
    one, four = told(beds[0]), told(*beds)
    assert one is not None
    assert four is not None
    assert (one.scans, four.scans) == (1, 4)
    assert four.freedom[0][0] > 2.0 * one.freedom[0][0]
    few, many = (found.far_off_in(1.0, 0, 1000) for found in (one, four))
    assert many.told_by > few.told_by
    assert many.exceeded_by(0.005) / many.spread_mm < few.exceeded_by(0.005) / few.spread_mm
    # a look that shows nothing far off is one of a scanner that did
    assert told(beds[0], bed(9)) != NORMAL_BY_BED


def test_what_lies_on_the_bed_is_no_error_of_the_scanners() -> None:
    points = bed(0)
    points[:, 2] += np.abs(patches(points, 0))
    assert told(points) == NORMAL_BY_BED


@pytest.mark.slow
def test_errors_that_hang_together_are_told_by_how_far_windows_wander() -> None:
    points = bed(0)
    ways = np.random.default_rng(3).normal(0.0, 1.0 / 4.0, (200, 2))
    waves = sum_of_waves(points[:, :2], ways.T, np.arange(200.0))
    points[:, 2] += 0.12 * np.sqrt(2.0 / 200.0) * waves
    found = told(points)
    assert found is not None
    assert found.name == BED_BESIDE
    assert 0.06 < found.wander(1.0, 1)[0] < 0.2  # 0.12 mm, and 0.05 of the process


def test_a_part_that_is_as_yet_no_higher_than_the_bed_s_errors_is_none_of_it() -> None:
    points = bed(0)
    rng = np.random.default_rng(0)
    foot = rng.uniform(PART_MM[0, :2], PART_MM[1, :2], (20_000, 2))
    holed = np.where((np.floor(foot) % 4 == 0).all(axis=1), -0.6, 0.0)  # pits all over
    first_layers = np.column_stack([foot, 0.6 + holed + rng.normal(0.0, SIGMA_MM, len(foot))])
    assert told(np.concatenate([points, first_layers])) == NORMAL_BY_BED
    assert told(first_layers) is None


def test_too_little_of_a_bed_tells_nothing() -> None:
    points = bed(0)
    strip = np.abs(points[:, 1] + 5.0) < 0.7
    assert told(points[strip]) is None
    assert told(points + np.array([200.0, 0.0, 0.0])) is None


def test_what_stands_on_the_bed_and_what_lies_beyond_its_rim_is_none_of_it() -> None:
    points = bed(0)
    post = (np.abs(points[:, :2] - [-6.0, 5.0]) < 1.0).all(axis=1)
    points[post, 2] = np.random.default_rng(0).uniform(0.0, 5.0, int(post.sum()))
    beyond = points[:, 1] < -8.0
    points[beyond, 2] -= 4.0
    for apart_mm in (1.0, 0.0):  # none apart: cells that nothing stands in are bed, not none at all
        background = replace(OPTIONS.background, bed_apart_mm=apart_mm)
        assert told(points, options=replace(OPTIONS, background=background)) == NORMAL_BY_BED
