"""Reads one line of a printer's answer: bytes in, a reply out; never raises, never guesses.

A line that does not match its grammar to the last byte is `Unrecognised`: a garbled `ok` is not
an `ok`, and "hours" is not a resend (OctoPrint#205). State is `link`'s business.
"""

from __future__ import annotations

import re
from difflib import SequenceMatcher

from gcode.protocol.events import (
    Busy,
    Capability,
    CommandFailed,
    Echo,
    FirmwareInfo,
    HeaterReading,
    HostAction,
    LineError,
    Ok,
    PositionReport,
    PrinterReset,
    Resend,
    Said,
    ShutDown,
    TemperatureReport,
    UnknownCommand,
    Unrecognised,
    Waiting,
)

Reply = Ok | Resend | Said

_REPLIED_NUMBER = r"[-+]?\d{1,9}(?:\.\d{0,9})?"
_RESEND = re.compile(r"(?:resend|rs)\s*[: ]\s*N?(\d{1,9})\s*", re.IGNORECASE)
_OK_REPLY = re.compile(r"ok(?:\s+(.*))?", re.DOTALL)
_ADVANCED = re.compile(r"(?:N(\d{1,9})\s*)?(?:P\d{1,4}\s+)?(?:B\d{1,4})?\s*")
_BUSY_REPLY = re.compile(r"(?:echo:\s*)?busy:\s*(.+)", re.IGNORECASE)
_HEATER = re.compile(rf"\b([TBCPA]\d{{0,2}}):\s?({_REPLIED_NUMBER})(?:\s*/\s*({_REPLIED_NUMBER}))?")
_TEMPERATURES = re.compile(
    rf"[TBCPA]\d{{0,2}}:\s?{_REPLIED_NUMBER}(?:\s*/\s*{_REPLIED_NUMBER})?(?:\s.*)?"
)
_POSITION = re.compile(
    rf"X:\s?({_REPLIED_NUMBER})\s+Y:\s?({_REPLIED_NUMBER})\s+Z:\s?({_REPLIED_NUMBER})\s+E:\s?({_REPLIED_NUMBER})\b.*"
)
_CAPABILITY = re.compile(r"Cap:([A-Z0-9_]{1,40}):([01])")
_FIRMWARE_NAME = re.compile(r"FIRMWARE_NAME:\s*(\S[^:]*?)(?:\s+[A-Z_]+:.*)?$")
_ACTION = re.compile(r"//\s?action:\s*(\S.*)")
_UNKNOWN_COMMAND = re.compile(r"(?:echo:\s*|//\s*)?unknown command:.*", re.IGNORECASE | re.DOTALL)
_BAD_COMMAND = re.compile(r"error:\s*bad command:.*", re.IGNORECASE | re.DOTALL)
"""RepRapFirmware's words for it; what it repeats after them is what arrived, any bytes at all."""

# What firmwares print as they boot: Marlin `start`, reset causes (`setup()` of MarlinCore),
# Repetier the same; Klipper tells of its restart with `// Klipper state:`; RepRap.cpp of
# RepRapFirmware.
_BANNER = re.compile(
    r"start"
    r"|(?:echo:\s*)?(?:PowerUp|External Reset|Brown out Reset|Watchdog Reset|Software Reset)\s*"
    r"|//\s?Klipper state: (?:Disconnect|Startup|Ready)"
    r"|RepRapFirmware\b.* is up and running\.?"
)
_SHUT_DOWN = re.compile(r"//\s?Klipper state: Shutdown")
# Transmission errors of Marlin, Prusa, Repetier and OctoPrint's virtual printer.
_LINE_ERROR = re.compile(
    r"checksum|line number|expected line|last line|format error", re.IGNORECASE
)
_LINE_ERRORS = (
    "checksum mismatch, last line: ",
    "no checksum with line number, last line: ",
    "no line number with checksum, last line: ",
    "line number is not last line number+1, last line: ",
)
"""Marlin's own (`queue.cpp`), for those that arrive with some letters damaged."""
_ALIKE = 0.75
"""Of the letters of two texts, in order; no other error of Marlin's comes near."""
_LAST_LINE = re.compile(r"last line: ?(\d{1,9})", re.IGNORECASE)
# Errors that no command of ours caused and that hurt no print (Marlin, SD card).
_HARMLESS_ERROR = re.compile(r"volume\.init|openRoot|SD card|workDir|no media", re.IGNORECASE)
_FATAL = re.compile(
    r"halted|kill|thermal runaway|system stopped|heating failed|m[ai][xn]temp|watchdog|overtemp"
    r"|undertemp|malfunction|shutdown|emergency",
    re.IGNORECASE,
)
_PRINTABLE = re.compile(rb"[\t\x20-\x7e\xb0\xc2]*")


def parse_reply(raw: bytes) -> Reply:
    """Read one line, its newline left out.

    Parameters
    ----------
    raw
        Any bytes at all.

    Returns
    -------
    The reply; `Unrecognised` where the bytes follow no grammar.
    """
    if raw == b"ok":
        return Ok()
    if _PRINTABLE.fullmatch(raw) is None:
        text = raw.decode("latin-1").strip()
        if _UNKNOWN_COMMAND.fullmatch(text):
            return UnknownCommand(text)
        return _error(text[6:].strip()) if _BAD_COMMAND.fullmatch(text) else Unrecognised(raw)
    text = raw.decode("latin-1").strip()
    if not text:
        return Echo("")
    head = text[0]
    if head == "o" and (match := _OK_REPLY.fullmatch(text)):
        return _parse_ok(match.group(1) or "", raw)
    if head in "Rr" and (match := _RESEND.fullmatch(text)):
        return Resend(int(match.group(1)))
    if match := _BUSY_REPLY.fullmatch(text):
        return Busy(match.group(1).strip())
    if head in "TBCPA" and _TEMPERATURES.fullmatch(text):
        return _temperatures(text)
    if head == "X" and (position := _position(text)):
        return position
    if text == "wait":
        return Waiting()
    if _BANNER.fullmatch(text):
        return PrinterReset(text)
    if _SHUT_DOWN.fullmatch(text):
        return ShutDown(text)
    if text.startswith("!!"):
        return CommandFailed(text[2:].strip(), fatal=_FATAL.search(text) is not None)
    if text[:6].lower() == "error:":
        return _error(text[6:].strip())
    if match := _ACTION.fullmatch(text):
        return HostAction(match.group(1).strip())
    if _UNKNOWN_COMMAND.fullmatch(text):
        return UnknownCommand(text)
    if match := _CAPABILITY.fullmatch(text):
        return Capability(match.group(1), match.group(2) == "1")
    if text.startswith("FIRMWARE_NAME:"):
        return _firmware(text)
    if head in "Rro" and re.match(r"(?:resend|rs\b|ok)", text, re.IGNORECASE):
        return Unrecognised(raw)  # meant as a reply, garbled on the way
    return Echo(text)


def _parse_ok(rest: str, raw: bytes) -> Reply:
    if not rest:
        return Ok()
    match = _ADVANCED.fullmatch(rest)
    if match:
        return Ok(int(match[1]) if match[1] else None)
    if _TEMPERATURES.fullmatch(rest):
        return Ok(more=(_temperatures(rest),))
    if position := _position(rest):
        return Ok(more=(position,))
    if rest.startswith("FIRMWARE_NAME:"):
        return Ok(more=(_firmware(rest),))
    if rest.startswith(("*", "(")) or rest[0].isalnum():
        return Ok(more=(Echo(rest),))
    return Unrecognised(raw)


def _temperatures(text: str) -> TemperatureReport:
    return TemperatureReport(
        {
            name: HeaterReading(float(current), float(target) if target else None)
            for name, current, target in _HEATER.findall(text)
        }
    )


def _position(text: str) -> PositionReport | None:
    match = _POSITION.fullmatch(text)
    return PositionReport(*map(float, match.groups())) if match else None


def _firmware(text: str) -> FirmwareInfo:
    match = _FIRMWARE_NAME.match(text)
    return FirmwareInfo(text, match.group(1) if match else text)


def _error(text: str) -> Reply:
    if _FATAL.search(text):
        return CommandFailed(text, fatal=True)
    if _LINE_ERROR.search(text) or _is_damaged_line_error(text):
        last = _LAST_LINE.search(text)
        return LineError(text, int(last.group(1)) if last else None)
    if _HARMLESS_ERROR.search(text):
        return Echo(f"Error:{text}")
    if text.lower().startswith("unknown command"):
        return UnknownCommand(text)
    return CommandFailed(text, fatal=False)


def repeats(raw: bytes, line: bytes) -> bool:
    """Whether a text ends with most of a line that was sent, whatever was damaged of either."""
    sent = line.strip()
    return SequenceMatcher(None, raw.rstrip()[-len(sent) :], sent).ratio() >= _ALIKE


def _is_damaged_line_error(text: str) -> bool:
    said = text.lower().rstrip("0123456789")
    return any(SequenceMatcher(None, said, one).ratio() >= _ALIKE for one in _LINE_ERRORS)
