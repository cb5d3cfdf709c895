"""The architecture page says what the code says; `--regenerate-golden` writes it anew."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "architecture.md"
PICTURE = ROOT / "docs" / "images" / "architecture.svg"
HINT = "run this test with --regenerate-golden and commit what it writes"


@pytest.fixture(scope="module")
def hooks() -> ModuleType:
    spec = importlib.util.spec_from_file_location("docs_hooks", ROOT / "docs" / "_hooks.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["docs_hooks"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("package", ["gcode", "amrepair"])
def test_the_contract_places_every_room_once(hooks: ModuleType, package: str) -> None:
    placed = [room for row in hooks.layers(package) for room in row]
    assert len(placed) == len(set(placed))
    assert set(placed) == hooks.rooms_on_disk(package)
    for room in placed:
        assert len(hooks.job_of(package, room)) > 20, f"{package}.{room} does not say its job"


def test_page_and_picture_are_the_code_s(hooks: ModuleType, regenerate_golden: bool) -> None:
    page = hooks.architecture(PAGE.read_text(encoding="utf-8"))
    if regenerate_golden:
        PAGE.write_text(page, encoding="utf-8")
        PICTURE.write_text(hooks.picture(), encoding="utf-8")
    assert PAGE.read_text(encoding="utf-8") == page, HINT
    assert PICTURE.read_text(encoding="utf-8") == hooks.picture(), HINT
    for package in ("gcode", "amrepair"):
        for room in hooks.rooms_on_disk(package):
            assert f"`{package}.{room}`" in page


@pytest.mark.parametrize("program", ["gcode", "amrepair"])
def test_the_command_reference_has_every_command(hooks: ModuleType, program: str) -> None:
    page = hooks.on_page_markdown(f"<!-- commands of {program} -->")
    wanted = {"gcode": ("slice", "profiles show"), "amrepair": ("repair", "template fit", "doctor")}
    for command in wanted[program]:
        assert f"\n## {program} {command}\n" in f"\n{page}"
    assert "Sentinel" not in page
    assert "--part-pose" in page or program == "gcode"
