"""Refuses programs that nobody has checked."""

from __future__ import annotations

import importlib

from gcode.errors import LocalProtocolError
from gcode.hosts.port import PrintableProgram


def require_checked(checked: object) -> None:
    """Refuse anything but a `CheckedProgram`.

    Raises
    ------
    LocalProtocolError
        Naming what was given instead.
    """
    try:
        proof: type = importlib.import_module("gcode.check").CheckedProgram
    except ImportError:
        proof = PrintableProgram
    if not isinstance(checked, proof):
        raise LocalProtocolError(
            f"A printer takes a CheckedProgram, not a {type(checked).__name__}; run "
            f"gcode.check.check() on it first."
        )
