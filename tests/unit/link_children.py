"""What the children of `link_forks` do: print a program, or be a printer."""

from __future__ import annotations

import json
import os
import time
import traceback
from pathlib import Path

from link_helpers import profile, program

import gcode.hosts.serial as serial_host
from gcode.firmware import FirmwareCore
from gcode.firmware.faults import parse_faults
from gcode.firmware.serve import PtyServer
from gcode.hosts import LinkLostError, ResumeRefusedError
from gcode.hosts.journal import Journal
from gcode.hosts.resume import resume
from gcode.progress import Progress, silent
from gcode.protocol import LinkTiming

QUICK = LinkTiming(
    silence_s=0.3, slow_silence_s=0.6, doubt_s=0.05, give_up_s=2.0, slow_give_up_s=4.0
)
"""Shorter than on a wire: nothing gets lost between two processes."""


def job_lines(count: int) -> list[str]:
    """A job whose every bead is unlike every other, heated and homed."""
    head = ["M140 S60", "M104 S205", "M190 S60", "M109 S205", "G28", "G90", "M83", "G1 Z0.2 F600"]
    beads = [
        f"G1 X{20 + i % 150} Y{20 + i // 150 * 0.25:.2f} E0.0{1 + i % 3}{' F6000' * (i == 0)}"
        for i in range(count)
    ]
    return [*head, *beads, "M104 S0", "M140 S0"]


def beads_of(text: str) -> list[str]:
    """The beads among what was executed."""
    return [line for line in text.splitlines() if " E0.0" in line and line.startswith("G1 X")]


def emulate(
    link: str, record: str, faults: str = "", firmware: str = "marlin", accelerated: bool = True
) -> int:
    fd = os.open(record, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    core = FirmwareCore(
        profile(),
        firmware,
        faults=parse_faults(faults),
        accelerated=accelerated,
        record=lambda command: os.write(fd, command + b"\n") and None,
    )
    PtyServer(core, Path(link)).serve()
    return 0


def _pause_once(printer: serial_host.SerialPrinter) -> Progress:
    """Pause in the middle, and never go on: a kill will end it."""

    def progress(stage: str, done: float, total: float) -> None:
        if done > total / 4:
            printer.pause()

    return progress


def send(
    port: str,
    journal: str,
    outcome: str,
    lines: int = 20000,
    go_on: bool = False,
    pose_confirmed: bool = False,
    dialect: str = "marlin",
    later_s: float = 0.0,
    pause: bool = False,
    there_and_back: bool = False,
) -> int:
    """Print, or go on; what became of it is written to the file `outcome`."""
    serial_host.require_checked = lambda checked: None
    text = job_lines(lines)
    if there_and_back:
        text[8:-2] = [f"G1 X{20 + 20 * (i % 2)} Y20 E0.01 F6000" for i in range(lines)]
    job = program(text)
    told: dict[str, object] = {}
    code = 0
    book = Journal(Path(journal), step_lines=64, step_s=0.0)
    printer = serial_host.SerialPrinter(port, journal=book, dialect=dialect, timing=QUICK)
    try:
        if go_on:
            report = resume(
                printer,
                job,
                release_c=40.0,
                pose_confirmed=pose_confirmed,
                wall_clock=lambda: time.time() + later_s,
            )
        else:
            printer.connect()
            report = printer.print(job, progress=_pause_once(printer) if pause else silent)
        told = {"first_line": report.first_line, "next_line": report.next_line}
    except (LinkLostError, ResumeRefusedError) as error:
        told = {
            "error": str(error),
            "executed": error.last_executed_line,
            "sent": error.last_sent_line,
        }
        code = 4
    except BaseException:  # noqa: BLE001  # the test reads what it was
        told = {"error": traceback.format_exc()}
        code = 5
    Path(outcome).write_text(json.dumps(told))
    printer.close()
    return code
