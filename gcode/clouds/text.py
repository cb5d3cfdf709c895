"""Tables of numbers that a file tells in text."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import AnyStr

import numpy as np
from jaxtyping import Float

from gcode.errors import InputError


def filled(lines: Iterable[AnyStr]) -> Iterator[AnyStr]:
    """The lines that say something."""
    return (line for line in lines if line.strip())


def read_table(
    lines: Iterable[AnyStr],
    path: Path,
    what: str,
    *,
    delimiter: str | None = None,
    max_rows: int | None = None,
) -> Float[np.ndarray, "n k"]:
    """Rows of numbers, (0, 0) without any; `what` of the file they are is said where they are none.

    No line is taken beyond `max_rows`.

    Raises
    ------
    InputError
        If something among them is no number, or rows differ in length.
    """
    rows = iter(lines) if max_rows is None else islice(lines, max_rows)
    first = next(rows, None)
    if first is None:
        return np.zeros((0, 0))
    try:
        return np.loadtxt(chain([first], rows), delimiter=delimiter, comments=None, ndmin=2)
    except ValueError as e:
        said = str(e).partition(";")[0]  # what follows is numpy's advice to programmers
        raise InputError(f"{path}: {what} cannot be read ({said}).") from e


def read_rows(data: bytes, path: Path) -> Float[np.ndarray, "n k"]:
    """Rows of a text file, one line of names, or a count, before them; `#`, `/` and `;` comment.

    Raises
    ------
    InputError
        If there are none, or something among them is no number.
    """
    text = data.decode("utf-8", "replace")
    bare = (line.split("#", 1)[0].strip() for line in text.splitlines())
    lines = [line for line in bare if line and line[0] not in "/;"]
    if lines and (not _is_row(lines[0]) or lines[0].isdecimal()):
        lines = lines[1:]
    if not lines:
        raise InputError(f"{path}: the file holds no points; check the export.")
    delimiter = next((d for d in (",", ";") if d in lines[0]), None)
    return read_table(lines, path, "the points", delimiter=delimiter)


def _is_row(line: str) -> bool:
    """Whether a line is numbers."""
    try:
        [float(word) for word in line.replace(",", " ").replace(";", " ").split()]
    except ValueError:
        return False
    return True
