"""How the dialects differ on the wire: one table, each fact with its reason.

The words of G-code are the business of `gcode.dialects`; here is only what the link must know.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf


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
        The longest line the firmware takes; longer ones are cut silently (MAX_CMD_SIZE). Infinity
        where a line may be of any length.
    rx_bytes
        Receive buffer of the firmware: what may be under way beyond one line.
    buffered_lines
        Most lines that are acknowledged and not yet moved: what a reset loses.
    motors_off_s
        How long after the last move the motors are let go, and with them the certainty of where
        the nozzle is; infinity where they keep a part of their current.
    question
        Where a repeated line would be carried out again, yet none is lost on its way: a question
        whose answer shows that every line before it was carried out, so that a lost answer may be
        asked for. Empty where a line may be lost, too: then nothing can be proved.
    hold_motors
        Command after which they are held for good; empty where there is none.
    set_z
        Command that has the axis be at `{z}` from now on, and taken for homed.
    touches_by_macro
        A touch is a macro of ours, which says where it ended and lowers Z for it; else G38.2,
        after which the place is asked for.
    """

    name: str
    numbered: bool
    verifies: bool
    max_line_bytes: float
    rx_bytes: int
    buffered_lines: int = 80
    motors_off_s: float = 120.0
    hold_motors: str = ""
    question: bytes = b""
    set_z: str = "G92 Z{z}"
    touches_by_macro: bool = False


LINK_DIALECTS: dict[str, LinkDialect] = {
    # BUFSIZE 4 to 16 and BLOCK_BUFFER_SIZE 16 to 64 in Marlin's shipped configurations.
    # MAX_CMD_SIZE 96, RX_BUFFER_SIZE 128 (Configuration_adv.h of Marlin 2.1).
    # DEFAULT_STEPPER_DEACTIVE_TIME 120; `M84 S0` sets the time to never (M18_M84.cpp).
    "marlin": LinkDialect("marlin", True, True, 95, 120, hold_motors="M84 S0"),
    "prusa": LinkDialect("prusa", True, True, 95, 120, hold_motors="M84 S0"),
    # gcode.py strips N and checksum unread, and carries lines out one after another; a
    # pseudo-terminal loses nothing, so what it took was carried out, unless Klipper started anew:
    # it is at zero, then, and refuses to move until it is homed. No line is sent again. Its
    # look-ahead is seconds long (toolhead.py, BUFFER_TIME_HIGH 2 s): 1000 of the shortest moves.
    # M84 takes no S there: it lets go at once. After [idle_timeout], 600 s, a move is refused
    # until all axes are homed. It moves no axis that it does not take for homed, and G92 does not
    # make it so. It reads 4096 bytes at a time and keeps a line's beginning until its end comes
    # (gcode.py, _process_data).
    "klipper": LinkDialect(
        "klipper",
        numbered=False,
        verifies=False,
        max_line_bytes=inf,
        rx_bytes=4095,
        buffered_lines=1000,
        motors_off_s=600.0,
        question=b"M114",
        set_z="SET_KINEMATIC_POSITION Z={z}",
        touches_by_macro=True,
    ),
    # RepRapFirmware 3.6 drops a line with a bad checksum silently and executes a repeated
    # number again (StringParser::LineFinished): a line without an answer cannot be sent twice,
    # nor does an answer to a later question tell whether it was dropped.
    # An idle motor keeps 30 % of its current (M906 I30) and its place.
    "reprap": LinkDialect("reprap", True, False, 255, 255, motors_off_s=inf),
}
