"""A program read block by block: the machine's states and what is laid, line by line.

A whole program's words and states take ten times its text; whoever wants sums of them, or a few
figures of each line, reads it in blocks and keeps those.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from gcode.dialects import dialect_of
from gcode.moves import Program
from gcode.progress import Progress, silent
from gcode.reader import text_kernels as kernels
from gcode.reader.named import number_named

BLOCK_CHARS = 1 << 16  # some 2,000 lines: half a megabyte of words and states
READ_STEPS = 4.0  # words, states, beads, layers: about a second each for a million lines


@dataclass(frozen=True, slots=True)
class Block:
    """Lines of a program that follow each other.

    Attributes
    ----------
    first_line
        Number of its first, from 0.
    states
        (m + 1, 12 + heads) of the machine before each line and after the last, as `text_kernels`
        has them.
    pushed_mm
        (m,) filament pushed by each line.
    comments
        Lines that are comments, with their numbers in the program.
    start_mm, end_mm, filament_mm, line
        (n, 3), (n,): what extrudes, arcs as chords, where its place is known; lines of the program.
    """

    first_line: int
    states: Float[np.ndarray, "m1 columns"]
    pushed_mm: Float[np.ndarray, " m"]
    comments: list[tuple[int, str]]
    start_mm: Float[np.ndarray, "n 3"]
    end_mm: Float[np.ndarray, "n 3"]
    filament_mm: Float[np.ndarray, " n"]
    line: Int[np.ndarray, " n"]

    @property
    def end_line(self) -> int:
        """The line after its last."""
        return self.first_line + len(self.pushed_mm)

    def moves(
        self,
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """By line: (m, 3) displacement, mm (NaN where the place before is not known), (m,)
        filament pushed, mm, and (m,) commanded speed, mm/s.
        """
        steps = np.diff(self.states[:, :3], axis=0)
        return steps, self.pushed_mm, self.states[1:, kernels.S_FEED]


class BlockReader:
    """Reads texts that go on from one another; nothing is known before the first.

    Parameters
    ----------
    nozzles
        How many heads the printer has that are heated by themselves.
    """

    def __init__(self, dialect: str, nozzles: int = 1) -> None:
        words_of = dialect_of(dialect)
        self._modes = words_of.g90_sets_e, words_of.g91_moves_e, words_of.tool_zeroes_e
        self._named = words_of.names_heaters
        self._offset = np.zeros(3)
        self._state = np.zeros(kernels.S_HOT + nozzles)
        self._state[:3] = np.nan
        self._state[[kernels.S_ABS, kernels.S_ABS_E, kernels.S_MM]] = 1.0
        self._state[kernels.S_ACC] = np.nan
        self._line = 0

    def read(self, text: str, progress: Progress = silent) -> Block:
        """The block of the lines of a text."""
        data, starts = lines_of(text)
        kinds, codes, words = tokens_of(data, starts)
        if self._named:
            number_named(data, starts, kinds, codes, words)
        comments = self._comments(data, starts, kinds)
        del data
        progress("read", 1.0, READ_STEPS)
        states = np.zeros((len(starts), len(self._state)))
        states[0] = self._state
        pushed = np.zeros(len(kinds))
        kernels.run(kinds, codes, words, *self._modes, self._offset, states, pushed)
        progress("read", 2.0, READ_STEPS)
        none3, none1, none0 = np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64)
        count = kernels.beads(kinds, codes, words, states, pushed, none3, none3, none1, none0, True)
        start, end = np.zeros((count, 3)), np.zeros((count, 3))
        filament, owner = np.zeros(count), np.zeros(count, np.int64)
        kernels.beads(kinds, codes, words, states, pushed, start, end, filament, owner, False)
        del words  # as much as all the rest
        known = np.isfinite(start).all(axis=1) & np.isfinite(end).all(axis=1)
        if not known.all():
            start, end, filament, owner = start[known], end[known], filament[known], owner[known]
        progress("read", 3.0, READ_STEPS)
        first, self._line, self._state = self._line, self._line + len(kinds), states[-1].copy()
        return Block(first, states, pushed, comments, start, end, filament, owner + first)

    def _comments(
        self,
        data: UInt8[np.ndarray, " bytes"],
        starts: Int[np.ndarray, " n1"],
        kinds: Int[np.ndarray, " n"],
    ) -> list[tuple[int, str]]:
        """Lines that are comments, with their numbers in the program."""
        which = np.flatnonzero(kinds == ord(";")).tolist()
        return [
            (
                self._line + i,
                str(data[starts[i] : starts[i + 1]].tobytes(), "utf-8").removesuffix("\n"),
            )
            for i in which
        ]


def lines_of(text: str) -> tuple[UInt8[np.ndarray, " bytes"], Int[np.ndarray, " n1"]]:
    """A text's bytes, and where each line begins, with the end."""
    data = np.frombuffer(text.encode("utf-8", "replace"), np.uint8)
    return data, np.concatenate([[0], np.flatnonzero(data == ord("\n")) + 1, [len(data)]])


def tokens_of(
    data: UInt8[np.ndarray, " bytes"], starts: Int[np.ndarray, " n1"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, "n 11"]]:
    """Kinds, codes and words of lines, as `text_kernels.parse` fills them."""
    count = len(starts) - 1
    kinds, codes = np.zeros(count, np.int64), np.zeros(count, np.int64)
    words = np.zeros((count, len(kernels.LETTERS)))
    letters = np.frombuffer(kernels.LETTERS, np.uint8)
    kernels.parse(data, starts, letters, codes, kinds, words)
    return kinds, codes, words


def blocks_of(program: Program, chars: int = BLOCK_CHARS) -> Iterator[Block]:
    """A program's blocks, of about so many characters each; of several heads as if all were one."""
    text, reader, at = program.text, BlockReader(program.dialect), 0
    while at >= 0:
        end = text.find("\n", at + chars)
        yield reader.read(text[at:] if end < 0 else text[at:end])
        at = end + 1 if end >= 0 else -1
