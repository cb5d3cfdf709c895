"""Benchmarks write their rows into the page of measurements, and nothing else of it."""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
TABLE = "<!-- t -->\n\n| case | mm |\n|---|---|\n| pit | 0.1 |\n| slot | 0.2 |\n\n<!-- /t -->"
AROUND = f"# Page\n\nBefore.\n\n{TABLE}\n\n| case | mm |\n|---|---|\n| pit | 9 |\n"


@pytest.fixture(scope="module")
def writer() -> ModuleType:
    spec = importlib.util.spec_from_file_location("measured", BENCHMARKS / "measured_page.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_row_replaces_its_own_and_others_stay_in_their_places(writer: ModuleType) -> None:
    made = writer.with_rows(AROUND, "t", ("case", "mm"), [("corner", 0.3), ("pit", 0.4)])
    body = "| pit | 0.4 |\n| slot | 0.2 |\n| corner | 0.3 |"
    assert made == AROUND.replace("| pit | 0.1 |\n| slot | 0.2 |", body)
    assert writer.with_rows(made, "t", ("case", "mm"), [("pit", 0.4)]) == made


def test_another_header_begins_another_table(writer: ModuleType) -> None:
    made = writer.with_rows(AROUND, "t", ("case", "cm"), [("pit", 1)])
    assert "| case | cm |\n|---|---|\n| pit | 1 |\n\n<!-- /t -->" in made
    assert "slot" not in made
    assert made.endswith("| pit | 9 |\n")


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        (AROUND.replace("<!-- /t -->", ""), [("pit", 1)]),
        (AROUND.replace(TABLE, "<!-- /t --> <!-- t -->"), [("pit", 1)]),
        (AROUND + TABLE, [("pit", 1)]),
        (AROUND, [("pit", 1, 2)]),
    ],
)
def test_a_page_without_its_place_is_not_written(
    writer: ModuleType, tmp_path: Path, text: str, rows: list[tuple[object, ...]]
) -> None:
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(ValueError, match=r"the page needs|has 3 cells"):
        writer.write_rows("t", ("case", "mm"), rows, page=page)
    assert page.read_text() == text


def test_every_table_of_the_page_is_its_benchmark_s(writer: ModuleType) -> None:
    """The marks name benchmarks that write there, and the header that stands there is theirs."""
    text = writer.PAGE.read_text(encoding="utf-8")
    found = re.findall(r"<!-- (\w+) -->\n\n(\|.*\|)\n\|[-|]+\|\n(.*?)\n\n<!-- /\1 -->", text, re.S)
    assert len(found) == text.count("<!-- /") >= 6
    for name, header, rows in found:
        source = (BENCHMARKS / f"{name}.py").read_text(encoding="utf-8")
        assert f'write_rows("{name}", PAGE_HEADER' in source
        if "import PAGE_HEADER" in source:
            source = (BENCHMARKS / f"{name.replace('bench_real', 'real_tables')}.py").read_text()
        literal = re.search(r"^PAGE_HEADER = (\(.*?\))(?:  #|$)", source, re.M | re.S)
        assert literal, name
        cells = ast.literal_eval(literal[1])
        assert header == "| " + " | ".join(cells) + " |"
        assert {row.count("|") for row in rows.splitlines()} == {len(cells) + 1}
