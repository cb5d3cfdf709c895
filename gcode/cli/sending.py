"""The command `gcode send`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gcode.cli import console
from gcode.cli.judging import LeaveHeatersOption, tell_waits, tell_warnings, warnings_json
from gcode.cli.options import (
    AsBuiltOption,
    FileArgument,
    JsonOption,
    OwnMaterialOption,
    program_text,
    standing_on_bed,
)
from gcode.cli.owning import (
    JobPrinterOption,
    other_printer,
    setup_to_judge,
    told_if_for_another,
)
from gcode.errors import GcodeError, InputError, ReadError

if TYPE_CHECKING:
    from gcode.check import CheckReport
    from gcode.estimate import Estimate
    from gcode.hosts import Printer, PrintReport
    from gcode.moves import Program
    from gcode.profiles import PrinterProfile


@console.command(
    "send",
    "gcode send repair.gcode --port /dev/ttyACM0",
    "gcode send job.gcode --port /dev/ttyUSB0 --printer ender_3 --wire-log wire.log "
    "--journal job.journal",
)
def send(
    file: FileArgument,
    port: Annotated[
        str,
        typer.Option(
            help="Device path, octoprint+http://HOST:PORT, moonraker+http://HOST:PORT, file:PATH; "
            "keys by OCTOPRINT_API_KEY, MOONRAKER_API_KEY."
        ),
    ],
    printer: JobPrinterOption = None,
    material: OwnMaterialOption = None,
    as_built: AsBuiltOption = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on with the job that the journal knows, or say why not."),
    ] = False,
    pose_confirmed: Annotated[
        bool,
        typer.Option(
            "--pose-confirmed",
            help="A rescan has shown that the part still stands where it stood (with --resume).",
        ),
    ] = False,
    wire_log: Annotated[Path | None, typer.Option(help="Log of every byte, with times.")] = None,
    journal: Annotated[
        Path | None,
        typer.Option(help="Journal, written ahead of the wire; one a port where left out."),
    ] = None,
    window: Annotated[
        int,
        typer.Option(
            min=1, help="Lines under way at once; more than 1 for firmware that buffers them."
        ),
    ] = 1,
    leave_heaters: LeaveHeatersOption = False,
    as_json: JsonOption = False,
) -> None:
    """Check a program, then print it; whatever goes wrong, heaters are told to switch off.

    What is judged, and how strictly, is told by 'gcode check --help'.
    """
    from concurrent.futures import ThreadPoolExecutor

    from gcode.check import check as check_program
    from gcode.check import policy_of
    from gcode.cli.words import what_it_does
    from gcode.hosts import connect
    from gcode.hosts.journal import default_path
    from gcode.hosts.resume import resume as resume_job
    from gcode.hosts.serial import SerialPrinter
    from gcode.moves import Program

    text = program_text(file)
    chosen = setup_to_judge(text, file, printer, material)
    setup = chosen.setup
    field = None if as_built is None else standing_on_bed(as_built, setup.printer)
    program = Program(text, setup.printer.dialect)
    bars = console.Bars()
    with ThreadPoolExecutor(1) as beside, bars.shown():  # nobody waits for the estimate alone
        cost = beside.submit(_cost_of, program, setup.printer)
        with told_if_for_another(text, file, setup.printer):
            checked = check_program(
                program, setup, as_built=field, policy=policy_of(program),
                leave_heaters=leave_heaters, progress=bars,
            )  # fmt: skip
    tell_warnings(file, checked.report)
    tell_waits(file, text)
    if chosen.own is None and (other := other_printer(text, file, setup.printer)) is not None:
        console.errors.print(f"{file}: warning: {other}.")
    console.errors.print(f"{file} on {setup.printer.name}: {what_it_does(program, cost.result())}.")
    machine = connect(
        port,
        dialect=setup.printer.dialect,
        baud=setup.printer.baud,
        window=window,
        wire_log=wire_log,
        journal=journal or default_path(port),
    )
    if resume and not isinstance(machine, SerialPrinter):
        raise InputError(f"{port} cannot be resumed on; only a printer's own port can.")
    if not resume:
        with bars.shown(), bars.stage("connect"):
            machine.connect()  # a printer that refuses us is not ours to abort
    try:
        with console.interrupts_as_such(), bars.shown():
            if resume and isinstance(machine, SerialPrinter):
                report = resume_job(
                    machine,
                    checked,
                    release_c=setup.material.bed_release_c,
                    pose_confirmed=pose_confirmed,
                    progress=bars,
                )
            else:
                report = machine.print(checked, progress=bars)
            machine.finish_moves()
    except BaseException as error:
        _abort(machine)
        if isinstance(error, KeyboardInterrupt) and isinstance(machine, SerialPrinter):
            console.errors.print(
                "When somebody has looked, the same command goes on with --resume, while the bed "
                "is warm and the printer is not switched off."
            )
        raise
    finally:
        machine.close()
    _tell(report, checked.report, as_json=as_json)
    if not report.ok:
        raise typer.Exit(4)


def _cost_of(program: Program, printer: PrinterProfile) -> Estimate | None:
    """What a program takes; None for homing, heating, a test of the mesh, sent all the same."""
    from gcode.estimate import estimate as estimate_program

    try:
        return estimate_program(program, printer)
    except ReadError:
        return None


def _abort(machine: Printer) -> None:
    """End the job; the failure that led here stays the one that is reported."""
    try:
        machine.abort()
    except GcodeError as error:
        console.errors.print(f"gcode: the printer could not be made safe: {error}")


def _tell(report: PrintReport, judged: CheckReport, *, as_json: bool) -> None:
    """What became of a print, with the counters of its link."""
    result = {
        "ok": report.ok,
        "first_line": report.first_line,
        "next_line": report.next_line,
        "lines_acked": report.lines_acked,
        "resends": report.resends,
        "stalls": report.stalls,
        "spare_oks": report.spare_oks,
        "bytes_sent": report.bytes_sent,
        "round_trip_ms": {
            name: round(1000 * seconds, 3)
            for name, seconds in zip(("p50", "p95", "p99"), report.round_trip_s, strict=True)
        },
        "warnings": list(report.warnings),
        **warnings_json(judged),
        "seconds": round(report.seconds, 3),
    }
    if as_json:
        console.show_json(result)
    else:
        console.out.print(
            f"{report.lines_acked} lines acknowledged, {report.resends} resent, "
            f"{report.stalls} stalls, {report.seconds:.1f} s; round trip "
            f"{1000 * report.round_trip_s[0]:.2f} ms, 99 % within "
            f"{1000 * report.round_trip_s[2]:.2f} ms."
        )
        for warning in report.warnings if report.ok else ():  # a safe exit has told
            console.errors.print(f"printer: {warning}")
