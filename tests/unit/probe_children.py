"""What the children of `link_forks` do for the tests of touches: run the loop, or be a printer."""

from __future__ import annotations

import os
import signal
import traceback
from pathlib import Path

from link_children import QUICK
from loop_children import Dying

from amrepair.loop import LoopOptions, Records, run_loop
from amrepair.loop.pick_up import pick_up
from amrepair.loop.probing import PortFeeler, ProbeScanner
from amrepair.loop.run_folder import open_run
from amrepair.loop.sites import sites
from gcode.check import check
from gcode.firmware import FirmwareCore
from gcode.firmware.faults import parse_faults
from gcode.firmware.serve import PtyServer
from gcode.hosts.journal import Journal
from gcode.hosts.serial import SerialPrinter
from gcode.profiles import load_printer
from gcode.surfaces import HeightField

SLOW = "always slow_reader s=0.001"


MENDED = signal.SIGUSR1
"""Tells a printer that its probe triggers from now on."""


def emulate(link: str, record: str, printer: str, standing: str, dead: bool = False) -> int:
    """A printer whose nozzle feels what stands there, or nothing at all until it is mended."""
    fd = os.open(record, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    profile = load_printer(printer)
    core = FirmwareCore(
        profile,
        profile.dialect,
        faults=parse_faults(SLOW),
        accelerated=True,
        record=lambda command: os.write(fd, command + b"\n") and None,
    )
    core.machine.stand(HeightField.read(Path(standing)))
    contact = core.machine.contact
    assert contact is not None
    contact.dead = dead
    signal.signal(MENDED, lambda *_: setattr(contact, "dead", False))
    PtyServer(core, Path(link)).serve()
    return 0


def loop(folder: str, port: str, go_on: bool = False, die_after: int = 0) -> int:
    """Run the loop of a folder with the printer's probe, or go on; what went wrong is in `told`."""
    here = Path(folder)
    run = open_run(here / "run")
    book = Journal(here / "journal.sqlite", step_lines=64, step_s=0.0)
    dialect = run.setup.printer.dialect
    printer = SerialPrinter(port, journal=book, dialect=dialect, timing=QUICK)
    code = 0
    try:
        found = pick_up(printer, release_c=40.0) if go_on else None
        if not go_on:
            printer.connect()
        scanner = ProbeScanner(PortFeeler(printer, run.setup), run.job, run.setup)
        report = run_loop(
            run.job,
            check(run.job.program, run.setup),
            printer,
            scanner,
            sites(run.job, run.template, run.setting.placed, run.setup, by_beads=False),
            stops=run.stops,
            options=LoopOptions(seed=run.setting.seed),
            records=Records(tape=Dying(here / "run", die_after), pick_up=found),
        )
        told = f"within: {report.within_tolerance}, touches: {scanner.felt[0].touches}"
    except BaseException as error:  # noqa: BLE001  # the test reads what it was
        told, code = f"{error}\n{traceback.format_exc()}", getattr(error, "exit_code", 5)
    (here / "told").write_text(told)
    printer.close()
    return code
