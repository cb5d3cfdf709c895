"""`amrepair loop`: print a job and repair it on the way, with a real printer and scanner."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path
from typing import Annotated

import typer

from amrepair.cli.live import (
    VIEW_PORT,
    HostOption,
    PortOption,
    TokenOption,
    ViewOption,
    ViewPlace,
)
from amrepair.cli.options import (
    SCAN_TIMEOUT_S,
    ScannerOption,
    ScannerPoseOption,
    ScanTimeoutOption,
    SeedOption,
    SoundOption,
    calibration_named,
    require_approval,
)
from amrepair.errors import InputError
from amrepair.report.guarded import LOOPBACK
from gcode.cli import console
from gcode.cli.judging import LeaveHeatersOption
from gcode.cli.options import JsonOption, ProcessOption
from gcode.cli.owning import JobMaterialOption, JobPrinterOption
from gcode.profiles import DEFAULT_PROCESS


@console.command(
    "loop",
    "amrepair loop job.gcode --template part.safetensors --port /dev/ttyACM0 "
    "--scanner watch:scans --every 20 --at 12.5",
    "amrepair loop job.gcode --template part.safetensors --port /dev/ttyACM0 "
    "--scanner watch:scans --adaptive",
    "amrepair loop job.gcode --template part.stl --port /dev/ttyACM0 --scanner watch:scans --view",
    "amrepair loop job.gcode --template part.stl --port /dev/ttyACM0 "
    "--scanner watch:scans --approve auto --json",
    "amrepair loop --resume out/loop",
)
def loop(
    job_file: Annotated[
        Path | None, typer.Argument(metavar="JOB", help="G-code of the whole job.")
    ] = None,
    template: Annotated[
        Path | None,
        typer.Option(
            "--template",
            help="Fitted template, or a mesh that is fitted now; or a folder with one of each part "
            "that the job prints.",
        ),
    ] = None,
    port: Annotated[
        str | None,
        typer.Option(help="Device path, octoprint+http://HOST:PORT or moonraker+http://HOST:PORT."),
    ] = None,
    scanner: ScannerOption = None,
    printer: JobPrinterOption = None,
    material: JobMaterialOption = None,
    process: ProcessOption = DEFAULT_PROCESS,
    approve: Annotated[
        str | None,
        typer.Option(
            help="ask before every repair (where left out), or auto: within the limits that the "
            "process profile sets."
        ),
    ] = None,
    every: Annotated[
        int, typer.Option(min=0, help="Scan after every so many layers; 0: only at the end.")
    ] = 0,
    adaptive: Annotated[
        bool,
        typer.Option(
            "--adaptive",
            help="Scan less often while all is clean, down to a fourth of --every (8 where left "
            "out), and four times as often after trouble.",
        ),
    ] = False,
    at_mm: Annotated[
        list[float] | None,
        typer.Option("--at", metavar="Z", help="Scan when the job has reached this height, mm."),
    ] = None,
    at_layer: Annotated[
        list[int] | None, typer.Option("--at-layer", help="Scan after this layer, too.")
    ] = None,
    calibration: ScannerPoseOption = None,
    sound: SoundOption = None,
    scan_timeout_s: ScanTimeoutOption = SCAN_TIMEOUT_S,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for result, scans, report.")
    ] = Path("out/loop"),
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume",
            metavar="RUN",
            help="Go on with the run in this folder, which was killed or ended; JOB and all else "
            "come from there.",
        ),
    ] = None,
    pose_confirmed: Annotated[
        bool,
        typer.Option(
            "--pose-confirmed",
            help="With --resume: a scan has shown that the part stands where it stood.",
        ),
    ] = False,
    leave_heaters: LeaveHeatersOption = False,
    desk: Annotated[
        Path | None,
        typer.Option(
            help="Folder for another program that supervises the run: progress and questions are "
            "in its status.json, answers are taken from its answer.json."
        ),
    ] = None,
    view: ViewOption = False,
    view_host: HostOption = LOOPBACK,
    view_port: PortOption = VIEW_PORT,
    token: TokenOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Print a job; at chosen layers and at the end scan, repair what is missing, go on."""
    if approve is not None:
        require_approval(approve)
    if desk is not None and view:
        raise InputError("--desk and --view are two places to ask at; leave one out")
    with console.starting():
        from amrepair.cli import running

    errors = calibration_named(sound)
    running.run(
        job_file,
        template,
        out,
        (printer, material, process),
        running.Looks(every, adaptive, tuple(at_layer or ()), tuple(at_mm or ())),
        calibration,
        ViewPlace(view, view_host, view_port, token, desk),
        resume=resume,
        pose_confirmed=pose_confirmed,
        port=port,
        scanner=scanner,
        approve=approve,
        scan_timeout_s=scan_timeout_s,
        leave_heaters=leave_heaters,
        sound=() if errors is None else astuple(errors),
        seed=seed,
        as_json=as_json,
    )
