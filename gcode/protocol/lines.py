"""One line on its way to the printer: its number, its bytes, and whether it may take minutes.

Everything that can be done before a line's turn comes is done here, so that a host does it while
the printer is busy with the line before.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import reduce
from operator import xor
from typing import NamedTuple

import numpy as np

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

_MACRO = re.compile(r"[A-Za-z_]{2}")
"""A command by name (Klipper) may be a whole script, and takes as long as its moves."""

_QUICK = frozenset(("G0 ", "G1 "))
_NEWLINE = 10
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
        text = text[:-excess].rstrip()
        data = numbered(number, text) if dialect.numbered else text + b"\n"
    return WireLine(number, command, data, _takes_long(text.decode("ascii")))


def wire_lines(first: int, commands: Sequence[str], dialect: LinkDialect) -> list[str | WireLine]:
    """Make many lines at once, numbered from `first` on: three times as fast as one by one.

    A command that the dialect cannot carry is left as it is, for its turn to be refused.
    """
    text = "\n".join(commands)
    plain = (
        text.isascii()
        and not any(odd in text for odd in (";", "\r", "\t", "\n\n", " \n", "\n ", "M110"))
        and text.count("\n") == len(commands) - 1
        and text == text.strip()
        and max(map(len, commands)) <= dialect.max_line_bytes - _FRAME_BYTES
    )
    if not plain:
        return [_line_or_command(first + i, line, dialect) for i, line in enumerate(commands)]
    if not dialect.numbered:
        made = [line.encode() + b"\n" for line in commands]
    else:
        bodies = [f"N{number} {line}" for number, line in enumerate(commands, first)]
        data = np.frombuffer("\n".join((*bodies, "")).encode(), dtype=np.uint8)
        ends = np.flatnonzero(data == _NEWLINE)
        sums = np.bitwise_xor.reduceat(data, np.concatenate(([0], ends[:-1] + 1))) ^ _NEWLINE
        made = [
            b"%b*%d\n" % (body.encode(), x) for body, x in zip(bodies, sums.tolist(), strict=True)
        ]
    numbers = range(first, first + len(commands))
    slow = [line[:3] not in _QUICK and _takes_long(line) for line in commands]
    return list(map(WireLine._make, zip(numbers, commands, made, slow, strict=True)))


def _line_or_command(number: int, command: str, dialect: LinkDialect) -> str | WireLine:
    try:
        return wire_line(number, command, dialect)
    except LocalProtocolError:
        return command


def _takes_long(text: str) -> bool:
    name = text.partition(" ")[0]
    return name in SLOW_COMMANDS or _MACRO.match(name) is not None


def checksum(data: bytes) -> int:
    """Exclusive or over `data`, the checksum of RepRap's protocol."""
    return reduce(xor, data, 0)


def numbered(number: int, text: bytes) -> bytes:
    """Put number and checksum around a command."""
    body = b"N%d %b" % (number, text)
    return b"%b*%d\n" % (body, reduce(xor, body))


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
