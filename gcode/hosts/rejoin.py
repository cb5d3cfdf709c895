"""Goes on where a killed sender left a print server, which has printed on by itself meanwhile.

Every part of a job is a file of its own there, named by program and lines; it stays until the next
part begins. So the server knows what became of the last one: never begun, under way (it is
followed to its end), done, failed. Nothing is sent twice; what does not add up is refused.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from gcode.hosts.journal import passed_s
from gcode.hosts.modes import Modes, modes_after
from gcode.hosts.port import PrintableProgram, PrintReport, ResumeRefusedError
from gcode.hosts.resume import MOTORS_HELD_S, SAME_PLACE_MM, for_how_long
from gcode.hosts.server import ServerPrinter
from gcode.progress import Progress, silent


def rejoin(
    printer: ServerPrinter[Any],
    checked: PrintableProgram,
    lines: range,
    *,
    done: bool,
    before: Sequence[tuple[PrintableProgram, int, int]],
    release_c: float,
    pose_confirmed: bool = False,
    progress: Progress = silent,
    wall_clock: Callable[[], float] = time.time,
) -> PrintReport | None:
    """Connect, and have what was printed last finish.

    Parameters
    ----------
    printer
        Not connected.
    lines
        Of the program, as they were given to `print`.
    done
        Whether that print is known to have ended.
    before
        What was printed before, as (program, first, end).
    release_c
        Below this bed temperature the material lets go of the bed.
    pose_confirmed
        A rescan has shown since that the part stands where it stood.

    Returns
    -------
    The report of a print that was under way or had ended unnoticed; None where it was never begun,
    or was known to have ended.

    Raises
    ------
    ResumeRefusedError
        If it failed or was cancelled, or the machine is not as the print left it.
    PortBusyError
        If something else is being printed there.
    """
    report, ended_s = printer.rejoin(checked, lines, progress=progress)

    def refused(why: str) -> ResumeRefusedError:
        return ResumeRefusedError(
            f"The job on {printer.address.name} cannot be gone on with: {why}. 'gcode resume-at' "
            "makes a job from a layer on.",
            lines.start - 1,
            lines.stop - 1,
        )

    if report is not None and not report.ok:
        raise refused("its last part failed, or was cancelled there")
    modes = Modes()
    over = [(checked, lines.start, lines.stop)] if done or report is not None else []
    for program, first, end in (*before, *over):
        dialect = program.program.dialect
        modes = modes_after(program, end, dialect, first=first, modes=modes)
    idle_s = 0.0 if ended_s is None else passed_s(ended_s, wall_clock())
    require_as_left(
        printer, modes, refused, dialect=checked.program.dialect, release_c=release_c,
        pose_confirmed=pose_confirmed, idle_s=idle_s,
    )  # fmt: skip
    return None if done else report


def require_as_left(
    printer: ServerPrinter[Any],
    modes: Modes,
    refused: Callable[[str], ResumeRefusedError],
    *,
    dialect: str,
    release_c: float,
    pose_confirmed: bool,
    idle_s: float = 0.0,
) -> None:
    """Refuse a machine that is not as it was left; heat again what was switched off since.

    Parameters
    ----------
    modes
        As it was left; places that are not known there are not compared.
    refused
        Makes the error of a reason.
    dialect
        In whose words heads are heated.
    idle_s
        How long it has rested.
    """
    place = dict(zip("XYZ", printer.position_mm(), strict=True))
    known = {axis: modes.position_mm[axis] for axis in "XYZ" if axis in modes.position_mm}
    if any(abs(place[axis] - known[axis]) > SAME_PLACE_MM for axis in known):
        where = [" ".join(f"{a}{v:g}" for a, v in spot.items()) for spot in (place, known)]
        raise refused(f"the nozzle is at {where[0]}, and was left at {where[1]}")
    if not printer.motors_held():
        raise refused("its motors were let go, and nothing tells where the nozzle is")
    if not pose_confirmed:
        hint = "confirm by a rescan where the part stands, and say --pose-confirmed"
        if idle_s > MOTORS_HELD_S:
            raise refused(
                f"it has rested {for_how_long(idle_s)} and may have let go of its motors; {hint}"
            )
        bed_c = printer.temperatures().bed_c
        if modes.bed_c > release_c and bed_c is not None and bed_c < release_c:
            raise refused(
                f"the bed is at {bed_c:.1f} °C, below the {release_c:g} °C at which this material "
                f"lets go; {hint}"
            )
    _heat(printer, modes, dialect)


def _heat(printer: ServerPrinter[Any], modes: Modes, dialect: str) -> None:
    """Heat again what was switched off since."""
    now = printer.temperatures()
    if modes.bed_c > 0 and now.bed_target_c != modes.bed_c:
        printer.command(f"M190 S{modes.bed_c:g}")
    told_c = modes.targets_c(len(now.hotend_targets_c))
    if any(c > 0 and c != is_c for c, is_c in zip(told_c, now.hotend_targets_c, strict=True)):
        for line in modes.heating(len(told_c), dialect):
            printer.command(line)
