"""Where a killed run left its printer: the tape, the link's journal and the printer must agree.

The tape says what was sent last; the journal of the port, which program the wire last carried;
the printer, which of its lines came last (`gcode.hosts.resume`). What was begun is finished from
that line on; whatever does not add up is refused, heaters off, and nothing is printed twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from amrepair.errors import InputError, LoopError
from amrepair.loop.tape import Sent
from gcode.hosts.port import Printer, PrintReport
from gcode.hosts.resume import resume
from gcode.hosts.serial import SerialPrinter


def pick_up_serial(
    printer: Printer, *, release_c: float, pose_confirmed: bool = False
) -> Callable[[Sequence[Sent]], PrintReport | None]:
    """What `run_loop` calls before the first thing that its tape lacks.

    Parameters
    ----------
    printer
        With a journal, not connected.
    release_c, pose_confirmed
        As `gcode.hosts.resume.resume` has them.

    Raises
    ------
    InputError
        If the printer keeps no journal here: it is a server, or a file.
    """
    if not isinstance(printer, SerialPrinter) or printer.journal is None:
        raise InputError(
            "only a run on a serial port can be gone on with: a server prints on by itself, and a "
            "file has nowhere to stop; begin the run anew"
        )
    serial, journal = printer, printer.journal

    def pick_up(sent: Sequence[Sent]) -> PrintReport | None:
        if not sent:
            serial.connect()
            return None
        latest = journal.latest()
        # what was begun last may be on the tape and not on the wire: then the one before ended
        candidates = [len(sent) - 1] if sent[-1].done else [len(sent) - 1, len(sent) - 2]
        for k in candidates:
            one = sent[k] if k >= 0 else None
            if latest is None or one is None or one.checked.program.sha256 != latest.program_sha256:
                continue
            report = resume(
                serial,
                one.checked,
                release_c=release_c,
                pose_confirmed=pose_confirmed,
                end=one.end,
                before=[(s.checked, s.first, s.end) for s in _before(sent, k)],
            )
            return report if k == len(sent) - 1 and not one.done else None
        if latest is None and len(sent) == 1:
            serial.connect()  # killed before the first line
            return None
        was = "nothing" if latest is None else f"program {latest.program_sha256[:12]}"
        raise LoopError(
            f"the journal of {serial.port} last printed {was}, the run's record ends with "
            f"'{sent[-1].kind}' ({sent[-1].checked.program.sha256[:12]}): somebody has printed "
            "on this port since, or it is another port; the run cannot be gone on with"
        )

    return pick_up


def _before(sent: Sequence[Sent], k: int) -> Sequence[Sent]:
    """What was sent before the k-th; of the job itself, its earlier lines are its own program's."""
    one = sent[k]
    if one.kind != "job":
        return sent[:k]
    # lines [0, first) of the job come with it: what matters besides is already in them
    return ()
