"""How firmwares read moves: one table, for all that write or read programs.

The writer puts M82 or M83 after G90 and G91 in every dialect, since in Marlin these set the
extruder's mode too. What the link must know of a firmware is in `protocol.dialects`; the checker,
which must not share a mistake with the writer, has a table of its own in `check.words`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from gcode.errors import InputError

WORD = re.compile(r"([A-Z])\s*([-+]?(?:\d+\.?\d*|\.\d+))")
"""A letter and its number."""
_AS_VOLUME = ("; use_volumetric_e = 1", ";FLAVOR:Marlin(Volumetric)", ";FLAVOR:UltiGCode")
"""How slicers say that E is cubic millimetres: PrusaSlicer and its kin, Cura."""
AS_LENGTH = "millimetres of filament: have the slicer write E as a length (no 'volumetric E')"
_CODE = re.compile(r"([GMTP])\s*0*(\d+)(?:\.(\d+))?(?![\d._]|[A-Z][A-Z_])")


@dataclass(frozen=True, slots=True)
class Dialect:
    """The words of a firmware.

    Attributes
    ----------
    acceleration
        Command for the acceleration of printing moves, `{a}` in mm/s².
    g90_sets_e
        G90 and G91 set the extruder's mode too.
    g91_moves_e
        G91 makes E relative while it lasts, whatever M82 says.
    reads
        Other dialects whose jobs it understands.
    mesh_again
        Command for a mesh of the bed that homing switches off; empty where it stays on.
    tool_zeroes_e
        Another head's E begins at 0.
    names_heaters
        Heads and heaters are told by names, too.
    head_off
        Line that switches the heater of head `{k}` off, whichever is chosen.
    head_heats
        Lines that heat head `{k}`, which is not chosen, to `{c}`, °C, and that wait for it.
    wait_to_cool
        Lines that wait until the hotend, which is off, is as cold as `{c}`, °C; `{sensor}` is its
        heater's name.
    """

    name: str
    acceleration: str
    g90_sets_e: bool = False
    g91_moves_e: bool = False
    reads: frozenset[str] = frozenset()
    mesh_again: str = ""
    tool_zeroes_e: bool = False
    names_heaters: bool = False
    head_off: str = "M104 T{k} S0"
    head_heats: tuple[str, ...] = ("M104 T{k} S{c}", "M109 T{k} S{c}")
    wait_to_cool: tuple[str, ...] = ("M109 R{c}", "M104 S0")


DIALECTS: dict[str, Dialect] = {
    # Marlin M204 P: printing acceleration (marlinfw.org/docs/gcode/M204.html); its G28 switches the
    # mesh off (G28.md).
    "marlin": Dialect(
        "marlin",
        "M204 P{a}",
        g90_sets_e=True,
        reads=frozenset({"prusa"}),
        mesh_again="M420 S1",
    ),
    # Prusa-Firmware keeps M204 P from Marlin 1.1; it is a Marlin
    "prusa": Dialect("prusa", "M204 P{a}", reads=frozenset({"marlin"})),
    # Klipper knows M204 S alone (klipper3d.org/G-Codes.html); for G91 see its gcode_move.py.
    # Slicers that know no Klipper write Marlin's words for it.
    "klipper": Dialect(
        "klipper",
        "M204 S{a}",
        g91_moves_e=True,
        reads=frozenset({"marlin"}),
        names_heaters=True,
        tool_zeroes_e=True,  # klippy/extras/gcode_move.py, _handle_activate_extruder
        wait_to_cool=("TEMPERATURE_WAIT SENSOR={sensor} MAXIMUM={c}",),
    ),
    # Its heads that wait have a temperature of their own (docs.duet3d.com, G10 and M568), which
    # M104 sets too (GCodes2.cpp, case 104); M109 takes a head where none is taken.
    "reprap": Dialect(
        "reprap",
        "M204 P{a}",
        head_off="G10 P{k} S0 R0",
        head_heats=("M104 T{k} S{c}", "M116 P{k}"),
    ),
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


def command_of(line: str) -> tuple[str, str]:
    """Name of a line's command and what follows it, in capitals; both empty where there is none.

    Firmwares need no space after a code, and pass over zeros before its number. A command by name
    ends at a space.

    Examples
    --------
    >>> command_of("g01X5F600 ; away"), command_of("START_PRINT bed=60")
    (('G1', 'X5F600'), ('START_PRINT', 'BED=60'))
    """
    command = line.partition(";")[0].strip().upper()
    code = _CODE.match(command)
    if code is None:
        name, rest = (*command.split(maxsplit=1), "", "")[:2]
        return name, rest
    letter, number_, after = code.groups()
    return f"{letter}{number_}{f'.{after}' if after else ''}", command[code.end() :].lstrip()


def heaters_off(dialect: str, heads: int) -> list[str]:
    """Lines that switch off the heaters of so many heads, and of the bed, and the fan."""
    others = [dialect_of(dialect).head_off.format(k=k) for k in range(heads) if heads > 1]
    return ["M104 S0", *others, "M140 S0", "M107"]


def fan_command(ratio: float) -> str:
    """The line that sets the part's fan, 0 to 1."""
    return f"M106 S{round(255 * ratio)}" if ratio > 0 else "M107"


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


def volume_line(text: str) -> int | None:
    """The line, counted from 1, at which a slicer says that a job's E is cubic millimetres."""
    for said in _AS_VOLUME:
        at = text.find(said)
        end = at + len(said)
        if at >= 0 and text[max(at - 1, 0) : at] in {"", "\n"} and text[end : end + 1] in "\r\n":
            return text.count("\n", 0, at) + 1
    return None
