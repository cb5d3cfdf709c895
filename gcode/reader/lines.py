"""A program's text as lines: bytes and places, no strings but for comments."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, UInt8

from gcode.reader import text_kernels as kernels


def lines_of(text: str) -> tuple[UInt8[np.ndarray, " bytes"], Int[np.ndarray, " n1"]]:
    """A text's bytes, and where each line begins, with the end."""
    data = np.frombuffer(text.encode("utf-8", "replace"), np.uint8)
    return data, np.concatenate([[0], np.flatnonzero(data == ord("\n")) + 1, [len(data)]])


def comments_of(
    data: UInt8[np.ndarray, " bytes"],
    starts: Int[np.ndarray, " n1"],
    kinds: Int[np.ndarray, " n"],
) -> list[tuple[int, str]]:
    """Lines that are comments, with their numbers, from 0."""
    which = np.flatnonzero(kinds == ord(";")).tolist()
    return [
        (i, str(data[starts[i] : starts[i + 1]].tobytes(), "utf-8").removesuffix("\n"))
        for i in which
    ]


def tokens_of(
    data: UInt8[np.ndarray, " bytes"], starts: Int[np.ndarray, " n1"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, "n 10"]]:
    """Kinds, codes and words of lines, as `text_kernels.parse` fills them."""
    count = len(starts) - 1
    kinds, codes = np.zeros(count, np.int64), np.zeros(count, np.int64)
    words = np.zeros((count, len(kernels.LETTERS)))
    letters = np.frombuffer(kernels.LETTERS, np.uint8)
    kernels.parse(data, starts, letters, codes, kinds, words)
    return kinds, codes, words
