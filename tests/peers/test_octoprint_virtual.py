"""Our sender prints through OctoPrint's bundled virtual printer, faults and lies included."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from link_helpers import program
from peer_harness import HERE, peer

from gcode.errors import LinkError, PrinterError
from gcode.hosts import LinkLostError
from gcode.hosts.serial import SerialPrinter
from gcode.protocol import LinkTiming

pytestmark = pytest.mark.peers

# The printer takes the time that its moves would take, from 200 mm/min on.
JOB = ["G28", "G90", "G1 F60000", *(f"G1 X{50 + i / 100:.2f} Y50" for i in range(250))]
OWN = (
    *("", "M114", "M115", "M105", "M108", "M104 S0", "M140 S0", "M107"),
    *("G21", "G91", "G1 Z5 F600", "G90"),
)
QUICK = LinkTiming(silence_s=0.3, slow_silence_s=0.6, give_up_s=3.0, slow_give_up_s=6.0)
SEEN = [line for line in JOB if line not in OWN]


@contextmanager
def virtual_printer(tmp_path: Path, *faults: str) -> Iterator[tuple[str, Path]]:
    record = tmp_path / "record"
    with subprocess.Popen(
        [peer("octoprint"), HERE / "virtual_printer.py", record, tmp_path, *faults],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as running:
        assert running.stdin is not None
        assert running.stdout is not None
        try:
            yield running.stdout.readline().strip(), record
        finally:
            running.stdin.close()


def executed(record: Path) -> list[str]:
    rows = record.read_text().splitlines()
    return [row[2:] for row in rows if row.startswith("C ") and row[2:] not in OWN]


def test_the_default_faults_are_got_through(tmp_path: Path) -> None:
    """Resends at 100 and 110, a lying checksum error at 115, silence at 105.

    The printer takes line 105 and throws its copy away: it counts it as received, does not carry
    it out and asks for 106. Everything else is carried out once, in order.
    """
    with virtual_printer(tmp_path) as (port, record), SerialPrinter(port) as printer:
        started_s = time.monotonic()
        report = printer.print(program(JOB))
        seconds = time.monotonic() - started_s
    assert report.ok
    assert report.resends >= 3
    done = executed(record)
    (swallowed,) = [line for line in SEEN if line not in done]
    assert done == [line for line in SEEN if line != swallowed]
    print(f"virtual printer with default faults: {seconds:.1f} s, {report.resends} resends")


@pytest.mark.parametrize(
    "fault",
    [
        "dont_answer",
        "trigger_missing_lineno",
        "prepare_ok o",
        "prepare_ok okok",
        "sleep 2",
        "send echo: hours of printing",
        "send Resend",
        "send rs 999999999",
        "action_resume",
        "resend_ratio 10",
    ],
)
def test_a_fault_that_can_be_told_is_got_through(fault: str, tmp_path: Path) -> None:
    with virtual_printer(tmp_path, f"60:{fault}") as (port, record), SerialPrinter(port) as printer:
        report = printer.print(program(JOB))
    assert report.ok
    done = executed(record)
    assert len(set(done)) == len(done), "executed twice"
    assert [line for line in SEEN if line in done] == done, "out of order"


@pytest.mark.parametrize(
    "fault",
    [
        "go_awol",
        "drop_connection",
        "reset",
        "trigger_fatal_error_marlin",
    ],
)
def test_a_fault_that_cannot_be_mended_stops_the_job(fault: str, tmp_path: Path) -> None:
    """Never twice; where the job stops, the interval that is named holds the truth."""
    with virtual_printer(tmp_path, f"60:{fault}") as (port, record):
        printer = SerialPrinter(port, timing=QUICK)
        printer.connect()
        caught: LinkError | None = None
        try:
            printer.print(program(JOB))
        except (LinkLostError, PrinterError) as error:
            caught = error
        finally:
            printer.close()
        done = executed(record)
    assert len(set(done)) == len(done), "executed twice"
    assert caught is not None
    if isinstance(caught, LinkLostError):
        last = JOB.index(done[-1])
        assert caught.last_executed_line <= last <= caught.last_sent_line
    assert done == [line for line in SEEN if line in done], "out of order"


@pytest.mark.parametrize(
    "fault", ["trigger_resend_lineno", "trigger_resend_checksum", "trigger_missing_checksum"]
)
def test_a_printer_that_takes_a_line_back_gets_it_again(fault: str, tmp_path: Path) -> None:
    """It carries a line out, sets its number back and asks for it: no firmware does.

    A request for an acknowledged line is served, because an `ok` may be false while a number that
    the firmware verifies is not. Here the printer lies about its number, and so does that one line
    twice, as it does with OctoPrint; nothing else is lost or doubled.
    """
    with virtual_printer(tmp_path, f"60:{fault}") as (port, record), SerialPrinter(port) as printer:
        report = printer.print(program(JOB))
    done = executed(record)
    twice = [line for line in SEEN if done.count(line) > 1]
    assert report.ok
    assert len(twice) == 1
    assert done.index(twice[0]) + 1 == len(done) - 1 - done[::-1].index(twice[0]), "not in a row"
    done.remove(twice[0])
    (swallowed,) = [line for line in SEEN if line not in done]  # line 105 of the default faults
    assert done == [line for line in SEEN if line != swallowed]
