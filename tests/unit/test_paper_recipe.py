"""The published recipe's numbers: options, and the page that says where each is from, agree."""

from __future__ import annotations

import re
from dataclasses import asdict, fields
from pathlib import Path

import pytest

from amrepair.align import PamOptions
from amrepair.align.options import PAM_VARIANTS
from amrepair.template import paper

PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "paper-recipe.md"
ROW = re.compile(r"^\| `(\w+)` \| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", re.MULTILINE)


def told(module: str) -> dict[str, tuple[str, str]]:
    """By option: what the page says of the paper and of the released code."""
    section = PAGE.read_text().split(f"`{module}`", 1)[1].split("\n## ", 1)[0]
    rows = ROW.findall(section)
    found = {name: (first.strip(), second.strip()) for name, first, second, _ in rows}
    assert len(found) == len(rows), "an option has two lines"
    return found


def same(said: str, value: object) -> bool:
    if isinstance(value, bool):
        return said == ("yes" if value else "no")
    return said == value if isinstance(value, str) else float(said) == value


@pytest.mark.parametrize(
    ("module", "options", "variants"),
    [
        ("amrepair.align.pam", PamOptions, PAM_VARIANTS),
        ("amrepair.template.paper", paper.PaperOptions, paper.NETWORK_VARIANTS),
    ],
)
def test_every_number_of_the_recipe_stands_on_the_page(
    module: str, options: type, variants: dict[str, pam.PamOptions | paper.PaperOptions]
) -> None:
    lines = told(module)
    assert set(lines) == {field.name for field in fields(options)}
    for column, variant in enumerate(("paper", "code")):
        values = asdict(variants[variant])
        wrong = {
            name: (line[column], values[name])
            for name, line in lines.items()
            if not same(line[column], values[name])
        }
        assert not wrong, f"variant={variant}: page and options differ in {wrong}"
