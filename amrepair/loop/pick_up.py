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
from functools import partial
from typing import TYPE_CHECKING, Any

from amrepair.errors import InputError, LoopError
from amrepair.loop.tape import TOUCH, Sent
from gcode.hosts.file import FilePrinter
from gcode.hosts.journal import Journal
from gcode.hosts.port import PrintableProgram, Printer, PrintReport
from gcode.hosts.resume import back_to_start, resume
from gcode.hosts.serial import SerialPrinter
from gcode.progress import Progress, silent

if TYPE_CHECKING:
    from gcode.hosts.served_job import ServedJob
    from gcode.hosts.server import ServerPrinter


def pick_up(
    printer: Printer, *, release_c: float, pose_confirmed: bool = False
) -> Callable[[Sequence[Sent], Progress], PrintReport | None]:
    """What `run_loop` calls before the first thing that its tape lacks, whatever the printer.

    Parameters
    ----------
    printer
        Not connected; on a cable, with a journal.
    release_c, pose_confirmed
        As `gcode.hosts.resume.resume` has them.

    Raises
    ------
    InputError
        If the printer keeps no journal here: it is a file.
    """
    if isinstance(printer, (SerialPrinter, FilePrinter)):
        if isinstance(printer, FilePrinter) or printer.journal is None:
            raise InputError(
                "a run into a file cannot be gone on with: it has nowhere to stop; begin the run "
                "anew"
            )
        find: Callable[..., PrintReport | None] = partial(_by_journal, printer, printer.journal)
    else:
        # loaded here: a printer on a cable needs none of the web's libraries
        from gcode.hosts.served_job import ServedJob
        from gcode.hosts.server import ServerPrinter

        if not isinstance(printer, ServerPrinter):
            raise InputError(f"a run on a {type(printer).__name__} cannot be gone on with")
        find = partial(_by_server, printer)
        if isinstance(printer, ServedJob):
            find = partial(_by_served_job, printer)
    return partial(find, release_c=release_c, pose_confirmed=pose_confirmed)


def _by_served_job(
    job: ServedJob[Any],
    sent: Sequence[Sent],
    _progress: Progress,
    *,
    release_c: float,
    pose_confirmed: bool,
) -> None:
    told = [(s.checked, s.first, s.end, s.done) for s in sent]
    job.pick_up(told, release_c=release_c, pose_confirmed=pose_confirmed)


def _by_server(
    server: ServerPrinter[Any],
    sent: Sequence[Sent],
    progress: Progress,
    *,
    release_c: float,
    pose_confirmed: bool,
) -> PrintReport | None:
    from gcode.hosts.rejoin import rejoin

    if not sent:
        server.connect()
        return None
    one = sent[-1]
    before = _before(sent, len(sent) - 1)
    if one.kind == "job" and one.first > 0:  # its earlier lines are not in its last file
        before = (replace(one, first=0, end=one.first),)
    return rejoin(
        server,
        one.checked,
        range(one.first, one.end),
        done=one.done,
        before=_spans(before),
        release_c=release_c,
        pose_confirmed=pose_confirmed,
        progress=progress,
    )


def _by_journal(
    serial: SerialPrinter,
    journal: Journal,
    sent: Sequence[Sent],
    progress: Progress,
    *,
    release_c: float,
    pose_confirmed: bool,
) -> PrintReport | None:
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
        before = _spans(_before(sent, k))
        if one.kind == TOUCH and not one.done:
            back_to_start(
                serial, one.checked, release_c=release_c, pose_confirmed=pose_confirmed,
                before=before,
            )  # fmt: skip
            return None
        under_way = k == len(sent) - 1 and not one.done  # else there is nothing left of it to tell
        report = resume(
            serial,
            one.checked,
            release_c=release_c,
            pose_confirmed=pose_confirmed,
            end=one.end,
            before=before,
            progress=_of_all(progress, one.end - one.first) if under_way else silent,
        )
        return report if under_way else None
    if latest is None and len(sent) == 1:
        serial.connect()  # killed before the first line
        return None
    was = "nothing" if latest is None else f"program {latest.program_sha256[:12]}"
    raise LoopError(
        f"the journal of {serial.port} last printed {was}, the run's record ends with "
        f"'{sent[-1].kind}' ({sent[-1].checked.program.sha256[:12]}): somebody has printed "
        "on this port since, or it is another port; the run cannot be gone on with"
    )


def _of_all(progress: Progress, lines: int) -> Progress:
    """What is told of the lines that are left, as of all that were to be sent."""

    def told(stage: str, done: float, total: float) -> None:
        progress(stage, lines - total + done, float(lines))

    return told


def _before(sent: Sequence[Sent], k: int) -> Sequence[Sent]:
    """What tells the machine's state before the k-th; lines of the job tell it themselves."""
    return sent[:k] if sent[k].kind != "job" else ()


def _spans(sent: Sequence[Sent]) -> list[tuple[PrintableProgram, int, int]]:
    return [(s.checked, s.first, s.end) for s in sent]
