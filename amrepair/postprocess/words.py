"""The words of a mark, by who is to read it, and who that is by a job's own settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

from amrepair.errors import InputError
from amrepair.loop.marked_stops import LOOK_MARK
from gcode.profiles.own_settings import own_settings

Target = Literal["klipper", "prusa", "marlin", "reprap", "octoprint"]
TARGETS: tuple[Target, ...] = get_args(Target)
# Klipper: the macro of our cfg file. Prusa: pause and park (M601). Marlin: M0 waits for a click or
# M108; M125 and M600 park, too, where they were built in. RepRapFirmware: M226, a pause that comes
# from the file. OctoPrint takes lines with @ for itself and sends nothing.
PAUSE_COMMANDS: Mapping[Target, tuple[str, ...]] = {
    "klipper": ("AMREPAIR_SCAN LAYER={layer} Z={z}",),
    "prusa": ("M601",),
    "marlin": ("M400", "M0"),
    "reprap": ("M226",),
    "octoprint": ("@amrepair scan layer={layer} z={z}",),
}
BYTE_ORDER_MARK = "\ufeff"  # before a file's first line, where an editor on Windows saved it
_FIELDS = ("layer", "z")
_FLAVOURS: Mapping[str, Target] = {
    "klipper": "klipper",
    "reprapfirmware": "reprap",
    "marlin": "marlin",
    "marlin2": "marlin",
    "prusa": "prusa",
    "reprap": "marlin",
}


def target_of(text: str, name: str, environment: Mapping[str, str]) -> Target:
    """Who reads a job's marks: its host where the slicer tells one, else its firmware.

    Parameters
    ----------
    environment
        As a slicer sets it for its scripts: SLIC3R_ and a setting's name in capitals.

    Raises
    ------
    InputError
        If neither environment nor job tells.
    """
    if environment.get("SLIC3R_PP_HOST", "").lower() == "octoprint":
        return "octoprint"
    own = own_settings(text.removeprefix(BYTE_ORDER_MARK), name)
    flavour = environment.get("SLIC3R_GCODE_FLAVOR", "").strip().lower()
    if own is not None and own.machine is not None and own.machine.startswith("prusa_"):
        return "prusa"
    if own is not None and not flavour:
        flavour = own.setup().printer.dialect
    if flavour in _FLAVOURS:
        return _FLAVOURS[flavour]
    raise InputError(
        f"{name}: neither the slicer's environment nor the job tells which firmware it is for; "
        f"say it by --for ({', '.join(TARGETS)})"
    )


def lines_of(
    target: Target, layer: int, z_mm: float, command: str | None = None
) -> tuple[str, ...]:
    """What is put into the job for one look.

    Parameters
    ----------
    command
        Instead of the target's own: may name {layer} and {z}; lines parted by a backslash and n.

    Raises
    ------
    InputError
        If it names anything else.
    """
    words = tuple(command.split("\\n")) if command is not None else PAUSE_COMMANDS[target]
    try:
        filled = tuple(line.format(layer=layer, z=f"{z_mm:.3f}") for line in words)
    except (KeyError, IndexError, ValueError) as error:
        raise InputError(
            f"--command is {command!r}; it may name {{{'}, {'.join(_FIELDS)}}} and nothing else"
        ) from error
    return (f"{LOOK_MARK} LAYER={layer} Z={z_mm:.3f}", *filled)
