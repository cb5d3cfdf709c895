"""What views say differently of a place counts in its error, by how many of them saw it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from amrepair.field.scales import scales_of
from amrepair.observe.robust import MAD_TO_SIGMA
from amrepair.observe.views import Shares
from amrepair.regions import significance
from amrepair.regions.between_views import Said, ViewErrors
from amrepair.regions.error_calibration import NORMAL_NOISE
from amrepair.regions.inspected import Inspected
from amrepair.regions.options import RegionOptions

CELL_MM, ACROSS_MM, VIEWS, POINTS = 0.5, 30.0, 5, 4
SPREAD_MM, NOISE_MM = 0.06, 0.02  # of a view's own waves, and of a cell of it
WAVE_MM = 12.0


def plate(seed: int, *, all_mm: float = 0.0, spread_mm: float = SPREAD_MM) -> Inspected:
    """A plate that lies so far off in all views; each errs by waves of its own, and by noise.

    The last fifth of it was seen by the first view alone.
    """
    rng = np.random.default_rng(seed)
    axis = np.arange(0.5 * CELL_MM, ACROSS_MM, CELL_MM)
    x, y = (each.ravel() for each in np.meshgrid(axis, axis))
    phase = rng.uniform(0.0, 2 * np.pi, (2, VIEWS, 1))
    waves = [np.sin(2 * np.pi * at / WAVE_MM + by) for at, by in zip((x, y), phase, strict=True)]
    said_mm = all_mm + 2.0 * spread_mm * waves[0] * waves[1]
    said_mm += rng.normal(scale=NOISE_MM, size=said_mm.shape)
    seen = np.ones(said_mm.shape, bool)
    seen[1:, y > 0.8 * ACROSS_MM] = False
    return seen_by(np.column_stack([x, y, np.full(len(x), 0.5 * CELL_MM)]), said_mm, seen)


def seen_by(place_mm: np.ndarray, said_mm: np.ndarray, seen: np.ndarray) -> Inspected:
    """Cells of a plane that faces up, with what views said of each, where they saw it."""
    n = len(place_mm)
    place, view = np.nonzero(seen.T)
    count = np.full(len(place), POINTS)
    return Inspected(
        cells=n,
        cell_mm=CELL_MM,
        place_mm=place_mm,
        normal=np.tile([0.0, 0.0, 1.0], (n, 1)),
        value_mm=np.where(seen, said_mm, 0.0).sum(axis=0) / seen.sum(axis=0),
        weight=(POINTS * seen.sum(axis=0)).astype(np.float64),
        tolerance_mm=np.full((2, n), 0.12),
        facing=np.ones(n),
        pose_mm=np.zeros(n),
        shares=Shares(place, view, said_mm[view, place], count),
    )


def told(inspected: Inspected) -> list[tuple[float, ViewErrors]]:
    """By width of windows."""
    scales = scales_of(
        inspected.place_mm, inspected.normal, inspected.value_mm, inspected.weight,
        cell_mm=CELL_MM, widest_mm=7.0,
    )  # fmt: skip
    said = Said.of(inspected)
    return [(scale.width_mm, ViewErrors.of(scale, said)) for scale in scales]


def test_a_view_errs_over_narrow_windows_by_its_waves_and_hardly_over_wide_ones() -> None:
    narrow, _, wide = (errors.one_mm for _, errors in told(plate(0)))
    assert narrow == pytest.approx(SPREAD_MM, rel=0.25)
    assert wide < 0.8 * narrow  # half a wave wide
    (_, noise), *_ = told(plate(0, spread_mm=0.0))
    assert noise.one_mm < 1.2 * NOISE_MM / 3.0  # of nine cells


def test_what_all_views_see_alike_is_no_error_of_theirs() -> None:
    for (_, sound), (_, low) in zip(told(plate(1)), told(plate(1, all_mm=-0.4)), strict=True):
        assert low.one_mm == pytest.approx(sound.one_mm, rel=1e-6)


def test_what_one_view_says_against_the_others_counts_where_it_lies_cells_deep() -> None:
    # regression: cells of one view alone, 0.7 mm below those of another, were compared with none
    deep_mm = 0.7
    plain = plate(2).place_mm
    n = len(plain)
    below = np.arange(2 * n) >= n
    value_mm = np.where(below, -deep_mm, 0.0)
    place_mm = np.concatenate([plain, plain - [0.0, 0.0, deep_mm - 0.5 * CELL_MM]])
    both = seen_by(place_mm, np.stack([value_mm, value_mm]), np.stack([~below, below]))
    said = Said.of(both)
    assert said is not None
    assert len(said.points) == n
    (_, narrow), *_ = told(both)
    assert narrow.one_mm == pytest.approx(MAD_TO_SIGMA * deep_mm / np.sqrt(2.0))


def test_a_place_that_one_view_saw_errs_as_one_view_does() -> None:
    inspected = plate(3)
    levels = significance.tested(inspected, RegionOptions(process_sigma_mm=0.05), NORMAL_NOISE)
    for level in levels:
        y = level.scale.place_mm[:, 1]
        alone, all_of_them = y > 0.8 * ACROSS_MM + 3.0, y < 0.8 * ACROSS_MM - 8.0
        one, mean = (np.median(level.error_mm[where]) for where in (alone, all_of_them))
        assert one > 1.5 * mean
    # and where views agree to their noise, nothing is added to it
    for level in significance.tested(plate(3, spread_mm=0.0), RegionOptions(), NORMAL_NOISE)[1:]:
        assert float(np.median(level.errors.common_mm)) == 0.0


def test_of_cells_of_one_view_each_a_median_is_worth_what_their_number_says() -> None:
    # seven cells of one view among nine: many points in the others' two do not outvote them
    grid = np.stack(np.meshgrid(*2 * [np.arange(3) * CELL_MM + 0.25]), axis=-1).reshape(-1, 2)
    place_mm = np.column_stack([grid, np.full(9, 0.25)])
    view = np.array([0] * 7 + [1, 2])
    seen = np.arange(3)[:, None] == view
    inspected = seen_by(place_mm, np.zeros((3, 9)), seen)
    shares = inspected.shares
    assert shares is not None
    inspected = replace(inspected, shares=replace(shares, count=np.where(view > 0, 60, 4)))
    scale = scales_of(
        inspected.place_mm, inspected.normal, inspected.value_mm, inspected.weight,
        cell_mm=CELL_MM, widest_mm=2.0,
    )[0]  # fmt: skip
    errors = ViewErrors.of(scale, Said.of(inspected))
    middle = int(np.argmax(scale.count))
    assert scale.count[middle] == 9
    assert errors.window_by[middle] == pytest.approx(81.0 / (49.0 + 1.0 + 1.0))
    assert errors.cell_by[middle] == pytest.approx(1.0)


@pytest.mark.parametrize("all_mm", [0.0, -0.6])
def test_a_window_is_no_surer_than_its_views_are_apart(all_mm: float) -> None:
    # regression: one view erred by a whole patch, and had more points there than the one that did
    # not
    inspected = plate(4, spread_mm=0.0)
    place_mm = inspected.place_mm
    patch = np.hypot(*(place_mm[:, :2] - 0.4 * ACROSS_MM).T) < 2.0
    said_mm = np.random.default_rng(4).normal(scale=NOISE_MM, size=(VIEWS, len(patch)))
    said_mm[:, patch] += all_mm
    said_mm[0, patch] = -0.6
    seen = np.ones(said_mm.shape, bool)
    seen[2:, patch] = False
    told_by = seen_by(place_mm, said_mm, seen)
    assert told_by.shares is not None
    count = np.where(patch[told_by.shares.place] & (told_by.shares.view == 0), 40, 2)
    value_mm = np.bincount(told_by.shares.place, count * told_by.shares.value_mm)
    value_mm /= np.bincount(told_by.shares.place, count)
    told_by = replace(told_by, value_mm=value_mm, shares=replace(told_by.shares, count=count))
    assert np.median(value_mm[patch]) < -0.5
    medians = significance.tested(told_by, RegionOptions(), None)[1:]
    found = any(level.rejected[0].any() for level in medians)
    assert found == (all_mm < 0.0)
