"""The point transformers against torch's own modules, with random weights."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from amrepair.bench.pointmae import TOKEN_WIDTH, load_checkpoint
from amrepair.bench.registry import make_method
from amrepair.errors import InputError
from tests.draws import draws


@pytest.fixture(scope="module")
def published() -> ModuleType:
    """With torch, which takes a second to load: not where every worker collects all tests."""
    return importlib.import_module("pointmae_reference")


@pytest.mark.slow
@pytest.mark.parametrize("kind", draws(["pointmae", "pointbert"], "pointmae"))
def test_forward_pass_is_the_published_architecture(
    published: ModuleType, tmp_path: Path, kind: str
) -> None:
    torch = published.torch
    weights = published.random_weights(kind)
    model = load_checkpoint(published.save(tmp_path / "w.pth", kind, weights), kind)
    groups, centres = torch.randn(20, 16, 3), torch.randn(20, 3)
    with torch.no_grad():
        expected = published.Reference(kind, weights)(groups, centres)
        found = model.forward(groups, centres)
    assert found.shape == (20, 3 * TOKEN_WIDTH)
    assert torch.allclose(found, expected, atol=2e-5)


@pytest.mark.slow
def test_features_do_not_depend_on_unit_or_place(published: ModuleType, tmp_path: Path) -> None:
    model = load_checkpoint(
        published.save(tmp_path / "w.pth", "pointmae", published.random_weights("pointmae")),
        "pointmae",
    )
    points = np.random.default_rng(0).normal(size=(400, 3))
    features, index = model.extract(points)
    assert features.shape == (400, 1152)
    assert sorted(index) == list(range(400))
    moved, order = model.extract(points * 30 + 7)
    assert np.array_equal(order, index)
    assert np.allclose(moved, features, atol=1e-3)


def test_safetensors_are_read_too(published: ModuleType, tmp_path: Path) -> None:
    from safetensors.torch import save_file

    weights = published.random_weights("pointmae")
    save_file(weights, tmp_path / "w.safetensors")
    assert load_checkpoint(tmp_path / "w.safetensors", "pointmae").weights.keys() == weights.keys()


def test_without_weights_it_says_so(published: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needs pretrained weights and none are included") as e:
        make_method("patchcore-pointmae")
    assert e.value.exit_code == 2
    with pytest.raises(InputError, match="no such checkpoint"):
        make_method("patchcore-pointbert", checkpoint=tmp_path / "absent.pth")
    (tmp_path / "bad.pth").write_bytes(b"not a checkpoint")
    with pytest.raises(InputError, match="cannot be read"):
        make_method("patchcore-pointmae", checkpoint=tmp_path / "bad.pth")
    published.save(tmp_path / "mae.pth", "pointmae", published.random_weights("pointmae"))
    with pytest.raises(InputError, match="not a pointbert checkpoint"):
        make_method("patchcore-pointbert", checkpoint=tmp_path / "mae.pth")


class Payload:
    """What a hostile pickle would hold."""

    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (Path("payload-ran"),))


def test_code_in_a_checkpoint_is_not_run(
    published: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch = published.torch
    monkeypatch.chdir(tmp_path)
    torch.save({"base_model": Payload()}, tmp_path / "evil.pth")
    with pytest.raises(InputError, match="without running code"):
        make_method("patchcore-pointmae", checkpoint=tmp_path / "evil.pth")
    assert not (tmp_path / "payload-ran").exists()
