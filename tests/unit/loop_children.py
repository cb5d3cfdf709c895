"""What the children of `link_forks` do for the tests of the loop: run it, or be a printer."""

from __future__ import annotations

import os
import re
import signal
import traceback
from dataclasses import replace
from pathlib import Path

import numpy as np
from link_children import QUICK

from amrepair.errors import ScannerError
from amrepair.frames import Transform
from amrepair.loop import LoopOptions, Records, Tape, run_loop
from amrepair.loop.pick_up import pick_up
from amrepair.loop.run_folder import open_run
from amrepair.loop.sites import sites
from amrepair.loop.tape import read_events
from amrepair.report.folder import RunFolder
from amrepair.scans import Scan, ScanRequest, read_scan
from gcode.check import check
from gcode.firmware import FirmwareCore
from gcode.firmware.faults import parse_faults
from gcode.firmware.serve import PtyServer
from gcode.hosts.journal import Journal
from gcode.hosts.serial import SerialPrinter
from gcode.profiles import load_printer

PRINTER = "prusa_mk3s"
MUTE = "layer-002"
_BEAD = re.compile(r"G1 .*[XY].* E(?!-)")


def beads_of(lines: list[str]) -> list[str]:
    """Moves that lay plastic, among lines of a program or of what was executed."""
    commands = (line.partition(";")[0].strip() for line in lines)
    return [command for command in commands if _BEAD.match(command)]


def emulate(link: str, record: str, faults: str = "") -> int:
    fd = os.open(record, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    core = FirmwareCore(
        load_printer(PRINTER),
        "prusa",
        faults=parse_faults(faults),
        accelerated=True,
        record=lambda command: os.write(fd, command + b"\n") and None,
    )
    PtyServer(core, Path(link)).serve()
    return 0


class StoredScanner:
    """The broken part until a repair of the stop is on the tape, the whole part then.

    A rough one loses a fifth of the points, finds some elsewhere, and says nothing at `MUTE`, where
    nothing is wrong.
    """

    def __init__(self, folder: Path, *, rough: bool = False) -> None:
        self._folder, self._rough = folder, rough

    @property
    def build_from_scanner(self) -> Transform:
        return Transform.identity("build", "scanner")

    def scan(self, request: ScanRequest) -> Scan:
        looks = [e for e in read_events(self._folder / "run") if e["event"] == "look"]
        mended = any(e["printed"] and e["stop"] == request.label for e in looks)
        which = "whole" if mended or request.label == MUTE else "broken"
        scan = read_scan(self._folder / f"{which}-{request.label}.ply", frame="scanner")
        if not self._rough:
            return scan
        if request.label == MUTE:
            raise ScannerError("it says nothing")
        rng = np.random.default_rng(len(looks))
        points = scan.points_mm.copy()
        astray = rng.random(len(points)) < 0.002
        points[astray] += rng.laplace(0.0, 0.5, (int(astray.sum()), 3))
        keep = rng.random(len(points)) < 0.8
        normals = None if scan.normals is None else scan.normals[keep]
        return replace(scan, points_mm=points[keep], normals=normals)


class Dying(Tape):
    """A tape whose writer is killed right after its n-th event, counted from 1; 0: never."""

    def __init__(self, path: Path, die_after: int) -> None:
        super().__init__(path)
        self._left = die_after

    def write(self, event: str, **said: object) -> None:
        super().write(event, **said)
        self._left -= 1
        if self._left == 0:
            os.kill(os.getpid(), signal.SIGKILL)


def loop(
    folder: str, port: str, go_on: bool = False, die_after: int = 0, rough: bool = False
) -> int:
    """Run the loop of a folder, or go on with it; what went wrong is in `told`."""
    here = Path(folder)
    try:
        run = open_run(here / "run")
    except BaseException:  # noqa: BLE001
        (here / "told").write_text(traceback.format_exc())
        return 5
    tape, told_lines = Dying(here / "run", die_after), [0.0]

    def progress(stage: str, done: float, total: float) -> None:
        if stage == "print":
            assert told_lines[-1] <= done <= total, (told_lines[-3:], done)
            told_lines.append(done)

    book = Journal(here / "journal.sqlite", step_lines=64, step_s=0.0)
    printer = SerialPrinter(port, journal=book, dialect="prusa", timing=QUICK)
    code = 0
    try:
        found = pick_up(printer, release_c=40.0) if go_on else None
        if not go_on:
            printer.connect()
        report = run_loop(
            run.job,
            check(run.job.program, run.setup),
            printer,
            StoredScanner(here, rough=rough),
            sites(run.job, run.template, run.setting.placed, run.setup, by_beads=False),
            stops=run.stops,
            options=LoopOptions(silent_stops=int(rough), seed=run.setting.seed),
            records=Records(RunFolder(here / "run").record, tape=tape, pick_up=found),
            progress=progress,
        )
        told = (
            f"within: {report.within_tolerance}, looks: {len(report.looks)}, "
            f"passed by: {len(report.passed)}"
        )
    except BaseException as error:  # noqa: BLE001  # the test reads what it was
        told, code = f"{error}\n{traceback.format_exc()}", getattr(error, "exit_code", 5)
    (here / "told").write_text(told)
    printer.close()
    return code
