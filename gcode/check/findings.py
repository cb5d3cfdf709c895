"""What the checker reads and what it finds: the text, its moves, refusals and warnings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float, Int, UInt8

MOST_SHOWN = 60  # characters of a line in a message
PIECE_BYTES = 1 << 18  # of a text, looked through at a time


@dataclass(frozen=True, slots=True)
class Touch:
    """A touch of what stands on the bed that its caller has planned.

    Attributes
    ----------
    x_mm, y_mm
        The place, build frame.
    surface_mm
        The expected height of the surface there.
    lowest_mm
        The lowest height to which the touch may be sent.
    """

    x_mm: float
    y_mm: float
    surface_mm: float
    lowest_mm: float


class Policy(StrEnum):
    """What is refused, by whose program it is.

    `STRICT` is for our own programs, and holds them to every figure of the profiles. `DANGER` is
    for a user's own job: it refuses what can do damage, and only warns of the rest. A profile's
    figures of flow, speed, acceleration and bead size are those with which its machine prints
    well, and a user who prints a job every day may know better.
    """

    STRICT = "strict"
    DANGER = "danger"


@dataclass(frozen=True, slots=True)
class Refusal:
    """One reason why a program must not be printed.

    Attributes
    ----------
    line
        The number of the line, counted from 1.
    text
        The line itself.
    what
        What is wrong with it.
    value, limit
        The value found and the limit, as text with units.
    """

    line: int
    text: str
    what: str
    value: str
    limit: str

    def __str__(self) -> str:
        text = self.text.strip()
        shown = text if len(text) <= MOST_SHOWN else text[: MOST_SHOWN - 1] + "…"
        where = f"line {self.line} ({shown!r})" if shown else f"line {self.line}"
        return f"{where}: {self.what}: {self.value}, limit {self.limit}"


@dataclass(frozen=True, slots=True)
class Warned:
    """One kind of warning or refusal, told once for all lines that it applies to.

    Attributes
    ----------
    lines
        How many lines it applies to.
    worst
        The line that goes furthest beyond the limit; of refusals, the first line.
    """

    lines: int
    worst: Refusal

    def __str__(self) -> str:
        more = f"; {self.lines} lines do" if self.lines > 1 else ""
        return f"{self.worst}{more}"


def by_kind(refusals: Iterable[Refusal]) -> tuple[Warned, ...]:
    """Gather refusals by kind: the first of each, with the number of lines."""
    found: dict[str, Warned] = {}
    for refusal in refusals:
        before = found.get(refusal.what, Warned(0, refusal))
        found[refusal.what] = Warned(before.lines + 1, before.worst)
    return tuple(found.values())


class Warnings:
    """Warnings, gathered by kind."""

    def __init__(self) -> None:
        self._found: dict[str, tuple[int, float, Refusal]] = {}

    def add(self, refusal: Refusal, over_ratio: float) -> None:
        """Add a line that goes beyond its limit by a ratio."""
        count, worst_ratio, worst = self._found.get(refusal.what, (0, -1.0, refusal))
        if over_ratio > worst_ratio:
            worst_ratio, worst = over_ratio, refusal
        self._found[refusal.what] = (count + 1, worst_ratio, worst)

    def told(self) -> tuple[Warned, ...]:
        """All of them, in the order in which they were first met."""
        return tuple(Warned(count, worst) for count, _, worst in self._found.values())


@dataclass(frozen=True, slots=True)
class Text:
    """A program's bytes, and where its lines begin: one place more than there are lines."""

    data: UInt8[np.ndarray, " bytes"]
    starts: Int[np.ndarray, " lines"]

    @classmethod
    def of(cls, text: str) -> Text:
        """Lines as `split("\\n")` makes them."""
        data = np.frombuffer(text.encode(errors="replace"), dtype=np.uint8)
        starts = np.zeros(text.count("\n") + 2, np.int64)
        starts[-1] = len(data) + 1  # as if one more ended it
        at = 1
        for first in range(0, len(data), PIECE_BYTES):  # a flag for every byte takes as much again
            ends = np.flatnonzero(data[first : first + PIECE_BYTES] == ord("\n"))
            starts[at : at + len(ends)] = ends + (first + 1)
            at += len(ends)
        return cls(data, starts)

    def __len__(self) -> int:
        """How many lines."""
        return len(self.starts) - 1

    def line(self, number: int) -> str:
        """A line, counted from 1; all of them as strings take three times what the text does."""
        begin, end = self.starts[number - 1], self.starts[number] - 1
        return str(self.data[begin:end].tobytes(), "utf-8")


@dataclass(frozen=True, slots=True)
class MoveSums:
    """What is asked of moves all together.

    Attributes
    ----------
    count
        How many they are.
    pushed, laid
        Whether plastic is pushed on any of them, and on any that goes over the bed.
    top_mm
        How high the highest end is to which plastic is laid; 0 where none is.
    pulled, first_pulled
        On how many that go over the bed plastic is pulled back, and the line of the first; 0: none.
    pulled_mm, way_mm
        How far those go, and all on which plastic moves.
    """

    count: int = 0
    pushed: bool = False
    laid: bool = False
    top_mm: float = 0.0
    pulled: int = 0
    first_pulled: int = 0
    pulled_mm: float = 0.0
    way_mm: float = 0.0

    def __add__(self, later: MoveSums) -> MoveSums:
        return MoveSums(
            self.count + later.count,
            self.pushed or later.pushed,
            self.laid or later.laid,
            max(self.top_mm, later.top_mm),
            self.pulled + later.pulled,
            self.first_pulled or later.first_pulled,
            self.pulled_mm + later.pulled_mm,
            self.way_mm + later.way_mm,
        )


class Moves:
    """Moves with known ends; rows of line, start, end and plastic, below 0 where pulled back.

    Where only their sums will be asked for, rows may be forgotten.
    """

    def __init__(self) -> None:
        self.count = 0
        self._rows = np.empty((1024, 8))
        self._forgotten = MoveSums()

    @property
    def told(self) -> int:
        """How many there were."""
        return self._forgotten.count + self.count

    @property
    def sums(self) -> MoveSums:
        """Of all, those forgotten too."""
        rows = self._rows[: self.count]
        aside = (rows[:, 4] != rows[:, 1]) | (rows[:, 5] != rows[:, 2])
        pushed, pulled = rows[:, 7] > 0, (rows[:, 7] < 0) & aside
        way_mm = np.hypot(rows[:, 4] - rows[:, 1], rows[:, 5] - rows[:, 2])
        return self._forgotten + MoveSums(
            self.count,
            bool(pushed.any()),
            bool((pushed & aside).any()),
            float(np.max(rows[:, 6], initial=0.0, where=pushed & aside)),
            int(pulled.sum()),
            int(rows[np.argmax(pulled), 0]) if pulled.any() else 0,
            float(way_mm[pulled].sum()),
            float(way_mm[pulled | pushed].sum()),
        )

    def forget(self) -> None:
        """Keep the sums alone."""
        self._forgotten, self.count = self.sums, 0

    def with_room_for(self, more: int) -> Float[np.ndarray, "_rows 8"]:
        """The table, with rows to spare after the first `count`."""
        if self.count + more > len(self._rows):
            grown = np.empty((max(2 * len(self._rows), self.count + more), 8))
            grown[: self.count] = self._rows[: self.count]
            self._rows = grown
        return self._rows

    def add(
        self,
        line: int,
        start_mm: tuple[float, float, float],
        end_mm: tuple[float, float, float],
        pushed_mm3: float,
    ) -> None:
        """One more."""
        self.with_room_for(1)[self.count] = (line, *start_mm, *end_mm, pushed_mm3)
        self.count += 1

    @property
    def line(self) -> Int[np.ndarray, " n"]:
        """(n,) line of each, counted from 1."""
        return self._rows[: self.count, 0].astype(np.int64)

    @property
    def start_mm(self) -> Float[np.ndarray, "n 3"]:
        """(n, 3) where each begins."""
        return np.ascontiguousarray(self._rows[: self.count, 1:4])

    @property
    def end_mm(self) -> Float[np.ndarray, "n 3"]:
        """(n, 3) where each ends."""
        return np.ascontiguousarray(self._rows[: self.count, 4:7])

    @property
    def pushed_mm3(self) -> Float[np.ndarray, " n"]:
        """(n,) plastic laid on each."""
        return np.maximum(self._rows[: self.count, 7], 0.0)
