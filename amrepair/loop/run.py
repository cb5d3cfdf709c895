"""The closed loop over a job's layers: print, stop, scan, decide, repair, scan again, go on.

It knows ports only: any `Printer`, any `Scanner`. At a stop the nozzle is retracted, lifted and
parked; what is printed there starts and ends parked; then everything is restored and the job goes
on with its next line. Nothing is sent that the checker has not passed, and nothing that is not on
the tape first. A run that was killed is this same function over its tape.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from amrepair.loop.engine import Run
from amrepair.loop.looks import LoopReport, Stop
from amrepair.loop.options import LOOP, UNASKED, Approval, LoopOptions, Records
from amrepair.loop.pace import Stops, had_trouble
from amrepair.loop.safe_exit import leave_safe
from amrepair.loop.tape import TapeEndsError
from amrepair.repair import Site
from amrepair.scans import Scanner
from gcode.check import CheckedProgram
from gcode.hosts.port import Printer
from gcode.process import gives_back
from gcode.progress import Progress, silent
from gcode.reader import Job


@gives_back
def run_loop(
    job: Job,
    checked: CheckedProgram,
    printer: Printer,
    scanner: Scanner,
    site_at: Callable[[Stop], Site],
    *,
    stops: Sequence[Stop],
    options: LoopOptions = LOOP,
    approval: Approval = UNASKED,
    records: Records | None = None,
    progress: Progress = silent,
) -> LoopReport:
    """Print a job, repairing it at its stops.

    Parameters
    ----------
    job, checked
        The job as read, and the proof that it passed the checker.
    printer
        Connected, unless `pick_up` does that. Whatever goes wrong, its heaters are told to switch
        off before this returns.
    site_at
        What is expected at a stop, and where it stands (`build_from_template` is required).
    records
        What is kept; None keeps nothing.

    Raises
    ------
    AmrepairError, GcodeError
        Whatever stopped the run; heaters are told to switch off first.

    Examples
    --------
    A printer that is a file, and a scanner that always reads one: what would be sent lies in
    `sent.gcode`.

    >>> from pathlib import Path
    >>> import gcode
    >>> from amrepair import Site, Transform, open_template, read_scan, run_loop
    >>> from amrepair.loop import locate_part, plan_stops
    >>> class Reader:
    ...     build_from_scanner = Transform.identity("build", "scanner")
    ...     def scan(self, request):
    ...         return read_scan(Path("scan.ply"), frame="scanner")
    >>> setup, template = gcode.load_setup(), open_template(Path("part.safetensors"))
    >>> job = gcode.read_job(Path("job.gcode").read_text(), dialect="prusa")
    >>> placed = locate_part(job, template, layer_height_mm=0.2)
    >>> printer = gcode.connect("file:sent.gcode", dialect="prusa")
    >>> printer.connect()
    >>> report = run_loop(
    ...     job,
    ...     gcode.check_program(job.program, setup),
    ...     printer,
    ...     Reader(),
    ...     lambda stop: Site.of_part(template, setup, build_from_template=placed),
    ...     stops=plan_stops(job, []),
    ... )
    >>> printer.close()
    >>> [look.printed for look in report.looks]  # the scan did not change: nothing rose
    [True, False, False]
    >>> [str(look.decision.action) for look in report.looks]
    ['fill now', 'look again', 'pause and ask']
    >>> report.stopped[:54]  # nobody is there to be asked
    'pause and ask: nothing rose where the last repair was '
    """
    run = Run(
        job, checked, printer, scanner, site_at, stops=stops,
        options=options, approval=approval, records=records or Records(), progress=progress,
    )  # fmt: skip
    try:
        ahead = Stops(job, stops, options.pace)
        while (stop := ahead.next()) is not None:
            run.print_job(stop.line, coming=stop)
            if not run.at(stop):
                break
            ahead.seen(stop, trouble=had_trouble(run.report().at_stop(stop)))
        else:
            run.print_job(checked.program.line_count)
        run.end()
    except TapeEndsError:
        pass
    except BaseException:
        leave_safe(printer)
        raise
    run.settle()
    return run.report()
