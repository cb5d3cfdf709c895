"""Number and checksum of a line, as the firmwares read them: verified, half believed, or unread."""

from __future__ import annotations

import re
from functools import reduce
from operator import xor
from typing import Literal, NamedTuple

LINE_NUMBER = re.compile(rb"N\s*(-?\d{1,10})\s*")
RENUMBERED = re.compile(rb"N(-?\d{1,10})")

Numbers = Literal["verify", "checksum", "ignore"]


class Unframed(NamedTuple):
    """A line without its number and checksum.

    Attributes
    ----------
    command
        Freed of number and checksum; None if the line is not taken.
    number
        What the line's number makes the printer's; None if that stays as it is.
    refusal
        Why the line is asked for again; empty if it is taken, or dropped without a word.
    """

    command: bytes | None
    number: int | None = None
    refusal: str = ""


def unframed(command: bytes, numbers: Numbers, last_number: int) -> Unframed:
    """Read the frame of a line, `last_number` having come last."""
    match = LINE_NUMBER.match(command)
    if match is None:
        return Unframed(command)
    if numbers == "verify":
        return _verified(command, match, last_number)
    star = command.rfind(b"*")
    body = command[match.end() :] if star < 0 else command[match.end() : star]
    if numbers == "ignore" or star < 0:
        return Unframed(body.strip() or None)
    if not _checksum_right(command, star):
        return Unframed(None)  # RepRapFirmware drops it silently
    return Unframed(body.strip() or None, int(match.group(1)))


def _verified(command: bytes, match: re.Match[bytes], last_number: int) -> Unframed:
    """Marlin's `get_serial_commands`: number, then checksum; or a resend request."""
    number, star = int(match.group(1)), command.rfind(b"*")
    renumbers = b"M110" in command
    if renumbers and (again := RENUMBERED.search(command[4:])) is not None:
        number = int(again.group(1))
    if not renumbers and number != last_number + 1:
        return Unframed(None, refusal="Line Number is not Last Line Number+1")
    if star < 0:
        return Unframed(None, refusal="No Checksum with line number")
    if not _checksum_right(command, star):
        return Unframed(None, refusal="checksum mismatch")
    return Unframed(command[match.end() : star].rstrip(), number)


def _checksum_right(command: bytes, star: int) -> bool:
    try:
        return int(command[star + 1 :]) == reduce(xor, command[:star])
    except ValueError:
        return False
