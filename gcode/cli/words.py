"""What a program will do to the machine, in one sentence, before it is sent."""

from __future__ import annotations

import re

from gcode.estimate import Estimate
from gcode.moves import Program

_HEAT = {"nozzle": re.compile(r"M10[49]\b"), "bed": re.compile(r"M1[49]0\b")}
_DEGREES = re.compile(r"\b[SR](\d+(?:\.\d+)?)")
_HOMING = re.compile(r"G28\b(.*)")


def what_it_does(program: Program, cost: Estimate | None) -> str:
    """Such as: heats the nozzle to 215 °C, homes X and Y but not Z, lays 36 mm of filament ….

    Parameters
    ----------
    cost
        The program's own estimate; None for one that lays nothing.
    """
    commands = [line.partition(";")[0].strip().upper() for line in program.text.splitlines()]
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


def _heats(commands: list[str]) -> list[str]:
    """The hottest that nozzle and bed are told to be."""
    said = []
    for name, pattern in _HEAT.items():
        degrees = [
            float(number)
            for command in commands
            if pattern.match(command)
            for number in _DEGREES.findall(command)
        ]
        if degrees and max(degrees) > 0:
            said.append(f"heats the {name} to {max(degrees):g} °C")
    return said


def _homes(commands: list[str]) -> str:
    """Which axes are sought at their switches."""
    axes: set[str] = set()
    for command in commands:
        found = _HOMING.match(command)
        if found:
            named = {axis for axis in "XYZ" if axis in found.group(1)}
            axes |= named or set("XYZ")
    if not axes:
        return "homes nothing"
    words = " and ".join(sorted(axes)) if len(axes) < 3 else "X, Y and Z"
    return f"homes {words}" + ("" if "Z" in axes else " but not Z")
