"""Tables of numbers that a file tells in text."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from amrepair.errors import InputError


def read_table(
    lines: Iterable[str] | Iterable[bytes],
    path: Path,
    what: str,
    *,
    delimiter: str | None = None,
    max_rows: int | None = None,
) -> Float[np.ndarray, "n k"]:
    """Rows of numbers; `what` of the file they are is said where they are none.

    Raises
    ------
    InputError
        If something among them is no number, or rows differ in length.
    """
    try:
        return np.loadtxt(lines, delimiter=delimiter, max_rows=max_rows, ndmin=2)
    except ValueError as e:
        said = str(e).partition(";")[0]  # what follows is numpy's advice to programmers
        raise InputError(f"{path}: {what} cannot be read ({said})") from e
