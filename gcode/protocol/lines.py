"""One line on its way to the printer: its number, its bytes, and whether it may take minutes.

Everything that can be done before a line's turn comes is done here, so that a host does it while
the printer is busy with the line before.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Sequence
from functools import reduce
from operator import xor
from typing import NamedTuple, overload

import numpy as np

from gcode.dialects import command_of
from gcode.errors import LocalProtocolError
from gcode.protocol.dialects import LinkDialect

SLOW_COMMANDS = frozenset(
    (
        *("G4", "G28", "G29", "G30", "G33", "G34", "G76", "G80"),
        *("M0", "M1", "M25", "M48", "M109", "M116", "M125", "M190", "M191", "M226", "M303"),
        *("M400", "M569", "M600", "M601", "M701", "M702", "M860", "M861"),
    )
)
"""Commands that may take minutes without an answer (OctoPrint's longRunningCommands and more)."""

_MACRO_NAME = re.compile(r"[A-Za-z_]{2}")
"""A command by name (Klipper) may be a whole script, and takes as long as its moves."""

_QUICK_MOVES = frozenset(("G0 ", "G1 "))
_NEWLINE = 10
_CHECKSUMS = tuple(f"*{value}\n" for value in range(256))
_FRAME_BYTES = 18
"""Most that number and checksum add to a command: `N`, nine digits, a space, `*255`, newline."""


class WireLine(NamedTuple):
    """A command as the wire carries it.

    Attributes
    ----------
    data
        What is written, newline included.
    slow
        It may take minutes without an answer.
    """

    number: int
    command: str
    data: bytes
    slow: bool


def wire_line(number: int, command: str, dialect: LinkDialect) -> WireLine:
    """Make the line that carries `command` as number `number`.

    Raises
    ------
    LocalProtocolError
        If the dialect cannot carry the command.
    """
    text = wire_text(command)
    data = numbered(number, text) if dialect.numbered else text + b"\n"
    excess = len(data) - dialect.max_line_bytes
    if excess > 0:
        if text[:4] not in (b"M117", b"M118"):
            raise LocalProtocolError(
                f"The line of {len(data)} bytes exceeds the {dialect.max_line_bytes} that "
                f"{dialect.name} takes before cutting it silently; shorten it: {command[:60]!r}."
            )
        text = text[: -int(excess)].rstrip()
        data = numbered(number, text) if dialect.numbered else text + b"\n"
    return WireLine(number, command, data, _takes_long(text.decode("ascii")))


class WireLines(Sequence[str | WireLine]):
    """Commands that come next, made ready together; each is what `Link.send` takes.

    Attributes
    ----------
    first
        Number of the first of them.
    """

    __slots__ = ("_breaks", "_commands", "_data", "_dialect", "first")

    def __init__(self, first: int, commands: Sequence[str], dialect: LinkDialect) -> None:
        self.first = first
        self._commands = commands
        self._dialect = dialect
        self._data = _numbered_at_once(first, commands, dialect)
        self._breaks = [i for i, line in enumerate(commands) if line[:3] not in _QUICK_MOVES]

    def __len__(self) -> int:
        return len(self._commands)

    @overload
    def __getitem__(self, index: int) -> str | WireLine: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[str | WireLine]: ...
    def __getitem__(self, index: int | slice) -> str | WireLine | Sequence[str | WireLine]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        command, number = self._commands[index], self.first + range(len(self))[index]
        if self._data is not None:
            return WireLine(number, command, self._data[index], _takes_long(command))
        try:
            return wire_line(number, command, self._dialect)
        except LocalProtocolError:
            return command

    def is_move(self, index: int) -> bool:
        """Whether `moves_from` has anything from there on; False beyond the end."""
        after = bisect_left(self._breaks, index)
        ends = self._breaks[after] if after < len(self._breaks) else len(self)
        return self._data is not None and index < ends

    def moves_from(self, index: int) -> list[bytes]:
        """What is written of the plain moves from `index` on, up to the first other command."""
        if self._data is None:
            return []
        after = bisect_left(self._breaks, index)
        return self._data[index : self._breaks[after] if after < len(self._breaks) else None]


def _numbered_at_once(
    first: int, commands: Sequence[str], dialect: LinkDialect
) -> list[bytes] | None:
    """Every command's bytes, ten times as fast as one by one; None where one of them is odd."""
    text = "\n".join(commands)
    plain = (
        text.isascii()
        and not any(odd in text for odd in (";", "\r", "\t", "\n\n", " \n", "\n ", "M110"))
        and text.count("\n") == len(commands) - 1
        and text == text.strip()
        and max(map(len, commands)) <= dialect.max_line_bytes - _FRAME_BYTES
    )
    if not plain:
        return None
    if not dialect.numbered:
        return (text + "\n").encode().splitlines(keepends=True)
    bodies = [f"N{number} {line}" for number, line in enumerate(commands, first)]
    data = np.frombuffer("\n".join((*bodies, "")).encode(), dtype=np.uint8)
    ends = np.flatnonzero(data == _NEWLINE)
    sums = np.bitwise_xor.reduceat(data, np.concatenate(([0], ends[:-1] + 1))) ^ _NEWLINE
    whole = map(str.__add__, bodies, map(_CHECKSUMS.__getitem__, sums.tolist()))
    return "".join(whole).encode().splitlines(keepends=True)


def _takes_long(text: str) -> bool:
    name, _ = command_of(text)
    return name in SLOW_COMMANDS or _MACRO_NAME.match(name) is not None


def checksum(data: bytes) -> int:
    """Exclusive or over `data`, the checksum of RepRap's protocol."""
    return reduce(xor, data, 0)


def numbered(number: int, text: bytes) -> bytes:
    """Put number and checksum around a command."""
    body = b"N%d %b" % (number, text)
    return b"%b*%d\n" % (body, checksum(body))


def command_in(line: str) -> str:
    """What a program's line says to the printer: no comment, and nothing that is a host's (@ …)."""
    command = line.partition(";")[0].strip()
    return "" if command.startswith("@") else command


def wire_text(command: str) -> bytes:
    """Strip a G-code line to what goes on the wire: no comment, no space around, ASCII.

    Raises
    ------
    LocalProtocolError
        If nothing is left, if the command would end the line early, or if it renumbers lines.
    """
    text = command.partition(";")[0].strip()
    if not text:
        raise LocalProtocolError("An empty line or a comment is not sent; leave it out.")
    if "\n" in text or "\r" in text:
        raise LocalProtocolError(f"A command is one line; split it: {command[:60]!r}.")
    if "M110" in text:
        if text[:4] not in ("M117", "M118"):
            raise LocalProtocolError(f"M110 renumbers lines and is the link's own: {text[:60]!r}.")
        text = text.replace("M110", "M 110")  # Marlin finds M110 anywhere in a numbered line
    return text.encode("ascii", "replace")
