"""What a program will do to the machine, in one sentence, before it is sent."""

from __future__ import annotations

import re

from gcode.dialects import command_of
from gcode.estimate import Estimate
from gcode.moves import Program

# at the beginning of a line: the whole text is searched at once, a million lines in a quarter of
# a second
_HEATS_OR_HOMES = re.compile(
    r"^[ \t]*((?:M10[49]|M1[49]0|G28)(?!\d)[^;\n]*)", re.IGNORECASE | re.MULTILINE
)
_HEATERS = {"nozzle": ("M104", "M109"), "bed": ("M140", "M190")}
_DEGREES = re.compile(r"[SR]\s*(\d+(?:\.\d+)?)")


def what_it_does(program: Program, cost: Estimate | None) -> str:
    """Such as: heats the nozzle to 215 °C, homes X and Y but not Z, lays 36 mm of filament ….

    Parameters
    ----------
    cost
        The program's own estimate; None for one that lays nothing.
    """
    commands = [command_of(line) for line in _HEATS_OR_HOMES.findall(program.text)]
    said = [*_heats(commands), _homes(commands)]
    if cost is None:
        return ", ".join([*said, "lays no filament"])
    low, high = cost.bounds_mm[2], cost.bounds_mm[5]
    amount = f"{cost.filament_mm / 1000:.2f} m" if cost.filament_mm >= 1000 else (
        f"{cost.filament_mm:.0f} mm"
    )  # fmt: skip
    said.append(
        f"lays {amount} of filament at Z {low:.2f} to {high:.2f} mm in "
        f"{cost.print_time_s / 60:.1f} min and the time that heating takes"
    )
    return ", ".join(said)


def _heats(commands: list[tuple[str, str]]) -> list[str]:
    """The hottest that nozzle and bed are told to be."""
    said = []
    for heater, names in _HEATERS.items():
        degrees = [
            float(number)
            for name, rest in commands
            if name in names
            for number in _DEGREES.findall(rest)
        ]
        if degrees and max(degrees) > 0:
            said.append(f"heats the {heater} to {max(degrees):g} °C")
    return said


def _homes(commands: list[tuple[str, str]]) -> str:
    """Which axes are sought at their switches."""
    axes: set[str] = set()
    for name, rest in commands:
        if name == "G28":
            axes |= {axis for axis in "XYZ" if axis in rest} or set("XYZ")
    if not axes:
        return "homes nothing"
    words = " and ".join(sorted(axes)) if len(axes) < 3 else "X, Y and Z"
    return f"homes {words}" + ("" if "Z" in axes else " but not Z")
