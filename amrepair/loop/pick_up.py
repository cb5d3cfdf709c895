"""Where a killed run left its printer: the tape, the link's journal and the printer must agree.

The tape says what was sent last; the journal of the port, which program the wire last carried;
the printer, which of its lines came last (`gcode.hosts.resume`). What was begun is finished from
that line on; touches, which lay nothing, are begun anew. A print server has printed on by itself,
and knows what became of its last file (`gcode.hosts.rejoin`). Whatever does not add up is refused,
and nothing is printed twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from amrepair.errors import InputError, LoopError
from amrepair.loop.tape import TOUCH, Sent
from gcode.hosts.file import FilePrinter
from gcode.hosts.port import Printer, PrintReport
from gcode.hosts.resume import back_to_start, resume
from gcode.hosts.serial import SerialPrinter


def pick_up(
    printer: Printer, *, release_c: float, pose_confirmed: bool = False
) -> Callable[[Sequence[Sent]], PrintReport | None]:
    """What `run_loop` calls before the first thing that its tape lacks, whatever the printer.

    Parameters
    ----------
    printer
        Not connected.
    release_c, pose_confirmed
        As `gcode.hosts.resume.resume` has them.

    Raises
    ------
    InputError
        If it is a file.
    """
    if isinstance(printer, (SerialPrinter, FilePrinter)):
        return pick_up_serial(printer, release_c=release_c, pose_confirmed=pose_confirmed)
    # loaded here: a printer on a cable needs none of the web's libraries
    from gcode.hosts.rejoin import rejoin
    from gcode.hosts.served_job import ServedJob
    from gcode.hosts.server import ServerPrinter

    if isinstance(printer, ServedJob):
        job: ServedJob[Any] = printer

        def find_job(sent: Sequence[Sent]) -> None:
            job.pick_up(
                [(s.checked, s.first, s.end, s.done) for s in sent],
                release_c=release_c,
                pose_confirmed=pose_confirmed,
            )

        return find_job
    if not isinstance(printer, ServerPrinter):
        raise InputError(f"a run on a {type(printer).__name__} cannot be gone on with")
    server: ServerPrinter[Any] = printer

    def find(sent: Sequence[Sent]) -> PrintReport | None:
        if not sent:
            server.connect()
            return None
        one = sent[-1]
        return rejoin(
            server,
            one.checked,
            range(one.first, one.end),
            done=one.done,
            before=[(s.checked, s.first, s.end) for s in _earlier(sent)],
            release_c=release_c,
            pose_confirmed=pose_confirmed,
        )

    return find


def _earlier(sent: Sequence[Sent]) -> Sequence[Sent]:
    """What tells the machine's state before the last thing sent."""
    one = sent[-1]
    if one.kind == "job" and one.first > 0:
        return (replace(one, first=0, end=one.first),)
    return _before(sent, len(sent) - 1)


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
        If the printer keeps no journal here: it is a file.
    """
    if not isinstance(printer, SerialPrinter) or printer.journal is None:
        raise InputError(
            "a run into a file cannot be gone on with: it has nowhere to stop; begin the run anew"
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
            before = [(s.checked, s.first, s.end) for s in _before(sent, k)]
            if one.kind == TOUCH and not one.done:
                back_to_start(
                    serial, one.checked, release_c=release_c, pose_confirmed=pose_confirmed,
                    before=before,
                )  # fmt: skip
                return None
            report = resume(
                serial,
                one.checked,
                release_c=release_c,
                pose_confirmed=pose_confirmed,
                end=one.end,
                before=before,
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
