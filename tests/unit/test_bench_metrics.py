"""Areas and distances against brute force, ties included."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amrepair.bench.metrics import (
    cloud_distance,
    detection,
    earth_movers_distance,
    mean_and_spread,
)
from amrepair.errors import InputError

# few distinct values, so that most examples have ties
ITEMS = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 4)), min_size=2, max_size=30).filter(
    lambda items: 0 < sum(label for label, _ in items) < len(items)
)


def split(items: list[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    table = np.array(items)
    return table[:, 0], table[:, 1].astype(np.float64)


@given(ITEMS)
def test_auroc_is_the_share_of_pairs_in_order(items: list[tuple[int, int]]) -> None:
    labels, scores = split(items)
    pairs = [
        1.0 if a > b else 0.5 if a == b else 0.0
        for a, b in itertools.product(scores[labels == 1], scores[labels == 0])
    ]
    assert detection(labels, scores).auroc == pytest.approx(np.mean(pairs), abs=1e-12)


@given(ITEMS)
def test_aupr_is_the_sum_over_thresholds(items: list[tuple[int, int]]) -> None:
    labels, scores = split(items)
    area, recall_before = 0.0, 0.0
    for limit in sorted(set(scores), reverse=True):
        chosen = scores >= limit
        recall = (labels[chosen] == 1).sum() / labels.sum()
        area += (recall - recall_before) * (labels[chosen] == 1).mean()
        recall_before = recall
    assert detection(labels, scores).aupr == pytest.approx(area, abs=1e-12)


@given(ITEMS, st.randoms(use_true_random=False))
def test_order_of_the_items_does_not_matter(items: list[tuple[int, int]], random: object) -> None:
    labels, scores = split(items)
    random.shuffle(items)  # type: ignore[attr-defined]
    assert detection(*split(items)) == detection(labels, scores)


def test_infinite_scores_rank_first_and_monotone_maps_change_nothing() -> None:
    labels = np.array([0, 1, 0, 1])
    assert detection(labels, np.array([0.0, np.inf, 1.0, np.inf])).auroc == 1.0
    scores = np.array([0.1, 0.4, 0.35, 0.8])
    assert detection(labels, scores).auroc == detection(labels, np.exp(5 * scores)).auroc == 1.0
    assert detection(labels, -scores).auroc == 0.0
    assert detection(labels, np.zeros(4)).auroc == 0.5


def test_one_class_alone_has_no_area() -> None:
    assert np.isnan(detection(np.zeros(3, np.int64), np.arange(3.0)).auroc)
    assert np.isnan(detection(np.ones(3, np.int64), np.arange(3.0)).aupr)


@pytest.mark.parametrize(
    ("labels", "scores", "message"),
    [
        (np.array([0, 1]), np.array([0.1]), "2 labels for 1 scores"),
        (np.array([0, 1]), np.array([0.1, np.nan]), "1 of 2 scores are NaN"),
        (np.array([0, 2]), np.array([0.1, 0.2]), "must be 0 or 1"),
    ],
)
def test_what_cannot_be_judged_is_refused(
    labels: np.ndarray, scores: np.ndarray, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        detection(labels, scores)


def test_cloud_distances_of_a_shifted_grid() -> None:
    # a grid of pitch 1 moved by 0.25: every nearest neighbour is its own image
    axis = np.arange(5.0)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    moved = grid + np.array([0.25, 0.0, 0.0])
    found = cloud_distance(grid, moved, rng=np.random.default_rng(0))
    assert found.chamfer == pytest.approx(0.5)
    assert found.chamfer_squared == pytest.approx(2 * 0.0625)
    assert found.emd == pytest.approx(0.25)


def test_earth_movers_distance_is_the_best_of_all_bijections() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    best = min(
        np.linalg.norm(a - b[list(order)], axis=1).mean()
        for order in itertools.permutations(range(6))
    )
    assert earth_movers_distance(a, b, rng=rng) == pytest.approx(best)


def test_spread_is_over_seeds_that_have_a_value() -> None:
    assert mean_and_spread(np.array([1.0, 3.0, np.nan])) == pytest.approx((2.0, np.sqrt(2.0)))
    assert mean_and_spread(np.array([4.0])) == (4.0, 0.0)
    assert np.isnan(mean_and_spread(np.array([np.nan]))[0])
