"""How moves are spelled: one table of the firmwares' words.

The order of modes matters: in Marlin G90 and G91 set the extruder's mode too, so M82 or M83 comes
after them, in every dialect. What the link must know of a firmware is in `protocol.dialects`.
"""

from __future__ import annotations

from dataclasses import dataclass

from gcode.errors import InputError


@dataclass(frozen=True, slots=True)
class Dialect:
    """The words of a firmware.

    Attributes
    ----------
    acceleration
        Command for the acceleration of printing moves, `{a}` in mm/s².
    line_limit
        Characters of a command that the firmware takes.
    """

    name: str
    acceleration: str
    line_limit: int


DIALECTS: dict[str, Dialect] = {
    # Marlin M204 P: printing acceleration (marlinfw.org/docs/gcode/M204.html); MAX_CMD_SIZE 96
    "marlin": Dialect("marlin", "M204 P{a}", 95),
    # Prusa-Firmware keeps M204 P from Marlin 1.1
    "prusa": Dialect("prusa", "M204 P{a}", 95),
    # Klipper knows M204 S alone (klipper3d.org/G-Codes.html)
    "klipper": Dialect("klipper", "M204 S{a}", 4095),
    "reprap": Dialect("reprap", "M204 P{a}", 255),
}


def dialect_of(name: str) -> Dialect:
    """The dialect of that name.

    Raises
    ------
    InputError
        If there is none.
    """
    try:
        return DIALECTS[name]
    except KeyError:
        raise InputError(
            f"There is no dialect '{name}'; there are {', '.join(DIALECTS)}."
        ) from None


def number(value: float, digits: int) -> str:
    """A number as firmwares read it: no exponent, no trailing zeros, no minus zero.

    Examples
    --------
    >>> number(10.0, 3), number(-0.00001, 3), number(1e-7, 5), number(0.125, 2)
    ('10', '0', '0', '0.12')
    """
    text = f"{value:.{digits}f}"
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return "0" if text in {"-0", ""} else text
