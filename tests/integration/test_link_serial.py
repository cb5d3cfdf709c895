"""The serial host against the emulated printer, through a real pseudo-terminal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_bench import is_whole
from link_helpers import moves, profile, program

import gcode.hosts.serial as serial_host
from gcode.errors import LinkError, PrinterError
from gcode.firmware import EmulatedPrinterProcess
from gcode.hosts import LinkLostError, supervisor
from gcode.hosts.journal import Journal
from gcode.hosts.serial import SerialPrinter
from gcode.protocol import LinkTiming

QUICK = LinkTiming(
    silence_s=0.15, slow_silence_s=0.3, doubt_s=0.05, give_up_s=1.5, slow_give_up_s=3.0
)
HEAT = ["M190 S60", "M109 S205", "G28", "M83", "G90", "M83"]


@pytest.fixture(autouse=True)
def _no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_host, "require_checked", lambda checked: None)


def test_a_job_is_executed_and_its_plastic_is_reported(tmp_path: Path) -> None:
    wire = tmp_path / "wire.log"
    job = program([*HEAT, *moves(2000)])
    with (
        EmulatedPrinterProcess(printer=profile()) as emulator,
        SerialPrinter(emulator.port, wire_log=wire) as printer,
    ):
        first = printer.print(job, lines=range(1000))
        second = printer.print(job, lines=range(1000, 2007))
        printer.finish_moves()
        motion = emulator.take_motion()
        assert printer.temperatures().hotend_c == pytest.approx(205, abs=1)
        # Heating is 205 °C in virtual minutes; the wall saw seconds.
        assert emulator.clock_s() > 180
    assert first.ok
    assert second.ok
    assert first.lines_acked + second.lines_acked == 2006
    assert motion.filament_mm.sum() == pytest.approx(20.0, abs=1e-9)
    beads = motion.filament_mm > 0
    assert np.array_equal(motion.start_mm[1:], motion.end_mm[:-1])
    assert int(beads.sum()) == 2000
    assert b"M109 S205" in wire.read_bytes()


def test_every_second_thing_goes_wrong_and_each_command_runs_once(tmp_path: Path) -> None:
    record = tmp_path / "executed"
    faults = "every 37 corrupt_in\nevery 53 lose_ok\nevery 61 double_ok\nevery 71 resend_storm\n"
    faults += "line 200 silence s=0.4\nline 250 noise_in\nalways resend_without_ok"
    lines = [*HEAT, *moves(350)]
    with (
        EmulatedPrinterProcess(printer=profile(), faults=faults, record=record) as emulator,
        SerialPrinter(emulator.port, timing=QUICK) as printer,
    ):
        report = printer.print(program(lines))
    executed = [
        line
        for line in record.read_text().splitlines()
        if line not in ("M114", "M115", "M105", "M104 S0", "M140 S0", "M107")
    ]
    assert executed == lines
    assert report.ok
    assert report.resends > 10
    assert report.stalls > 5


@pytest.mark.parametrize("fault", ["reset", "silent_reset", "dead", "disconnect s=0.1"])
def test_a_lost_printer_stops_the_job_and_names_the_interval(fault: str, tmp_path: Path) -> None:
    record = tmp_path / "executed"
    with (
        EmulatedPrinterProcess(
            printer=profile(), faults=f"line 200 {fault}", record=record
        ) as emulator,
        SerialPrinter(emulator.port, timing=QUICK) as printer,
    ):
        lines = moves(400)
        with pytest.raises(LinkLostError) as caught:
            printer.print(program(lines))
    executed = [line for line in record.read_text().splitlines() if line.startswith("G1 X")]
    assert executed == lines[: len(executed)]
    # Counted from 0: the number executed lies within what the error names.
    assert caught.value.last_executed_line + 1 <= len(executed) <= caught.value.last_sent_line + 1


def test_thermal_runaway_is_the_printers_fault() -> None:
    with (
        EmulatedPrinterProcess(printer=profile(), faults="line 100 thermal_runaway") as emulator,
        SerialPrinter(emulator.port, timing=QUICK) as printer,
        pytest.raises(PrinterError, match="Thermal Runaway"),
    ):
        printer.print(program(moves(200)))


def test_a_firmware_that_ignores_checksums_gets_nothing_to_print() -> None:
    with EmulatedPrinterProcess(printer=profile(), faults="always ignore_checksums") as emulator:
        printer = SerialPrinter(emulator.port, timing=QUICK)
        with pytest.raises(LinkError, match="checksums"):
            printer.connect()


_SENDER = """
import sys
sys.path[:0] = {path!r}
from pathlib import Path
from link_helpers import program, moves
import gcode.hosts.serial as host
from gcode.hosts.journal import Journal
host.require_checked = lambda checked: None
printer = host.SerialPrinter(sys.argv[1], journal=Journal(Path(sys.argv[2])))
printer.connect()
print("go", flush=True)
printer.print(program(["M104 S200", "M140 S60", "G28", *moves(50000)]))
"""


def test_a_killed_sender_leaves_heaters_off_and_a_whole_journal(tmp_path: Path) -> None:
    journal_path = tmp_path / "journal.sqlite"
    record = tmp_path / "executed"
    root = Path(__file__).parent.parent.parent
    code = _SENDER.format(path=[str(root), str(root / "tests" / "unit")])
    with EmulatedPrinterProcess(printer=profile(), record=record) as emulator:
        for attempt in range(3):
            emulator.reset()
            before = record.stat().st_size if record.exists() else 0
            sender = subprocess.Popen(
                [sys.executable, "-c", code, emulator.port, str(journal_path)],
                stdout=subprocess.PIPE,
            )
            assert sender.stdout is not None
            assert sender.stdout.readline() == b"go\n"
            time.sleep(0.15 + 0.1 * attempt)  # a moment in mid-print: a kill has no event
            while emulator.state()["hotend_target_c"] != 200:
                time.sleep(0.01)
            os.kill(sender.pid, signal.SIGKILL)
            sender.wait()
            sender.stdout.close()
            until_s = time.monotonic() + 5.0  # the stated time
            state = emulator.state()
            # one command switches each heater: both within the stated time, not at once
            while (
                state["hotend_target_c"] or state["bed_target_c"]
            ) and time.monotonic() < until_s:
                time.sleep(0.02)
                state = emulator.state()
            assert state["hotend_target_c"] == 0
            assert state["bed_target_c"] == 0
            journal = Journal(journal_path)
            job = journal.latest()
            assert is_whole(journal_path)
            assert job is not None
            executed = [
                line
                for line in record.read_bytes()[before:].decode().splitlines()
                if line.startswith("G1 X")
            ]
            assert executed == moves(len(executed))
            assert job.acked <= len(executed) + 4 <= job.reserved
            until_s = time.monotonic() + 5.0
            while not journal.notes() and time.monotonic() < until_s:
                time.sleep(0.02)
            assert "heaters off" in journal.notes()[-1]
            journal.close()


_ENDED = """
import sys
sys.path[:0] = {path!r}
from link_helpers import program, moves
import gcode.hosts.serial as host
from gcode.process import signals_end_it
host.require_checked = lambda checked: None
with signals_end_it(), host.SerialPrinter(sys.argv[1], supervise=False) as printer:
    tell = lambda stage, done, total: done and print("go", flush=True)
    printer.print(program(["M104 S200", "G28", *moves(50000)]), progress=tell)
"""


def test_a_sender_that_is_told_to_end_leaves_the_printer_safe_itself(tmp_path: Path) -> None:
    record, root = tmp_path / "executed", Path(__file__).parent.parent.parent
    code = _ENDED.format(path=[str(root), str(root / "tests" / "unit")])
    with EmulatedPrinterProcess(printer=profile(), record=record) as emulator:
        sender = subprocess.Popen(
            [sys.executable, "-c", code, emulator.port],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert sender.stdout is not None
        sender.stdout.readline()
        sender.send_signal(signal.SIGTERM)
        _, said = sender.communicate(timeout=20)
        state = emulator.state()
    assert "KeyboardInterrupt" in said
    assert (state["hotend_target_c"], state["bed_target_c"]) == (0, 0)
    told = record.read_text().splitlines()
    assert 0 < sum(line.startswith("G1 X") for line in told) < 50000
    assert "M104 S0" in told[-10:]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_million_lines_stream_in_constant_memory(tmp_path: Path) -> None:
    """From the tenth part on no more than a batch comes to this process's memory."""
    page_bytes = os.sysconf("SC_PAGE_SIZE")
    held: list[int] = []
    drained = [0.0]

    def tell(stage: str, done: float, total: float) -> None:
        if done >= (drained[-1] + 20_000):
            drained.append(done)
            emulator.take_motion()  # the emulator tells this process what it did
        if done >= total / 10:
            held.append(int(Path("/proc/self/statm").read_text().split()[1]) * page_bytes)

    job = program(moves(1_000) * 1_000)
    with (
        EmulatedPrinterProcess(printer=profile()) as emulator,
        SerialPrinter(
            emulator.port,
            journal=Journal(tmp_path / "journal.sqlite"),
            wire_log=tmp_path / "wire.log",
        ) as printer,
    ):
        report = printer.print(job, progress=tell)
    assert report.ok
    assert report.lines_acked == 1_000_000
    print(f"{report.seconds:.0f} s, grown by {(max(held) - held[0]) / 1e6:.2f} MB")
    assert max(held) - held[0] < 4_000_000


def test_a_lost_link_never_claims_that_the_heaters_are_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # regression: the log said "heaters off" although nobody had confirmed it
    monkeypatch.setattr(supervisor, "PORT_ANSWERS_S", 0.05)
    wire = tmp_path / "wire.log"
    job = program([*HEAT, *moves(200)])
    with (
        EmulatedPrinterProcess(printer=profile(), faults="line 120 silence s=60") as emulator,
        pytest.raises(LinkLostError),
        SerialPrinter(emulator.port, wire_log=wire, timing=QUICK) as printer,
    ):
        printer.print(job)
    notes = [line for line in wire.read_bytes().splitlines() if b"heaters" in line.lower()]
    assert notes
    assert any(b"NO ANSWER" in note for note in notes)
    assert not any(b"heaters off" in note for note in notes)
