"""Has a printer find its Z anew by touches that are planned and checked (`resumption.touch`).

Z is told to the firmware by G92 and never homed: what it counts as Z is shifted until the flat that
was felt has the height that the job gave it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from gcode.check import CheckedProgram
from gcode.check.touches import touch_lines
from gcode.dialects import number
from gcode.errors import PrinterError
from gcode.hosts.port import NothingMetError, TellsTouches
from gcode.hosts.serial import TOUCHES_STOPPED, SerialPrinter
from gcode.progress import Progress, silent
from gcode.resumption.touch import Touching

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
    now, cold_c = printer.temperatures(), plan.probe.cold_c
    if now.hotend_target_c > 0 or now.hotend_c > cold_c:
        raise PrinterError(
            f"The nozzle is at {now.hotend_c:.0f} °C (target {now.hotend_target_c:.0f}) and would "
            f"melt in or leave a drop; switch it off and touch below {cold_c:.0f} °C."
        )
    top_mm, options = plan.layer.z_mm, plan.options
    printer.command("G21")
    printer.command("G90")
    tell_z(printer, top_mm + above_mm)

    first_mm = felt(
        printer, plan.coarse, at_contact=lambda: tell_z(printer, top_mm), progress=progress
    )
    felt_mm = felt(printer, plan.fine, progress=progress)
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
    tell_z(printer, here_mm + shift_mm)
    variance_mm2 = plan.probe.sigma_mm**2 + REPORTED_MM**2 / 12 + apart_mm**2 / 2
    return Touched(
        first_shift_mm=top_mm - first_mm[0],
        shift_mm=shift_mm,
        apart_mm=apart_mm,
        uncertainty_mm=options.coverage * math.sqrt(variance_mm2 / len(felt_mm)),
    )


def tell_z(printer: SerialPrinter, z_mm: float) -> None:
    """Have the firmware take its Z for this, where the nozzle is now; nothing moves."""
    printer.command(printer.dialect.set_z.format(z=number(z_mm, 3)))


def felt(
    printer: TellsTouches,
    checked: CheckedProgram,
    *,
    at_contact: Callable[[], None] = lambda: None,
    progress: Progress = silent,
) -> list[float]:
    """Carry out the touches of a program; where the nozzle met something, in the firmware's Z.

    Parameters
    ----------
    at_contact
        Called while the nozzle rests on what it met.

    Raises
    ------
    PrinterError
        If nothing is felt down to where a touch was to end, or the firmware does not know touches;
        heaters are off then, and the nozzle is lifted.
    """
    lines = checked.program.text.split("\n")
    felt_mm: list[float] = []
    first = 0
    for index in touch_lines(checked.program):
        try:
            met_mm = printer.touch(checked, range(first, index + 1), progress=progress)
        except NothingMetError as error:
            raise PrinterError(
                f"Nothing was felt {_how_deep(lines[index])}, where the touch was to end "
                f"({f'{error}'.rstrip('.')}); the nozzle was lifted and the heaters are off: the "
                "probe does not trigger, or what it was to feel is farther below."
            ) from error
        felt_mm.append(met_mm)
        at_contact()
        first = index + 1
    # not to its very end: that is for whoever sends the last of a job, and lets go of the motors
    report = printer.print(checked, lines=range(first, len(lines) - 1), progress=progress)
    if not report.ok:
        raise PrinterError(TOUCHES_STOPPED)
    printer.finish_moves()
    return felt_mm


def _how_deep(line: str) -> str:
    """Where a touch was to end: Klipper's macro is told how far, G38.2 where to."""
    word = line.split()[1]
    if word.startswith("DEPTH="):
        return f"within {word.removeprefix('DEPTH=')} mm"
    return f"down to {word} mm"
