"""A program, or a part of it, as the file that a print server takes."""

from __future__ import annotations

import hashlib
import secrets
from dataclasses import dataclass

from gcode.hosts.port import PrintableProgram


def part_prefix(checked: PrintableProgram, first: int, end: int) -> str:
    """How the names of all files begin that hold those lines of a program."""
    return f"gcode-{checked.program.sha256[:12]}-{first}-{end}-"


@dataclass(frozen=True, slots=True)
class JobFile:
    """Lines [first, end) of a program as one file.

    Attributes
    ----------
    name
        File name, different for every print, so that news of one is not taken for another's.
    commands
        Lines that a printer carries out: neither empty nor comment.
    """

    name: str
    data: bytes
    first: int
    end: int
    commands: int

    @classmethod
    def of(cls, checked: PrintableProgram, lines: range | None) -> JobFile:
        """Cut the file out of a program."""
        total = checked.program.line_count + 1
        first, end = (0, total) if lines is None else (lines.start, lines.stop)
        rows = checked.lines(first, end)
        text = "\n".join(rows)
        return cls(
            name=f"{part_prefix(checked, first, end)}{secrets.token_hex(4)}.gcode",
            data=(text if text.endswith("\n") else text + "\n").encode("utf-8"),
            first=first,
            end=end,
            commands=sum(bool(row.partition(";")[0].strip()) for row in rows),
        )

    @property
    def sha1(self) -> str:
        """What OctoPrint calls the file's hash."""
        return hashlib.sha1(self.data, usedforsecurity=False).hexdigest()

    @property
    def sha256(self) -> str:
        """What Moonraker calls the file's checksum."""
        return hashlib.sha256(self.data).hexdigest()

    def line_at(self, offset: int) -> int:
        """Return the program line that a byte of the file belongs to."""
        return self.first + self.data.count(b"\n", 0, max(offset, 0))
