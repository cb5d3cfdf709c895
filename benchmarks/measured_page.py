"""Rows of a benchmark's table into `docs/measurements.md`, between the marks of its name.

A row replaces the row with the same first cell, and rows that are not measured this time stay, so
that a benchmark may be run for one part or one object at a time. Nothing else on the page changes.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "measurements.md"

Row = Sequence[object]


def add_page_option(parser: argparse.ArgumentParser) -> None:
    """`--page`: the table of this run goes into the page."""
    parser.add_argument(
        "--page", action="store_true", help=f"write the table into docs/{PAGE.name}"
    )


def table(header: Row, rows: Sequence[Row]) -> str:
    """Markdown."""
    return "\n".join([_line(header), _rule(header), *map(_line, rows)])


def write_rows(name: str, header: Row, rows: Sequence[Row], *, page: Path = PAGE) -> None:
    """Put rows between `<!-- name -->` and `<!-- /name -->` of a page.

    Raises
    ------
    ValueError
        If the page does not have both marks once, or a row is not as wide as the header.
    """
    page.write_text(
        with_rows(page.read_text(encoding="utf-8"), name, header, rows), encoding="utf-8"
    )


def with_rows(text: str, name: str, header: Row, rows: Sequence[Row]) -> str:
    """The page's text with these rows in the table of that name."""
    begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(end) < text.index(begin):
        raise ValueError(f"the page needs one '{begin}', and one '{end}' after it")
    if uneven := [row for row in rows if len(row) != len(header)]:
        raise ValueError(f"a row of {name} has {len(uneven[0])} cells, its header {len(header)}")
    before, rest = text.split(begin)
    table, after = rest.split(end)
    head, rule, *old = [line for line in table.splitlines() if line.strip()] or ["", ""]
    new = {str(row[0]): _line(row) for row in rows}
    if (head, rule) == (_line(header), _rule(header)):  # else the old rows are of another table
        kept = {line.split("|")[1].strip(): line for line in old}
        new = {first: new.get(first, line) for first, line in kept.items()} | new
    body = "\n".join([_line(header), _rule(header), *new.values()])
    return f"{before}{begin}\n\n{body}\n\n{end}{after}"


def _line(cells: Row) -> str:
    return f"| {' | '.join(str(cell) for cell in cells)} |"


def _rule(cells: Row) -> str:
    return "|" + "---|" * len(cells)
