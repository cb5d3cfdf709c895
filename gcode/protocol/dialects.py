"""How the dialects differ on the wire: one table, each fact with its reason.

The words of G-code are the business of `gcode.dialects`; here is only what the link must know.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LinkDialect:
    """What a firmware does with lines, numbers and checksums.

    Attributes
    ----------
    numbered
        Lines carry `N` and a checksum.
    verifies
        The firmware refuses a line whose number is not the next one and whose checksum is
        wrong, so that sending a line again is idempotent: the ground of every recovery.
    max_line_bytes
        The longest line the firmware takes; longer ones are cut silently (MAX_CMD_SIZE).
    rx_bytes
        Receive buffer of the firmware: what may be under way beyond one line.
    greets
        The firmware prints a banner when it starts, so that a reset can be told.
    buffered_lines
        Most lines that are acknowledged and not yet moved: what a reset loses.
    """

    name: str
    numbered: bool
    verifies: bool
    max_line_bytes: int
    rx_bytes: int
    greets: bool
    buffered_lines: int = 80


LINK_DIALECTS: dict[str, LinkDialect] = {
    # BUFSIZE 4 to 16 and BLOCK_BUFFER_SIZE 16 to 64 in Marlin's shipped configurations.
    # MAX_CMD_SIZE 96, RX_BUFFER_SIZE 128 (Configuration_adv.h of Marlin 2.1).
    "marlin": LinkDialect("marlin", True, True, 95, 120, True),
    "prusa": LinkDialect("prusa", True, True, 95, 120, True),
    # gcode.py strips N and checksum unread; a pseudo-terminal loses nothing, so a lost answer
    # means a lost host process: nothing can be proved and nothing is sent again. Its look-ahead
    # is seconds long (toolhead.py, BUFFER_TIME_HIGH 2 s): 1000 of the shortest moves.
    "klipper": LinkDialect("klipper", False, False, 4095, 4095, False, 1000),
    # RepRapFirmware 3.6 drops a line with a bad checksum silently and executes a repeated
    # number again: a line without an answer cannot be sent twice.
    "reprap": LinkDialect("reprap", True, False, 255, 255, False),
}
