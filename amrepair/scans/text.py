"""Tables of numbers that a file tells in text."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import AnyStr

import numpy as np
from jaxtyping import Float

from amrepair.errors import InputError


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
        raise InputError(f"{path}: {what} cannot be read ({said})") from e
