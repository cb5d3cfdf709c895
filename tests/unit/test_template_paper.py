"""The paper recipe: its network, its queries, its file; quick settings stand for the long ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from amrepair.errors import TemplateError
from amrepair.template import GridSdf, MeshSdf, PaperSdf, extract_mesh, load_template
from amrepair.template.fitting import fit_template
from amrepair.template.network import Architecture
from amrepair.template.paper import (
    NETWORK_VARIANTS,
    PUBLISHED_NETWORK,
    RELEASED_NETWORK,
    _from_cloud,
    _queries,
    fit_paper,
)

# Seconds instead of hours, the same arithmetic.
QUICK = replace(PUBLISHED_NETWORK, batch=512, rate=2e-3, epochs=10, dropout=0.0, width=96)
RADIUS_MM = 10.0


@pytest.fixture(scope="module")
def ball() -> MeshSdf:
    return MeshSdf.from_mesh(trimesh.creation.icosphere(subdivisions=4, radius=RADIUS_MM))


@pytest.fixture(scope="module")
def fitted(ball: MeshSdf) -> PaperSdf:
    return fit_paper(ball, options=QUICK, device="cpu", seed=1)


def test_defaults_are_those_of_the_paper() -> None:
    assert (PUBLISHED_NETWORK.surface, PUBLISHED_NETWORK.box, PUBLISHED_NETWORK.volume) == (
        10_000,
        10_000,
        3_000,
    )
    assert (
        PUBLISHED_NETWORK.epochs,
        PUBLISHED_NETWORK.rate,
        PUBLISHED_NETWORK.batch,
        PUBLISHED_NETWORK.clamp,
    ) == (2_000, 1e-5, 16, 0.1)
    assert (PUBLISHED_NETWORK.dropout, RELEASED_NETWORK.dropout) == (0.2, 0.0)
    assert PUBLISHED_NETWORK.architecture.inputs == 63
    assert replace(PUBLISHED_NETWORK, encoding=False).architecture.inputs == 3
    assert len(PUBLISHED_NETWORK.architecture.sizes) == 8
    assert PUBLISHED_NETWORK.architecture.sizes[3] == (256, 256 - 63)
    assert set(NETWORK_VARIANTS) == {"paper", "code"}


def test_encoding_is_input_then_waves() -> None:
    import torch

    point = torch.tensor([[0.3, -0.2, 0.7]])
    code = Architecture().encode(point)[0].numpy()
    assert code.shape == (63,)
    assert np.allclose(code[:3], point[0])
    for k, exponent in enumerate(np.linspace(0, 4, 10)):
        scaled = point[0].numpy() * 2.0**exponent
        assert np.allclose(code[3 + 6 * k : 6 + 6 * k], np.sin(scaled), atol=1e-5)
        assert np.allclose(code[6 + 6 * k : 9 + 6 * k], np.cos(scaled), atol=1e-5)


def test_queries_lie_where_the_paper_says(ball: MeshSdf) -> None:
    points = _queries(ball, np.zeros(3), RADIUS_MM, PUBLISHED_NETWORK, np.random.default_rng(0))
    assert points.shape == (23_000, 3)
    assert np.abs(ball.distance(points[:10_000])).max() < 0.01
    box = np.abs(points[10_000:20_000]).max(axis=0)
    assert box == pytest.approx(1.3 * RADIUS_MM, rel=0.01)
    assert np.abs(points[20_000:]).max() == pytest.approx(RADIUS_MM, rel=0.01)


def test_distances_from_a_cloud_are_those_of_the_mesh(ball: MeshSdf) -> None:
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(50_000, 3))
    cloud /= np.linalg.norm(cloud, axis=1, keepdims=True)
    points = rng.uniform(-12, 12, (2_000, 3))
    found = _from_cloud(points, RADIUS_MM * cloud, cloud)
    truth = np.linalg.norm(points, axis=1) - RADIUS_MM
    assert np.abs(found - truth).max() < 0.3  # half a point spacing, sideways
    assert (np.sign(found) == np.sign(truth))[np.abs(truth) > 0.1].all()


def test_a_ball_is_learned(fitted: PaperSdf, ball: MeshSdf) -> None:
    points, _ = trimesh.sample.sample_surface(ball.mesh, 5_000, seed=3)
    error_mm = np.abs(fitted.distance(np.asarray(points)))
    assert error_mm.mean() < 0.05  # 0.5 % of the radius after 380 steps
    assert np.quantile(error_mm, 0.99) < 2 * fitted.bias_mm
    away = np.asarray(points) * 1.05
    assert fitted.distance(away).mean() == pytest.approx(0.5, abs=0.1)
    assert fitted.distance(0.95 * np.asarray(points)).mean() == pytest.approx(-0.5, abs=0.1)


def test_far_points_are_outside_and_far(fitted: PaperSdf) -> None:
    far = np.array([[100.0, 0.0, 0.0], [0.0, -60.0, 60.0]])
    found = fitted.distance(far)
    assert (found > 30.0).all()  # the network itself saturates at the clamp


def test_gradients_are_those_of_the_field(fitted: PaperSdf) -> None:
    points = np.random.default_rng(0).uniform(-11, 11, (400, 3))
    value, gradient = fitted.distance_and_gradient(points)
    assert np.allclose(value, fitted.distance(points))
    step = 1e-2
    for axis in range(3):
        offset = np.eye(3)[axis] * step
        slope = (fitted.distance(points + offset) - fitted.distance(points - offset)) / (2 * step)
        # a step may cross a kink of some ReLU, or the cube's face: nearly all, not all
        assert np.mean(np.abs(slope - gradient[:, axis]) < 0.02) > 0.93
        assert np.median(np.abs(slope - gradient[:, axis])) < 1e-3


def test_a_large_query_is_the_same_as_small_ones(
    fitted: PaperSdf, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = np.random.default_rng(0).uniform(-11, 11, (1_000, 3))
    whole = fitted.distance(points)
    monkeypatch.setattr("amrepair.template.network.CHUNK", 97)
    assert np.allclose(fitted.distance(points), whole, atol=1e-5)


def test_its_surface_is_a_closed_ball(fitted: PaperSdf) -> None:
    mesh = extract_mesh(fitted, 0.5)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS_MM**3, rel=0.03)


def test_the_file_comes_back(fitted: PaperSdf, tmp_path: Path) -> None:
    path = tmp_path / "ball.safetensors"
    fitted.save(path)
    again = load_template(path)
    assert isinstance(again, PaperSdf)
    points = np.random.default_rng(0).uniform(-11, 11, (500, 3))
    assert np.array_equal(again.distance(points), fitted.distance(points))
    assert '"epochs": 10' in again.metadata["settings"]
    assert again.bias_mm == fitted.bias_mm
    with pytest.raises(TemplateError, match="kind 'network', not 'grid'"):
        GridSdf.load(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(TemplateError, match="truncated"):
        load_template(path)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_network(ball: MeshSdf) -> None:
    import torch

    short = replace(QUICK, epochs=2, dropout=0.2)
    torch.manual_seed(5)
    before = torch.rand(1)
    torch.manual_seed(5)
    one, two = (fit_paper(ball, options=short, device="cpu", seed=3) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(one.weights, two.weights, strict=True))
    assert torch.rand(1) == before  # and nobody else's draws are touched
    other = fit_paper(ball, options=short, device="cpu", seed=4)
    assert not np.array_equal(one.weights[0], other.weights[0])


def test_fit_template_takes_the_recipe_by_name() -> None:
    box = trimesh.creation.box((10.0, 8.0, 6.0))
    short = replace(QUICK, epochs=1, encoding=False, distances="cloud")
    template = fit_template(box, recipe="paper", paper=short, device="cpu")
    assert isinstance(template, PaperSdf)
    assert template.metadata["recipe"] == "paper"
    assert template.weights[0].shape == (96, 3)


@pytest.mark.parametrize(
    "change", [{"distances": "magic"}, {"epochs": 0}, {"dropout": 1.0}, {"rate": 0.0}]
)
def test_settings_out_of_range_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(TemplateError):
        replace(PUBLISHED_NETWORK, **change)


def test_a_network_too_narrow_for_its_skip_is_refused() -> None:
    with pytest.raises(TemplateError, match="width above 63"):
        _ = replace(PUBLISHED_NETWORK, width=60).architecture
