"""Features, banks and baselines against brute force and shapes whose answer is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from amrepair.bench import BENCH_METHODS, shapenet
from amrepair.bench.baselines import BankMethod, fpfh_features, raw_features, reweighted
from amrepair.bench.cells import Cell, _judge
from amrepair.bench.features import coreset, fill_in, fpfh, nearest
from amrepair.bench.method import ClassInput, noise_mm
from amrepair.bench.metrics import detection
from amrepair.bench.paper import Target
from amrepair.bench.registry import BASELINES, PUBLISHED, make_method
from amrepair.bench.samples import BenchClass, Format, Sample, read_points
from amrepair.bench.synth_views import random_rotation
from amrepair.errors import InputError
from tests.draws import draws


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize("width", [3, 33])
def test_nearest_is_brute_force(rng: np.random.Generator, width: int) -> None:
    # far from the origin, where an expanded square loses its digits
    queries = (rng.normal(size=(700, width)) + 50).astype(np.float32)
    bank = (rng.normal(size=(300, width)) + 50).astype(np.float32)
    gaps = np.linalg.norm(queries[:, None].astype(float) - bank[None].astype(float), axis=2)
    distance, index = nearest(queries, bank)
    assert np.allclose(distance, gaps.min(axis=1), rtol=1e-3)
    assert np.allclose(gaps[np.arange(700), index], distance, atol=1e-6)


def test_coreset_is_the_greedy_k_centre(rng: np.random.Generator) -> None:
    rows = rng.normal(size=(60, 5)).astype(np.float32)
    found = coreset(rows, 12, np.random.default_rng(3))
    expected = [int(np.random.default_rng(3).integers(60))]
    while len(expected) < 12:
        gaps = np.linalg.norm(rows[:, None] - rows[expected][None], axis=2).min(axis=1)
        expected.append(int(np.argmax(gaps)))
    assert found.tolist() == expected
    assert coreset(rows, 100, rng).tolist() == list(range(60))


def test_filling_in_keeps_known_values_and_reproduces_constants(rng: np.random.Generator) -> None:
    points = rng.uniform(0, 10, (200, 3))
    chosen = np.sort(rng.permutation(200)[:50])
    values = rng.uniform(size=50)
    full = fill_in(points, chosen, values)
    assert np.allclose(full[chosen], values, atol=1e-6)
    assert values.min() - 1e-9 <= full.min()
    assert full.max() <= values.max() + 1e-9
    assert np.allclose(fill_in(points, chosen, np.full(50, 2.5)), 2.5)
    order = rng.permutation(200)
    assert np.allclose(fill_in(points, order, points[order, 0]), points[:, 0])


def test_fpfh_does_not_change_with_the_pose(rng: np.random.Generator) -> None:
    # on a convex, closed surface sampled densely; normals' signs are free, so compare medians
    points = rng.normal(size=(3000, 3)) * (1.0, 0.7, 0.4)
    points *= 20 / np.linalg.norm(points, axis=1, keepdims=True)
    found = fpfh(points, 1.5)
    assert found.shape == (3000, 33)
    # three histograms of 11 bins, each a weighted sum of histograms that add up to 100
    assert np.isfinite(found).all()
    turned = fpfh(points @ random_rotation(rng).T + 5.0, 1.5)
    assert np.median(np.abs(turned - found)) < 0.02 * np.median(np.abs(found).max(axis=1))


def test_reweighting_lowers_the_score_where_the_bank_is_sparse() -> None:
    dense = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])
    sparse = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]])
    query, distance = np.array([[1.0, 1.0]]), np.array([np.sqrt(2.0)])
    assert 0 < reweighted(query, distance, dense) < distance[0]
    assert reweighted(query, distance, dense) < reweighted(query, distance, sparse)


def sphere(rng: np.random.Generator, count: int, bump: bool) -> tuple[np.ndarray, np.ndarray]:
    """A sphere of 50 mm radius, labels on a spherical bump of 4 mm."""
    unit = rng.normal(size=(count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    angle = np.arccos(unit[:, 2])
    height = np.where(angle < 0.25, 4.0 * np.cos(angle / 0.25 * np.pi / 2), 0.0) * bump
    return unit * (50.0 + height)[:, None], (height > 0.2).astype(int)


@pytest.mark.parametrize("name", draws(BASELINES, "patchcore-fpfh", "btf-raw"))
def test_a_bump_on_a_sphere_scores_higher(
    rng: np.random.Generator, tmp_path: Path, name: str
) -> None:
    train = tuple(sphere(rng, 4000, False)[0] for _ in range(2))
    data = ClassInput("ball", Format.SHAPENET, train, None, 0.05, 1.0)
    model = make_method(name).fit(data, seed=0, cache=tmp_path)
    points, labels = sphere(rng, 4000, True)
    bumped = model.score(points, np.random.default_rng(1))
    plain = model.score(sphere(rng, 4000, False)[0], np.random.default_rng(1))
    assert bumped.point.shape == (4000,)
    assert (
        detection(labels, bumped.point).auroc > 0.85
    )  # a sphere has one normal feature: easy for all
    if "fpfh" in name:  # the sphere's mean moves with the bump, which hides it from raw maxima
        assert bumped.whole > plain.whole
    again = make_method(name).fit(data, seed=0, cache=tmp_path)
    assert np.array_equal(again.score(points, np.random.default_rng(1)).point, bumped.point)


def test_only_a_share_of_a_large_cloud_is_asked(
    rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("amrepair.bench.baselines.QUERIES", 500)
    data = ClassInput("ball", Format.SHAPENET, (sphere(rng, 3000, False)[0],), None, 0.05, 1.0)
    model = BankMethod((raw_features,), greedy=False).fit(data, seed=0, cache=tmp_path)
    points, labels = sphere(rng, 3000, True)
    scores = model.score(points, np.random.default_rng(0))
    assert len(scores.point) == 3000
    assert detection(labels, scores.point).auroc > 0.8


def test_noise_is_estimated_within_a_fifth(rng: np.random.Generator) -> None:
    for sigma_mm in (0.02, 0.1):
        points = sphere(rng, 40_000, False)[0]
        points = points + rng.normal(0, sigma_mm, points.shape)
        assert noise_mm(points) == pytest.approx(sigma_mm, rel=0.2)


def test_names_are_those_of_the_contract() -> None:
    assert set(BENCH_METHODS) == {
        "pasdf",
        "pasdf-paper",
        *(f"{name}{pam}" for name in BASELINES for pam in ("", "+pam")),
        *(f"patchcore-{name}{pam}" for name in ("pointmae", "pointbert") for pam in ("", "+pam")),
    }
    with pytest.raises(InputError, match="method 'm3dm' is unknown; choose from pasdf"):
        make_method("m3dm")
    assert PUBLISHED[Format.SHAPENET]["patchcore-fpfh+pam"] == (81.4, 86.7)
    assert fpfh_features(np.random.default_rng(0).normal(size=(50, 3)))[0].shape == (50, 33)


@pytest.mark.parametrize(("off_mm", "low", "high"), [(0.0, 0.0, 0.1), (1.0, 0.9, 1.1)])
def test_a_residual_over_a_sparse_cloud_is_not_its_spacing(
    rng: np.random.Generator, off_mm: float, low: float, high: float
) -> None:
    """Points every 0.8 mm, noise 0.05: a good pose was told to be 0.4 mm off, beyond any limit."""

    def ball(count: int) -> np.ndarray:
        way = rng.normal(size=(count, 3))
        way /= np.linalg.norm(way, axis=1)[:, None]
        return (50.0 + rng.normal(0.0, 0.05, count))[:, None] * way

    data = ClassInput("ball", Format.REAL3D, (ball(50_000),), None, 0.05, 1.0)
    found = Target.of(data).residual(ball(3_000) * (1.0 + off_mm / 50.0))
    assert low <= float(np.median(found)) <= high


def test_a_residual_beside_a_cloud_is_the_way_to_it(rng: np.random.Generator) -> None:
    plate = np.column_stack([rng.uniform(0.0, 50.0, (20_000, 2)), rng.normal(0.0, 0.02, 20_000)])
    data = ClassInput("plate", Format.REAL3D, (plate,), None, 0.02, 1.0)
    found = Target.of(data).residual(np.array([[70.0, 25.0, 0.0]]))  # in its plane
    assert found[0] == pytest.approx(20.0, rel=0.1)


def test_a_sample_that_pam_gave_up_on_is_badly_aligned_once(tmp_path: Path) -> None:
    """Its last pose lies off as well: 20 of 15 were badly aligned."""
    names = ("off", "gone", "good")
    samples = tuple(
        Sample("c0", name, name, tmp_path, None if name == "good" else tmp_path, shapenet.load)
        for name in names
    )
    one = BenchClass("c0", (), None, samples, read_points)
    cell = Cell("pasdf-paper", one, Format.SHAPENET, 0, tmp_path)
    cell.folder.mkdir(parents=True)
    scored = {"score": np.arange(4.0), "label": np.array([0, 0, 1, 1])}
    for name, residual_mm in zip(names, (1.0, 1.0, 0.05), strict=True):
        said = {"whole": 1.0, "seconds": 1.0, "residual_mm": residual_mm, "aligned": name != "gone"}
        np.savez(cell.folder / f"{name}.npz", **scored, **said)
    fit = dict.fromkeys(
        ("seconds", "sigma_mm", "cd", "emd", "cd_squared", "to_surface", "from_surface"), 0.0
    )
    row = _judge(cell, dict(fit))
    assert (row.failed_alignments, row.badly_aligned) == (1, 2)  # the good one has no noise at all
