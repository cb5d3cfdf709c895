"""The closed loop over a job's layers: print, stop, scan, decide, repair, scan again, go on.

It knows ports only: any `Printer`, any `Scanner`. At a stop the nozzle is retracted, lifted and
parked; what is printed there starts and ends parked; then everything is restored and the job goes
on with its next line. Nothing is sent that the checker has not passed, and nothing that is not on
the tape first. A run that was killed is this same function over its tape.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

from amrepair.loop.decide import Decision
from amrepair.loop.engine import PickUp, Run
from amrepair.loop.limits import Limits
from amrepair.loop.looks import Look, LoopReport, Stop
from amrepair.loop.pace import Pace, Stops, had_trouble
from amrepair.loop.tape import Tape, TapeEndsError
from amrepair.regions.calibration import Calibration
from amrepair.repair import RepairPlan, Site, Stopwatch
from amrepair.scans import Scan, Scanner
from gcode.check import CheckedProgram
from gcode.errors import GcodeError
from gcode.hosts.port import Printer
from gcode.process import gives_back
from gcode.progress import Progress, silent
from gcode.reader import Job

MAX_ITERATIONS = 3


@gives_back
def run_loop(
    job: Job,
    checked: CheckedProgram,
    printer: Printer,
    scanner: Scanner,
    site_at: Callable[[Stop], Site],
    *,
    stops: Sequence[Stop],
    pace: Pace | None = None,
    max_iterations: int = MAX_ITERATIONS,
    approve: Callable[[RepairPlan], bool] = lambda plan: True,
    ask: Callable[[Decision], bool] | None = None,
    limits: Limits | None = None,
    record: Callable[[Look], None] = lambda look: None,
    keep_scan: Callable[[int, Scan], None] = lambda number, scan: None,
    tape: Tape | None = None,
    pick_up: PickUp | None = None,
    silent_stops: int = 0,
    calibration: Calibration | None = None,
    seed: int = 0,
    watch: Stopwatch | None = None,
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
    pace
        Looks besides `stops`: more often after trouble, fewer while all is clean.
    approve
        Asked before every repair is sent.
    ask
        Asked where a decision is `pause and ask`: whether to go on all the same. Where nobody can
        be asked (None) the run ends there, parked, heaters off.
    limits
        What may be printed without asking; beyond them the decision is `pause and ask`.
    record
        Called with every look as soon as its outcome is known, before anything follows from it.
    keep_scan
        Called with a look's number and scan while the look is planned; done before `record`.
    tape
        What was sent, seen and decided, written ahead; what it already holds is not done again.
    pick_up
        How a killed run's printer is found again, before the first thing that the tape lacks.
    silent_stops
        So many stops in a row may be passed by where the scanner does not answer; the next such
        stop ends the run with its `ScannerError`. A scan that does not fit the part is taken once
        more, and then ends the run, parked.

    calibration
        What sound parts look like to this scanner; None: learned from the first clean layers.

    Raises
    ------
    AmrepairError, GcodeError
        Whatever stopped the run; heaters are told to switch off first.

    Examples
    --------
    A printer that is a file, and a scanner that is one: what would be sent lies in `sent.gcode`.

    >>> from pathlib import Path
    >>> import gcode
    >>> from amrepair import Site, open_template, run_loop
    >>> from amrepair.loop import locate_part, plan_stops
    >>> from amrepair.scans import FileScanner
    >>> setup, template = gcode.load_setup(), open_template(Path("part.safetensors"))
    >>> job = gcode.read_job(Path("job.gcode").read_text(), dialect="prusa")
    >>> placed = locate_part(job, template, layer_height_mm=0.2)
    >>> printer = gcode.connect("file:sent.gcode", dialect="prusa")
    >>> printer.connect()
    >>> report = run_loop(
    ...     job,
    ...     gcode.check_program(job.program, setup),
    ...     printer,
    ...     FileScanner(Path("scan.ply")),
    ...     lambda stop: Site.of_part(template, setup, build_from_template=placed),
    ...     stops=plan_stops(job, []),
    ... )
    >>> printer.close()
    >>> [look.printed for look in report.looks]  # the scan did not change: it tries once
    [True, False]
    >>> [str(look.decision.action) for look in report.looks]
    ['fill now', 'go on']
    """
    run = Run(
        job, checked, printer, scanner, site_at, stops=stops,
        max_iterations=max_iterations, approve=approve, ask=ask, limits=limits, record=record,
        keep_scan=keep_scan, tape=tape or Tape(), pick_up=pick_up, silent_stops=silent_stops,
        calibration=calibration,
        seed=seed, watch=watch or Stopwatch(), progress=progress,
    )  # fmt: skip
    try:
        ahead = Stops(job, stops, pace)
        while (stop := ahead.next()) is not None:
            run.print_job(stop.line, coming=stop)
            if not run.at(stop):
                break
            ahead.seen(stop, trouble=had_trouble(run.report().at_stop(stop)))
        else:
            run.print_job(checked.program.text.count("\n"))
        run.end()
    except TapeEndsError:
        pass
    except BaseException:
        with contextlib.suppress(GcodeError, OSError):
            printer.heaters_off()
        raise
    run.settle()
    return run.report()
