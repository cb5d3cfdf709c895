"""Has a printer find its Z anew by touches that are planned and checked (`resumption.touch`).

Z is told to the firmware by G92 and never homed: what it counts as Z is shifted until the flat that
was felt has the height that the job gave it.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable
from dataclasses import dataclass

from gcode.check import CheckedProgram
from gcode.check.touches import TOUCH_COMMANDS, touch_lines
from gcode.dialects import number
from gcode.errors import LinkError, LocalProtocolError, PrinterError
from gcode.hosts.port import NothingMetError, TellsTouches
from gcode.hosts.serial import SerialPrinter
from gcode.progress import Progress, silent
from gcode.resumption.touch import Touching

_TOUCHED = re.compile(r"(?://\s*)?amrepair: touched at z=(-?\d+\.\d+)")
"""What the macro AMREPAIR_TOUCH says; Klipper's own answers differ by its version."""
_TOUCHED_NOTHING = re.compile(r"(?://\s*)?amrepair: nothing was touched")
"""What it says once it has put Z right after that."""
HEARD_S = 0.1
"""By then Klipper has carried out what was due when a touch had failed."""
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
    """Have the firmware take its Z for this, where the nozzle is now; nothing moves.

    Klipper moves no axis that it does not take for homed, and G92 does not make it so.
    """
    z = number(z_mm, 3)
    klipper = printer.dialect.name == "klipper"
    printer.command(f"SET_KINEMATIC_POSITION Z={z}" if klipper else f"G92 Z{z}")


def felt(
    printer: SerialPrinter | TellsTouches,
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
            if isinstance(printer, SerialPrinter):
                met_mm = _met_mm(printer, checked, range(first, index + 1), progress)
            else:
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
    printer.print(checked, lines=range(first, len(lines) - 1), progress=progress)
    printer.finish_moves()
    return felt_mm


def _how_deep(line: str) -> str:
    """Where a touch was to end: Klipper's macro is told how far, G38.2 where to."""
    word = line.split()[1]
    if word.startswith("DEPTH="):
        return f"within {word.removeprefix('DEPTH=')} mm"
    return f"down to {word} mm"


def _met_mm(
    printer: SerialPrinter, checked: CheckedProgram, lines: range, progress: Progress
) -> float:
    """Carry out lines, the last of them a touch; where that ended."""
    command = TOUCH_COMMANDS[checked.program.dialect]
    printer.said.clear()
    try:
        report = printer.print(checked, lines=lines, progress=progress)
    except PrinterError as error:
        _forget_z(printer, command)
        raise NothingMetError(f"{error}") from error
    if not report.ok:
        raise PrinterError(
            "The touches were stopped; the nozzle was lifted and the heaters are off."
        )
    if any(command in text for text in report.warnings):
        printer.make_safe()
        how = (
            "write its macro by 'gcode touch --klipper-macro FILE' and include it in printer.cfg"
            if command == TOUCH_COMMANDS["klipper"]
            else "build it with G38_PROBE_TARGET, or set Z by hand, with paper below the nozzle"
        )
        raise PrinterError(
            f"The printer's firmware does not know {command}, so nothing was touched; the nozzle "
            f"was lifted and the heaters are off: {how}."
        )
    if command != TOUCH_COMMANDS["klipper"]:
        return printer.place().z_mm
    said = [match for text in printer.said if (match := _TOUCHED.fullmatch(text.strip()))]
    if not said:
        printer.make_safe()
        raise PrinterError(
            "The printer does not say where the touch ended; is its macro AMREPAIR_TOUCH of this "
            "version? The nozzle was lifted and the heaters are off."
        )
    return float(said[-1].group(1))


def _forget_z(printer: SerialPrinter, command: str) -> None:
    """Klipper's Z may still be the one that the macro lowered: then it must be homed to move."""
    if command != TOUCH_COMMANDS["klipper"]:
        return
    with contextlib.suppress(LinkError, LocalProtocolError):
        printer.command(f"G4 P{1000 * HEARD_S:.0f}")
        printer.command("M400")
        if not any(_TOUCHED_NOTHING.fullmatch(text.strip()) for text in printer.said):
            printer.command("SET_KINEMATIC_POSITION CLEAR_HOMED=Z")
