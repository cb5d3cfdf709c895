"""Refuses programs that nobody has checked, and those that a printer cannot carry out."""

from __future__ import annotations

import re
from collections.abc import Callable

from gcode.errors import LocalProtocolError, PrinterError
from gcode.hosts.port import Capabilities, PrintableProgram

_ARC = re.compile(r"^[ \t]*[Gg]0*[23](?![\d.])", re.MULTILINE)


def require_arcs(checked: PrintableProgram, ask: Callable[[], Capabilities]) -> None:
    """Refuse a program with arcs where the firmware says that it has none.

    Marlin built without ARC_SUPPORT, and Klipper without [gcode_arcs], answer "unknown command"
    and go on from the arc's beginning.

    Parameters
    ----------
    ask
        For what the printer can; asked only where the program has an arc.

    Raises
    ------
    PrinterError
        With the first arc's line.
    """
    text = checked.program.text
    arc = _ARC.search(text)
    if arc is None or ask().caps.get("ARCS", True):
        return
    line = text.count("\n", 0, arc.start()) + 1
    raise PrinterError(
        f"The program has arcs (G2, G3; the first in line {line}) and the printer's firmware knows "
        f"none; slice without arc fitting, or build them in (Marlin: ARC_SUPPORT; Klipper: "
        f"[gcode_arcs])."
    )


def require_checked(checked: object) -> None:
    """Refuse anything but a `CheckedProgram`.

    Raises
    ------
    LocalProtocolError
        Naming what was given instead.
    """
    from gcode.check import CheckedProgram

    if not isinstance(checked, CheckedProgram):
        raise LocalProtocolError(
            f"A printer takes a CheckedProgram, not a {type(checked).__name__}; run "
            f"gcode.check.check() on it first."
        )
