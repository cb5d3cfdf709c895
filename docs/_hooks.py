"""What the pages take from the code: command help, the rooms, and the picture of the layers.

mkdocs calls `on_page_markdown`; the suite calls the rest, to hold the architecture page against
the code.
"""

from __future__ import annotations

import ast
import re
import tomllib
from html import escape
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PACKAGES = ("gcode", "amrepair")
_MARKER = re.compile(r"<!-- commands of (\w+) -->")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill `<!-- commands of PROGRAM -->` with what `--help` says."""
    return _MARKER.sub(lambda match: commands(match.group(1)), markdown)


# ---- commands ------------------------------------------------------------------------------------


def commands(program: str) -> str:
    """Every command of a program: its sentence, arguments, options, examples."""
    from importlib import import_module

    import typer

    root: Any = typer.main.get_command(import_module(f"{program}.cli.app").app)
    return "\n".join(_command(name, one) for name, one in _leaves(root, program))


def _leaves(command: Any, name: str) -> list[tuple[str, Any]]:
    below = getattr(command, "commands", None)
    if below is None:
        return [(name, command)]
    return [leaf for key, one in below.items() for leaf in _leaves(one, f"{name} {key}")]


def _command(name: str, command: Any) -> str:
    parts = [f"## {name}", "", " ".join(str(command.help).split()), ""]
    parts += ["| | | default |", "|---|---|---|"]
    for one in command.params:
        if one.name in {"help", "install_completion", "show_completion"}:
            continue
        word = one.name.upper() if one.param_type_name == "argument" else ", ".join(one.opts)
        bare = one.default is None or one.default is False or callable(one.default)
        default = "" if bare or "Sentinel" in str(one.default) else str(one.default)
        text = " ".join(str(getattr(one, "help", "") or "").split())
        parts.append(f"| `{word}`{' *' if one.required else ''} | {_cell(text)} | {default} |")
    lines = [line[2:] for line in (command.epilog or "").split("\n\n") if line.startswith("$ ")]
    return "\n".join([*parts, "", "```sh", *lines, "```", ""])


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("[", "\\[")


# ---- rooms and layers ----------------------------------------------------------------------------


def layers(package: str) -> list[list[str]]:
    """Rows of rooms, high to low, as the import contract has them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    for contract in project["tool"]["importlinter"]["contracts"]:
        if contract.get("containers") == [package]:
            return [[room.strip() for room in row.split("|")] for row in contract["layers"]]
    raise LookupError(package)


def job_of(package: str, room: str) -> str:
    """The first paragraph of a room's header."""
    folder = ROOT / package / room
    path = folder / "__init__.py" if folder.is_dir() else ROOT / package / f"{room}.py"
    said = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(said.split("\n\n")[0].split())


def rooms_on_disk(package: str) -> set[str]:
    """Modules and packages directly below a package."""
    found = {p.parent.name for p in (ROOT / package).glob("*/__init__.py")}
    return found | {p.stem for p in (ROOT / package).glob("*.py") if p.stem != "__init__"}


def table(package: str) -> str:
    """The rooms of a package as a table, low to high."""
    rows = ["| layer | room | its job |", "|---|---|---|"]
    low_to_high = list(reversed(layers(package)))
    for number, row in enumerate(low_to_high, start=1):
        for room in row:
            rows.append(f"| {number} | `{package}.{room}` | {_cell(job_of(package, room))} |")
    return "\n".join(rows)


def picture() -> str:
    """Both packages as stacked layers, `amrepair` standing on `gcode`."""
    width, height, gap = 560, 26, 4
    lines: list[str] = []
    y = 8

    def box(x: float, top: float, wide: float, text: str, kind: str) -> None:
        place = f'x="{x:g}" y="{top:g}" width="{wide:g}" height="{height}"'
        lines.append(f'<rect class="{kind}" {place} rx="4"/>')
        place = f'x="{x + wide / 2:g}" y="{top + 17:g}" text-anchor="middle"'
        lines.append(f"<text {place}>{escape(text)}</text>")

    for package in reversed(PACKAGES):
        lines.append(f'<text class="name" x="8" y="{y + 14}">{package}</text>')
        y += 22
        for row in layers(package):
            wide = (width - gap * (len(row) - 1)) / len(row)
            for k, room in enumerate(row):
                box(8 + k * (wide + gap), y, wide, room, package)
            y += height + gap
        y += 12
    style = (
        ".gcode{fill:#dbe7f5;stroke:#33658a}.amrepair{fill:#fbe3cd;stroke:#a65a1f}"
        "text{font:13px sans-serif;fill:#1b1f24}.name{font-weight:bold}"
        "@media(prefers-color-scheme:dark){.name{fill:#e9edf0}}"
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width + 16} {y}" role="img" '
        f'aria-label="Layers of amrepair above layers of gcode"><style>{style}</style>'
        + "".join(lines)
        + "</svg>\n"
    )


def architecture(page: str) -> str:
    """The page with its tables as the code has them now."""
    for package in PACKAGES:
        page = re.sub(
            rf"(<!-- rooms of {package} -->\n).*?(<!-- end -->)",
            lambda match, package=package: f"{match[1]}\n{table(package)}\n\n{match[2]}",  # type: ignore[misc]
            page,
            flags=re.S,
        )
    return page
