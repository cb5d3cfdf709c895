"""The documentation builds without warnings, fetches nothing, and what it says to type works."""

from __future__ import annotations

import functools
import os
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click
import pytest
import typer

from amrepair.bench.dataset import LAYOUTS
from amrepair.cli.app import app as amrepair_app
from amrepair.cli.scanners import Bed, open_scanner
from amrepair.frames import Transform
from amrepair.scans import ScanRequest
from amrepair.simulate.defects import DEFECT_KINDS as DEFECTS
from gcode.check.words import KNOWN_COMMANDS, LINE_LIMIT
from gcode.cli.app import app as gcode_app
from gcode.dialects import DIALECTS
from gcode.firmware.faults import FAULT_KINDS
from gcode.firmware.variants import FIRMWARES
from gcode.profiles import load_setup
from gcode.protocol.dialects import LINK_DIALECTS

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
APPS = {"amrepair": amrepair_app, "gcode": gcode_app}


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.S)


def typed(page: Path) -> list[str]:
    """Lines of shell blocks that call our programs."""
    text = "\n".join(blocks(page, "sh")).replace("\\\n", " ")
    return [line for line in text.splitlines() if line.split(" ")[0] in APPS]


@functools.cache
def program(name: str) -> click.Command:
    """A program with all its commands: a twentieth of a second to put together."""
    return typer.main.get_command(APPS[name])


SHELL = [(page, line) for page in (*PAGES, ROOT / "README.md") for line in typed(page)]


@pytest.mark.parametrize(
    ("page", "line"), SHELL, ids=[f"{page.stem}: {line[:40]}" for page, line in SHELL]
)
def test_what_is_typed_is_understood(page: Path, line: str) -> None:
    words = shlex.split(line, comments=True)
    command = program(words[0])
    rest = words[1:]
    while getattr(command, "commands", None):
        command = command.commands[rest.pop(0)]  # type: ignore[attr-defined]
    command.make_context(words[0], rest)  # parses, runs nothing


WITH_PYTHON = [page for page in PAGES if blocks(page, "python")]


@pytest.fixture
def own_tables() -> Iterator[None]:
    """What a page adds to our tables is gone after it."""
    tables: list[dict[str, Any]] = [
        DIALECTS, LINK_DIALECTS, KNOWN_COMMANDS, LINE_LIMIT, FIRMWARES, DEFECTS, LAYOUTS,
    ]  # fmt: skip
    before = [dict(table) for table in tables]
    yield
    for table, rows in zip(tables, before, strict=True):
        table.clear()
        table.update(rows)


@pytest.mark.usefixtures("small_fits", "own_tables")
@pytest.mark.parametrize("page", WITH_PYTHON, ids=lambda page: page.stem)
def test_python_on_a_page_runs(
    page: Path, example_files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(example_files)
    names: dict[str, object] = {}
    for block in blocks(page, "python"):  # a page is read from top to bottom
        exec(compile(block, str(page), "exec"), names)
    if page.stem == "tutorial":
        assert (example_files / "repair.gcode").is_file()


NEW = sorted((DOCS / "how-to").glob("a-new-*.md"))


@pytest.mark.parametrize("page", NEW, ids=lambda page: page.stem)
def test_a_page_on_something_new_is_a_whole_example_of_sixty_lines(page: Path) -> None:
    assert len(NEW) == 4
    lines = [block.count("\n") for block in blocks(page, "python")]
    assert 0 < sum(lines) <= 60


def test_the_new_scanner_s_file_is_taken_by_the_command_line(tmp_path: Path) -> None:
    (tmp_path / "camera.py").write_text(blocks(DOCS / "how-to" / "a-new-scanner.md", "python")[0])
    pose = Transform.identity("build", "scanner")
    scanner = open_scanner(f"python:{tmp_path / 'camera.py'}", Bed(pose, 5.0, load_setup()))
    scan = scanner.scan(ScanRequest("final", None, 1.0))
    assert len(scan) == 120 * 157
    assert scan.source == "depth camera, final"


def test_every_fault_of_the_emulated_printer_is_on_its_page() -> None:
    said = (DOCS / "how-to" / "rehearse-faults.md").read_text(encoding="utf-8")
    assert dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", said, re.M)) == FAULT_KINDS


def test_every_example_is_on_its_page() -> None:
    said = (DOCS / "examples.md").read_text(encoding="utf-8")
    for path in (ROOT / "examples").glob("[0-9]*.py"):
        assert f"`examples/{path.name}`" in said


class Fetched(HTMLParser):
    """What a browser would load while it shows a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag in {"script", "img", "iframe", "source"} and values.get("src"):
            self.found.append(str(values["src"]))
        if tag == "link" and values.get("rel") in {"stylesheet", "preconnect", "icon"}:
            self.found.append(str(values["href"]))


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mkdocs") is None, reason="the extra 'docs' is not installed")
def test_it_builds_without_warnings_and_fetches_nothing(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path / "site"],
        capture_output=True, text=True, timeout=200, check=False, cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) >= len(PAGES)
    for page in pages:
        fetched = Fetched()
        fetched.feed(page.read_text(encoding="utf-8"))
        assert not [url for url in fetched.found if "//" in url], page
    reference = (tmp_path / "site" / "reference" / "amrepair.html").read_text(encoding="utf-8")
    assert "build_from_template" in reference  # taken from the docstrings
    assert "amrepair repair" in (tmp_path / "site" / "reference" / "commands.html").read_text()


def test_every_example_has_its_picture_on_the_page() -> None:
    page = (DOCS / "examples.md").read_text(encoding="utf-8")
    for example in (ROOT / "examples").glob("[0-9]*.py"):
        picture = DOCS / "images" / f"example-{example.name[:2]}.webp"
        assert f"images/{picture.name}" in page, example.name
        assert 1_000 < picture.stat().st_size < 150_000


def test_the_slicers_dialogs_are_as_they_are_drawn() -> None:
    dialogs = runpy.run_path(str(DOCS / "dialogs.py"))
    page = (DOCS / "how-to" / "look-from-the-slicer.md").read_text(encoding="utf-8")
    for name, dialog in dialogs["DIALOGS"].items():
        picture = DOCS / "images" / f"dialog-{name}.svg"
        assert picture.read_text(encoding="utf-8") == dialogs["drawn"](dialog)
        assert f"../images/{picture.name}" in page
        assert dialog.groups[-1] in page
