"""The file adapter: a printer that is a file on disk, for jobs carried over by hand.

It has no temperatures and no position, and says so. Each run writes the job anew: parts printed
by several `print` calls in a row follow one another; the file appears only when it is closed.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import IO

from gcode.errors import InputError, LinkError
from gcode.hosts.port import Capabilities, PrintableProgram, PrintReport, Temperatures
from gcode.hosts.proof import require_checked
from gcode.progress import Progress, silent


class FilePrinter:
    """Writes programs to `path`, whole or not at all."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: IO[str] | None = None
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}.part")

    def __enter__(self) -> FilePrinter:
        self.connect()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None:
            self.abort()
        self.close()

    def connect(self) -> None:
        """Begin the file."""
        if self.path.is_dir():
            raise InputError(f"{self.path} cannot be written: it is a folder; name a file in it.")
        with self._told():
            self._file = self._temporary.open("w", encoding="utf-8", newline="\n")

    def close(self) -> None:
        """Put the file in place."""
        if self._file is not None:
            with self._told():
                self._file.close()
                self._temporary.replace(self.path)
            self._file = None

    def capabilities(self) -> Capabilities:
        """Return what a file can do: nothing."""
        return Capabilities("file")

    def temperatures(self) -> Temperatures:
        """Refuse: a file has no temperature."""
        raise LinkError(f"{self.path} is a file and has no temperatures; use a printer's port.")

    def position_mm(self) -> tuple[float, float, float]:
        """Refuse: a file has no position."""
        raise LinkError(f"{self.path} is a file and has no position; use a printer's port.")

    def print(
        self,
        checked: PrintableProgram,
        *,
        lines: range | None = None,
        progress: Progress = silent,
    ) -> PrintReport:
        """Append a program, or a part of it, comments included."""
        require_checked(checked)
        if self._file is None:
            raise LinkError(f"{self.path} is not open; call connect() first.")
        start_s = time.monotonic()
        text = checked.program.text
        whole = text.count("\n") + (not text.endswith("\n"))  # no line follows the last newline
        first, end = (0, whole) if lines is None else (lines.start, min(lines.stop, whole))
        written, size = 0, 0
        with self._told():
            for line in checked.lines(first, end):
                self._file.write(line + "\n")
                written += bool(line.partition(";")[0].strip())
                size += len(line) + 1
        progress("writing", 1.0, 1.0)
        seconds = time.monotonic() - start_s
        return PrintReport(True, written, size, seconds, next_line=end, first_line=first)

    def finish_moves(self) -> None:
        """Nothing moves."""

    def pause(self) -> None:
        """Nothing can be paused."""

    def resume(self) -> None:
        """Nothing can be resumed."""

    def abort(self) -> None:
        """Drop the file."""
        if self._file is not None:
            with suppress(OSError):  # what a full disk did not take is not wanted any more
                self._file.close()
            self._file = None
            self._temporary.unlink(missing_ok=True)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Within it, what the system refuses is told of the file, and no part of it stays."""
        try:
            yield
        except OSError as error:
            self.abort()
            raise InputError(
                f"{self.path} cannot be written ({error.strerror}); name another file."
            ) from error

    def emergency_stop(self) -> None:
        """Drop the file."""
        self.abort()

    def heaters_off(self) -> None:
        """Nothing is hot."""
