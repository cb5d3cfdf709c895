"""One line on its way to the printer: its number, its bytes, and whether it may take minutes.

Everything that can be done before a line's turn comes is done here, so that a host does it while
the printer is busy with the line before.
"""

from __future__ import annotations

import re
from functools import reduce
from operator import xor
from typing import NamedTuple

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


class WireLine(NamedTuple):
    """A command as the wire carries it; `slow` if it may take minutes without an answer."""

    data: bytes
    slow: bool


def wire_line(number: int, command: str, dialect: LinkDialect) -> WireLine:
    """Make the line that carries `command` as number `number`, newline included.

    Raises
    ------
    LocalProtocolError
        If the dialect cannot carry the command.
    """
    text = wire_text(command)
    data = numbered(number, text) if dialect.numbered else text + b"\n"
    if len(data) > dialect.max_line_bytes:
        if text[:4] not in (b"M117", b"M118"):
            raise LocalProtocolError(
                f"The line of {len(data)} bytes exceeds the {dialect.max_line_bytes} that "
                f"{dialect.name} takes before cutting it silently; shorten it: {command[:60]!r}."
            )
        return wire_line(number, command[: dialect.max_line_bytes - len(data)], dialect)
    return WireLine(data, _takes_long(text))


def _takes_long(text: bytes) -> bool:
    if text.startswith((b"G1 ", b"G0 ")):
        return False  # the beaten path
    name = text.split(b" ", 1)[0].decode("ascii", "replace")
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
