"""Every number of ours that can be set, as it stands: its room, value, unit and reason.

Options are frozen dataclasses whose names end in `Options`; nothing is listed by hand. Numbers of a
printer, a material or a process stand in its profile (`gcode profiles show`).
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import NoneType
from typing import Any

OPTION_PACKAGES = ("amrepair", "gcode")
_CLASS = re.compile(r"^class (\w+Options)\b", re.MULTILINE)
_NAME_UNITS = (
    ("_mm_s", "mm/s"), ("_mm3_s", "mm³/s"), ("_mm3", "mm³"), ("_mm2", "mm²"), ("_mm", "mm"),
    ("_deg", "°"), ("_rad", "rad"), ("_ratio", "ratio"), ("_share", "ratio"), ("_s", "s"),
    ("_layers", "layers"), ("_mb", "MB"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Tunable:
    """One number that can be set.

    Attributes
    ----------
    options
        The class that has it, with its module.
    unit
        Empty where it is a count, a probability or a word.
    reason
        What it is, and where its value comes from.
    """

    options: str
    name: str
    value: Any
    unit: str
    reason: str


def tunables() -> tuple[Tunable, ...]:
    """All of them, by module."""
    return tuple(one for kind in options_classes() for one in _of(kind))


def options_classes() -> Iterator[type]:
    """The options classes of both packages."""
    root = Path(__file__).parents[2]
    for package in OPTION_PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            for name in _CLASS.findall(path.read_text(encoding="utf-8")):
                module = ".".join(path.relative_to(root).with_suffix("").parts)
                yield getattr(import_module(module.removesuffix(".__init__")), name)


def _of(kind: Any) -> Iterator[Tunable]:
    reasons = _attributes(kind.__doc__ or "")
    for name, value in _defaults(kind):
        if dataclasses.is_dataclass(value):
            continue  # options of another room, listed there
        yield Tunable(
            f"{kind.__module__}.{kind.__name__}",
            name,
            value if isinstance(value, (int, float, str, NoneType)) else str(value),
            next((unit for end, unit in _NAME_UNITS if name.endswith(end)), ""),
            reasons.get(name, ""),
        )


def _defaults(kind: Any) -> Iterator[tuple[str, Any]]:
    """What has a value of its own, and is not given by whoever makes them."""
    if not dataclasses.is_dataclass(kind):  # read from a file: a model of pydantic's
        yield from kind.model_construct().model_dump().items()
        return
    for field in dataclasses.fields(kind):
        if field.default is not dataclasses.MISSING:
            yield field.name, field.default
        elif field.default_factory is not dataclasses.MISSING:
            yield field.name, field.default_factory()


def _attributes(doc: str) -> dict[str, str]:
    """Text of each attribute of a numpydoc docstring."""
    _, _, section = doc.partition("Attributes\n")
    found: dict[str, str] = {}
    names: list[str] = []
    for line in section.splitlines()[1:]:
        text = line.strip()
        depth = len(line) - len(line.lstrip())
        if set(text) == {"-"}:
            break  # the next section
        if depth == 4 and text:
            names = [name.strip() for name in text.split(",")]
        elif text:
            for name in names:
                found[name] = f"{found.get(name, '')} {text}".strip()
    return found
