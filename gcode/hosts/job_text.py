"""A job's file as a server's own printer reads it: which byte begins which line."""

from __future__ import annotations

from bisect import bisect_left

LOOK_COMMANDS = ("AMREPAIR_SCAN", "@amrepair scan")
"""What a host pauses at and hands on; anything else that stands at a mark is the firmware's own."""


class JobText:
    """A job's file as a server reads it: which byte begins which line."""

    def __init__(self, data: bytes) -> None:
        self._lines = data.split(b"\n")
        self._starts = [0]
        for line in self._lines:
            self._starts.append(self._starts[-1] + len(line) + 1)

    @property
    def lines(self) -> int:
        """How many lines end in the file."""
        return len(self._lines) - 1

    @property
    def rows(self) -> list[str]:
        """The lines, as text."""
        return [line.decode("utf-8", "replace").rstrip("\r") for line in self._lines[: self.lines]]

    def start(self, line: int) -> int:
        """The byte that a line begins with."""
        return self._starts[line]

    def line_at(self, byte: int) -> int:
        """The first line that begins at this byte or later."""
        return bisect_left(self._starts, byte)

    def is_look(self, line: int) -> bool:
        """Whether the line before this one asks for a look."""
        if not 0 < line < len(self._lines):
            return False
        return self._lines[line - 1].strip().decode("utf-8", "replace").startswith(LOOK_COMMANDS)
