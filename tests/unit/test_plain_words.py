"""Pages keep to their length, and nothing refers to what is not in this repository."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
WORDS = {"README.md": 700, "docs/measurements.md": 2500, "docs/reference/glossary.md": 1500}
FOLDERS = ("gcode", "amrepair", "benchmarks", "examples", "tests", "docs", "profiles")
TEXTS = {".py", ".md", ".toml", ".yml", ".css", ".js"}
# documents that a reader of this repository does not have, and hosts of package indexes
ELSEWHERE = re.compile(
    r"\bideas? \d|\bthe design\b|\bthe brief\b|\bissue #?\d|\bpypi\.org|pythonhosted\.org"
    r"|\bdownload\.pytorch",
    re.IGNORECASE,
)


def texts() -> list[Path]:
    found = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*")]
    found += [*ROOT.glob("*"), *(ROOT / ".github").rglob("*")]
    return [path for path in found if path.suffix in TEXTS and path != Path(__file__)]


@pytest.mark.parametrize("name", WORDS)
def test_a_page_is_no_longer_than_somebody_reads(name: str) -> None:
    assert len((ROOT / name).read_text(encoding="utf-8").split()) <= WORDS[name]


def test_the_readme_s_table_of_how_far_it_is_has_a_command_in_each_of_few_rows() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8").split("## How far it is")[1]
    rows = [line for line in text.split("\n## ")[0].splitlines() if line.startswith("| ")][1:]
    assert 8 <= len(rows) <= 12
    for row in rows:
        assert re.fullmatch(r"`[^`]+`", row.split("|")[3].strip()), row


def test_nothing_cites_a_document_that_is_not_here() -> None:
    paths = texts()
    assert len(paths) > 400
    said = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in paths
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if ELSEWHERE.search(line)
    ]
    assert not said, "\n".join(said)


def test_every_benchmark_that_a_page_names_is_here() -> None:
    for name in ("README.md", "docs/measurements.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        named = set(re.findall(r"(?:benchmarks|tests|examples)/[\w/.-]+\.py", text))
        assert named
        for path in named:
            assert (ROOT / path).is_file(), path


def test_every_word_of_the_glossary_is_used() -> None:
    """And has the field's word beside it, and one line that says what it is."""
    text = (ROOT / "docs" / "reference" / "glossary.md").read_text(encoding="utf-8")
    used = "\n".join(
        path.read_text(encoding="utf-8").lower()
        for folder in ("gcode", "amrepair")
        for path in (ROOT / folder).rglob("*.py")
    )
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| ")]
    rows = [row for row in rows if row[0].strip() != "here"]
    assert len(rows) > 40
    for here, field, meaning in rows:
        assert field.strip()
        assert meaning.strip()
        name = re.sub(r" ?\(.*\)", "", here.strip())
        for word in re.split(r", | / ", name):
            stem = word.split()[-1].removesuffix("s")
            assert stem in used, word
