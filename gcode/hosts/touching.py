"""Has a printer find its Z anew by touches that are planned and checked (`resumption.touch`).

Z is told to the firmware by G92 and never homed: what it counts as Z is shifted until the flat that
was felt has the height that the job gave it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from gcode.check import CheckedProgram
from gcode.dialects import number
from gcode.errors import PrinterError
from gcode.hosts.serial import SerialPrinter
from gcode.progress import Progress, silent
from gcode.resumption.touch import Touching

COLD_C = 60.0
"""PLA, the softest of the materials, begins to give way there."""
REPORTED_MM = 0.01
"""Marlin tells a position in two digits."""


@dataclass(frozen=True, slots=True)
class Touched:
    """Z as it was found.

    Attributes
    ----------
    first_shift_mm, shift_mm
        What the first touch, and then all others, found Z to be wrong by.
    apart_mm
        By how much the two touches differ.
    uncertainty_mm
        Of Z, as many standard deviations as the options say.
    """

    first_shift_mm: float
    shift_mm: float
    apart_mm: float
    uncertainty_mm: float


def touch_z(
    printer: SerialPrinter, plan: Touching, above_mm: float, *, progress: Progress = silent
) -> Touched:
    """Find Z; the nozzle stands above the part afterwards, and the motors are held.

    Parameters
    ----------
    printer
        Connected.
    above_mm
        How high the nozzle stands above the part's top, by eye.

    Raises
    ------
    PrinterError
        If the nozzle is warm, nothing is felt, or the touches do not agree.
    """
    now = printer.temperatures()
    if now.hotend_target_c > 0 or now.hotend_c > COLD_C:
        raise PrinterError(
            f"The nozzle is at {now.hotend_c:.0f} °C (target {now.hotend_target_c:.0f}) and would "
            f"melt in or leave a drop; switch it off and touch below {COLD_C:.0f} °C."
        )
    top_mm, options = plan.layer.z_mm, plan.options
    printer.command("G21")
    printer.command("G90")
    printer.command(f"G92 Z{number(top_mm + above_mm, 3)}")

    def take_for_top() -> None:
        printer.command(f"G92 Z{number(top_mm, 3)}")

    first_mm = _felt(printer, plan.coarse, take_for_top, progress)
    felt_mm = _felt(printer, plan.fine, lambda: None, progress)
    mean_mm = sum(felt_mm) / len(felt_mm)
    apart_mm = max(felt_mm) - min(felt_mm)
    if apart_mm > options.agree_mm:
        raise PrinterError(
            f"The two touches differ by {apart_mm:.3f} mm, {options.agree_mm:g} mm are allowed: "
            f"the part or the head gives way, or something lies there; Z is not to be trusted, "
            f"and nothing was heated."
        )
    shift_mm = top_mm - mean_mm
    here_mm = printer.position_mm()[2]
    printer.command(f"G92 Z{number(here_mm + shift_mm, 3)}")
    variance_mm2 = options.sigma_mm**2 + REPORTED_MM**2 / 12 + apart_mm**2 / 2
    return Touched(
        first_shift_mm=top_mm - first_mm[0],
        shift_mm=shift_mm,
        apart_mm=apart_mm,
        uncertainty_mm=options.coverage * math.sqrt(variance_mm2 / len(felt_mm)),
    )


def _felt(
    printer: SerialPrinter,
    checked: CheckedProgram,
    at_contact: Callable[[], None],
    progress: Progress,
) -> list[float]:
    """Carry out the touches of a program; where each was stopped, in the firmware's Z."""
    lines = checked.program.text.split("\n")
    felt_mm: list[float] = []
    first = 0
    for index, line in enumerate(lines):
        if not line.startswith("G38.2 "):
            continue
        try:
            printer.print(checked, lines=range(first, index + 1), progress=progress)
        except PrinterError as error:
            raise PrinterError(
                f"Nothing was felt down to {line.split()[1]} mm, where the touch was to end, or "
                f"the printer has none ({error}); the nozzle was lifted, the heaters are off, and "
                f"Z is not known: look how high the nozzle stands, and whether its probe triggers."
            ) from error
        felt_mm.append(printer.place().z_mm)
        at_contact()
        first = index + 1
    printer.print(checked, lines=range(first, len(lines)), progress=progress)
    printer.finish_moves()
    return felt_mm
