"""What an import is made of: rules from another program's keys to ours, and what came of them.

Every key of the source ends as mapped or as left, with the reason; nothing is dropped silently.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from gcode.profiles.names import Kind

_LENGTH = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


class NotMappedError(Exception):
    """A value that has no counterpart here; the text is the reason."""


@dataclass(frozen=True, slots=True)
class Source:
    """One profile of another program: its keys as text.

    Attributes
    ----------
    kinds
        What it describes: printer, material, process; several for an exported configuration.
    name_keys
        The keys that hold the names of the parts; `name` where one is not there.
    missing
        Keys whose reason for being left is known to the reader.
    """

    name: str
    kinds: tuple[Kind, ...]
    values: Mapping[str, str]
    name_keys: Mapping[str, Kind] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Mapped:
    """A key of another program, and the key of ours that it became."""

    source_key: str
    source_value: str
    key: str
    value: Any


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A key of another program that has no counterpart here, and the reason."""

    source_key: str
    source_value: str
    reason: str


@dataclass(slots=True)
class Imported:
    """One profile of ours in the making.

    Attributes
    ----------
    values
        Our keys; axis limits as tables.
    inherits
        The shipped profile that what the source does not know is taken from.
    """

    kind: Kind
    name: str
    inherits: str
    values: dict[str, Any] = field(default_factory=dict)
    mapped: list[Mapped] = field(default_factory=list)

    def put(self, source_key: str, source_value: str, key: str, value: Any) -> None:
        """Set a key, `table.key` for a table's."""
        table, _, inner = key.partition(".")
        if inner:
            self.values.setdefault(table, {})[inner] = value
        else:
            self.values[table] = value
        self.mapped.append(Mapped(source_key, source_value, key, value))


Convert = Callable[[str, Source], Any]


@dataclass(frozen=True, slots=True)
class Rule:
    """Where a key goes, and how its text is read; without a key of ours it becomes several."""

    kind: Kind
    key: str
    convert: Convert


NO_COUNTERPART = "our profiles have nothing like it"


def apply(
    source: Source, rules: Mapping[str, Rule], parents: Mapping[Kind, str]
) -> tuple[tuple[Imported, ...], tuple[LeftOut, ...]]:
    """Apply rules to a source.

    Parameters
    ----------
    parents
        The shipped profile to inherit from, by kind.
    """
    made = {kind: Imported(kind, source.name, parents[kind]) for kind in source.kinds}
    left: list[LeftOut] = []
    for key, text in source.values.items():
        rule = rules.get(key)
        if source.name_keys.get(key) in made and (name := first(text).strip('"')):
            profile = made[source.name_keys[key]]
            profile.name = name
            profile.mapped.append(Mapped(key, text, "name", name))
        elif rule is None:
            left.append(LeftOut(key, text, source.missing.get(key, NO_COUNTERPART)))
        elif rule.kind not in made:
            left.append(LeftOut(key, text, f"it belongs to {rule.kind}, which this file is not"))
        else:
            try:
                value = rule.convert(text, source)
            except NotMappedError as reason:
                left.append(LeftOut(key, text, str(reason)))
                continue
            for ours, one in {rule.key: value}.items() if rule.key else value.items():
                made[rule.kind].put(key, text, ours, one)
    return tuple(made.values()), tuple(left)


# ---------------------------------------------------------------------- conversions

LEAST_ROUND_CORNERS = 16  # a slicer's circle has 72 and more; fewer are a plate with cut corners


def first(text: str) -> str:
    """Return the first of several extruders' or modes' values."""
    return re.split(r"[,;]", text)[0].strip()


def number(text: str, source: Source) -> float:
    """Read a number; of several, the first."""
    try:
        return float(first(text))
    except ValueError:
        raise NotMappedError(f"{text!r} is no plain number") from None


def whole(text: str, source: Source) -> int:
    """Read a whole number; of several, the first."""
    value = number(text, source)
    if value != int(value):
        raise NotMappedError(f"{text!r} is no whole number")
    return int(value)


def limit(text: str, source: Source) -> float:
    """Read a limit, where 0 means none."""
    value = number(text, source)
    if value == 0.0:
        raise NotMappedError("0 sets no limit")
    return value


def percent(text: str, source: Source) -> float:
    """Read `15%`, or a plain number of per cent, as a ratio."""
    return number(first(text).removesuffix("%"), source) / 100.0


def of_key(other: str) -> Convert:
    """Read a number, or a share of another key's (`50%` of the perimeters' speed)."""

    def convert(text: str, source: Source) -> float:
        if not first(text).endswith("%"):
            return limit(text, source)
        base = source.values.get(other)
        if base is None or first(base).endswith("%"):
            raise NotMappedError(f"it is a share of {other}, which is not given as a number")
        return round(percent(text, source) * number(base, source), 6)

    return convert


def choice(**names: str) -> Convert:
    """Read one of several words."""

    def convert(text: str, source: Source) -> str:
        word = text.strip().lower()
        if word not in names:
            raise NotMappedError(
                f"{text!r} has no counterpart; ours: {', '.join(sorted(set(names.values())))}"
            )
        return names[word]

    return convert


def bed(
    x_mm: tuple[float, float], y_mm: tuple[float, float], *, rounded: bool = False
) -> dict[str, Any]:
    """Our keys of a bed that goes so far in X and Y, least and greatest."""
    size = [x_mm[1] - x_mm[0], y_mm[1] - y_mm[0]]
    if min(size) <= 0:
        raise NotMappedError("the bed has no area")
    made: dict[str, Any] = {"bed_size_mm": size}
    if x_mm[0] or y_mm[0]:
        made["bed_min_mm"] = [x_mm[0], y_mm[0]]
    return made | ({"delta": True} if rounded else {})


def outline(text: str, source: Source) -> dict[str, Any]:
    """Read a bed's outline `0x0,250x0,250x210,0x210`; of another shape the box is taken."""
    pairs = [tuple(map(float, _LENGTH.findall(pair))) for pair in text.split(",")]
    if any(len(pair) != 2 for pair in pairs):
        raise NotMappedError(f"{text!r} is no outline of points XxY")
    x_mm, y_mm = ([round(pair[axis], 3) for pair in pairs] for axis in (0, 1))
    around = (min(x_mm), max(x_mm)), (min(y_mm), max(y_mm))
    if len(pairs) < 4:
        raise NotMappedError("the bed is a triangle at most")
    return bed(*around, rounded=len(pairs) >= LEAST_ROUND_CORNERS)


def script(placeholders: Mapping[str, str]) -> Convert:
    """Read start or end G-code, with the slicer's placeholders put into our words."""

    def convert(text: str, source: Source) -> list[str]:
        lines = [line.rstrip() for line in text.replace("\\n", "\n").split("\n")]
        filled = []
        for line in lines:
            code = line.partition(";")[0]
            for theirs, ours in placeholders.items():
                code = re.sub(rf"[\[{{]{theirs}(?:\[\w+\])?[\]}}]", f"\0{ours}\1", code)
            if re.search(r"[\[\]{}]", code):
                raise NotMappedError(f"{code.strip()!r} needs the slicer's own macro language")
            if code.strip():
                filled.append(code.strip().replace("\0", "{").replace("\1", "}"))
        return filled

    return convert
