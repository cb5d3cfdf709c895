"""The wire log: every byte either way with its time, in files that rotate.

It is evidence, not logging: a file of its own, never filtered. It never sees a secret, because
serial lines carry none. What cannot be written ends it, and nothing else.
"""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path

_log = logging.getLogger(__name__)
FLUSH_ENTRIES = 2000
FLUSH_S = 1.0
"""A killed sender's log ends no earlier than this before its death."""


class WireLog:
    """Append-only; `>` to the printer, `<` from it, `#` a remark of the host.

    Parameters
    ----------
    max_bytes
        Size at which the file is renamed `.1` (`.1` to `.2`, and so on up to `keep`).
    epoch_s
        Added to every time: what turns the caller's clock into seconds since 1970.
    """

    def __init__(
        self, path: Path, *, max_bytes: int = 64_000_000, keep: int = 3, epoch_s: float = 0.0
    ) -> None:
        self.path = path
        self._epoch_s = epoch_s
        self._flush_s = float("inf")
        self._max_bytes = max_bytes
        self._keep = keep
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("ab")
        self._size = self._file.tell()
        self._entries: list[tuple[float, bytes, bytes]] = []
        self._ended = False

    def add(self, now_s: float, direction: bytes, data: bytes) -> None:
        """Note bytes; they are written in batches."""
        if self._ended:
            return
        entries = self._entries
        if not entries:
            self._flush_s = now_s + FLUSH_S
        entries.append((now_s, direction, data))
        if len(entries) >= FLUSH_ENTRIES or now_s >= self._flush_s:
            self.flush()

    def flush(self) -> None:
        """Write what is noted."""
        if not self._entries:
            return
        rows = [
            b"%.6f %b %b"
            % (self._epoch_s + now_s, direction, data.rstrip(b"\n").replace(b"\n", b"\\n"))
            for now_s, direction, data in self._entries
        ]
        self._entries.clear()
        blob = b"\n".join(rows) + b"\n"
        try:
            if self._size and self._size + len(blob) > self._max_bytes:
                self._rotate()
            self._file.write(blob)
            self._file.flush()
        except OSError as error:
            self._end(error)
        self._size += len(blob)

    def _end(self, error: OSError) -> None:
        """Log nothing more: a print, and above all its safe exit, does without."""
        self._ended = True
        _log.warning("the wire log %s ends here: %s", self.path, error.strerror or error)
        with contextlib.suppress(OSError):  # it would write what was refused once more
            self._file.close()

    def _rotate(self) -> None:
        self._file.close()
        for index in range(self._keep, 0, -1):
            older = self.path.with_name(f"{self.path.name}.{index}")
            newer = (
                self.path if index == 1 else self.path.with_name(f"{self.path.name}.{index - 1}")
            )
            if newer.exists():
                newer.replace(older)
        self._file = self.path.open("ab")
        self._size = 0

    def close(self) -> None:
        """Write what is left and close."""
        self.flush()
        if not self._ended:
            self._file.close()
