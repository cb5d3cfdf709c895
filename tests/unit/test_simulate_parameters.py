"""The world's parameters: one file says them all, and nothing else is taken."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel

from amrepair.errors import InputError
from amrepair.simulate.parameters import (
    SHIPPED,
    BeadModel,
    FlowModel,
    ScannerModel,
    ThermalModel,
    load_world,
)


def keys(model: type[BaseModel]) -> set[str]:
    return set(model.model_fields)


def test_shipped_file_says_every_parameter() -> None:
    told = tomllib.loads(SHIPPED.read_text())
    assert set(told["bead"]) == keys(BeadModel)
    assert set(told["flow"]) == keys(FlowModel)
    assert set(told["thermal"]) == keys(ThermalModel)
    line_only = {"line_step_mm"}
    for name, scanner in told["scanner"].items():
        unsaid = set() if name == "laser-line" else line_only
        assert set(scanner) == keys(ScannerModel) - unsaid, name
    # a world made without a file has the same beads
    assert load_world().bead == BeadModel()


def test_own_file_changes_what_it_says_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "hot.toml"
    path.write_text(
        "[thermal]\nshrink_ratio = 0.007\n[scanner.laser-line]\nsigma_mm = 0.1\n"
        "[scanner.mine]\nspacing_mm = 0.5\n"
    )
    shipped, own = load_world(), load_world(path)
    assert own.thermal == shipped.thermal.model_copy(update={"shrink_ratio": 0.007})
    assert own.scanner("laser-line").sigma_mm == 0.1
    assert own.scanner("laser-line").line_step_mm == shipped.scanner("laser-line").line_step_mm
    assert own.scanner("mine").spacing_mm == 0.5
    assert own.bead == shipped.bead
    assert own.sha256 != shipped.sha256
    with pytest.raises(InputError, match=r"laser-line, mine, structured-light"):
        own.scanner("sonar")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[bead]\nstickiness = 1\n", "unknown key 'bead.stickiness'"),
        ("gravity = 9.8\n", "unknown key 'gravity'"),
        ("columns_mm = 0.5\n", "'columns_mm' = 0.5 is out of range"),
        ("[flow]\nsigma_ratio = -0.1\n", "'flow.sigma_ratio' = -0.1 is out of range"),
        ("[thermal]\nheld_mm = nan\n", "'thermal.held_mm' = nan is out of range"),
        ("[scanner.laser-line]\ndropout_ratio = 2\n", "dropout_ratio' = 2 is out of range"),
        ("[bead\n", "not valid TOML"),
    ],
)
def test_what_is_unknown_or_out_of_range_is_refused_by_name(
    tmp_path: Path, text: str, says: str
) -> None:
    path = tmp_path / "world.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=says):
        load_world(path)


def test_missing_file_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_world(tmp_path / "none.toml")
