"""Cuts what comes from a printer into lines, whatever pieces it comes in; never grows for ever."""

from __future__ import annotations

from collections.abc import Iterator

MAX_REPLY_BYTES = 4096
"""A reply longer than this is noise, dropped up to its newline."""


class Inbox:
    """Bytes that do not make a line yet.

    Attributes
    ----------
    empty
        Whether the next byte begins a line.
    """

    __slots__ = ("_bytes", "_skipping", "empty")

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._skipping = False
        self.empty = True

    def clear(self) -> None:
        """Forget the line that has begun."""
        self._bytes.clear()
        self.empty = not self._skipping

    def take(self, data: bytes) -> Iterator[tuple[bytes, bool]]:
        """Yield every line that `data` ends, and whether it is short enough to be read.

        Line ends are left out; of a line too long comes its beginning, once.
        """
        self._bytes += data
        if b"\n" in data:
            *lines, rest = bytes(self._bytes).split(b"\n")
            self._bytes = bytearray(rest)
            for raw in lines:
                if self._skipping:
                    self._skipping = False
                elif len(raw) > MAX_REPLY_BYTES:
                    yield raw[:80], False
                else:
                    yield raw.rstrip(b"\r"), True
        if len(self._bytes) > MAX_REPLY_BYTES:
            yield bytes(self._bytes[:80]), False
            self._bytes.clear()
            self._skipping = True
        self.empty = not self._bytes and not self._skipping
