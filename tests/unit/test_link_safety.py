"""What is said of heaters is what a reply confirmed; temperatures reach the journal."""

from __future__ import annotations

import contextlib
import os
import socket
import sqlite3
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from link_helpers import moves, profile, program

import gcode.hosts.serial as serial_host
from gcode.cli.sending import send
from gcode.errors import JournalError, JournalFileError, LinkError, PortBusyError
from gcode.firmware import EmulatedPrinterProcess
from gcode.hosts import supervisor
from gcode.hosts.journal import Journal
from gcode.hosts.serial import SerialPrinter


@pytest.fixture(autouse=True)
def _no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_host, "require_checked", lambda checked: None)


def answering(
    report: bytes | Iterator[bytes] | None, *, to_commands: bytes = b"ok\n"
) -> tuple[str, list[bytes]]:
    """Let the supervisor speak to a port that says `report` to M105, or each of them in turn."""
    ours, theirs = socket.socketpair()
    heard: list[bytes] = []

    def serve() -> None:
        with theirs, theirs.makefile("rwb", buffering=0) as port:
            for line in port:
                heard.append(line.strip())
                if line.strip() and report is not None:
                    if line != b"M105\n":
                        port.write(to_commands)
                    else:
                        port.write(report if isinstance(report, bytes) else next(report))

    thread = threading.Thread(target=serve)
    thread.start()
    with ours:  # as a sender left it that was killed while it waited in a read
        said = supervisor.make_safe(ours.fileno())
        assert not os.get_blocking(ours.fileno())
        ours.shutdown(socket.SHUT_RDWR)
    thread.join(10)
    return said, heard


def test_an_ok_alone_does_not_make_heaters_off(monkeypatch: pytest.MonkeyPatch) -> None:
    # regression: eight ok and the log said "heaters off"; they may answer the dead sender's lines
    said, heard = answering(b"ok\n")
    assert "heaters off" not in said
    assert "told to switch off" in said
    assert heard.index(b"M104 S0") < heard.index(b"G21") < heard.index(b"G1 Z5 F600")


def test_targets_above_zero_are_not_called_off() -> None:
    said, _ = answering(b"ok T:201.1 /0.0 B:60.0 /60.0 @:0\n")
    assert "told to switch off" in said


@pytest.mark.parametrize(
    "report",
    [b"ok T:201.1 /0.0 B:60.0 /0.0 @:0\n", b"T:20 /0 B:20 /0\nok\n", b"ok B:9 /0.0 T0:9 /0.0\n"],
)
def test_targets_of_zero_are_called_off(report: bytes) -> None:
    said, heard = answering(report)
    assert "heaters off" in said
    assert heard[-1] == b"M105"


def test_a_klipper_that_has_shut_down_is_said_to_have() -> None:
    """regression: nobody was told why; targets stay as they were, and the boards heat no more."""
    refusal = b"// Lost communication with MCU 'mcu'\n!! Lost communication with MCU 'mcu'\nok\n"
    said, _ = answering(b"ok B:60.0 /60.0 T0:201.1 /200.0\n", to_commands=refusal)
    assert (
        "nothing confirms it: the printer has stopped (Lost communication with MCU 'mcu')" in said
    )


def test_a_klipper_that_starts_anew_is_asked_until_it_knows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """regression: "nothing confirms it", a second before it said so; and no nozzle was lifted."""
    monkeypatch.setattr(supervisor, "PORT_ANSWERS_S", 0.05)
    reports = iter([*5 * [b"ok T:0\n"], *2 * [b"ok B:60.0 /0.0 T0:201.1 /0.0\n"]])
    said, _ = answering(reports, to_commands=b"!! Printer is not ready\nok\n")
    assert said == "heaters off (the printer reports targets of 0)"


def test_a_nozzle_that_the_firmware_does_not_move_is_not_called_lifted() -> None:
    """regression: a Klipper that had been restarted moves nothing before it is homed."""
    with EmulatedPrinterProcess(printer=profile(), firmware="klipper") as emulator:
        with SerialPrinter(emulator.port, dialect="klipper", supervise=False) as printer:
            printer.command("M104 S100")
            printer.make_safe()
            assert printer.notes[-1] == "heaters off (the printer reports targets of 0)"
        assert emulator.state()["hotend_target_c"] == 0


def test_no_answer_at_all_is_said_to_be_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "PORT_ANSWERS_S", 0.01)
    said, _ = answering(None)
    assert "NO ANSWER" in said


@pytest.mark.parametrize(
    ("commands", "said"), [(None, "heaters off"), (("M107",), "told to switch off")]
)
def test_a_safe_exit_says_off_only_where_the_printer_reports_it(
    commands: tuple[str, ...] | None, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if commands is not None:  # a firmware that takes M104 S0 and does nothing
        monkeypatch.setattr("gcode.hosts.guarded.SAFE_COMMANDS", commands)
    with (
        EmulatedPrinterProcess(printer=profile()) as emulator,
        SerialPrinter(emulator.port, supervise=False) as printer,
    ):
        printer.command("M104 S100")
        printer.make_safe()
        notes = printer.notes
        target_c = emulator.state()["hotend_target_c"]
    assert said in notes[-1]
    assert ("heaters off" in notes[-1]) == (target_c == 0)


def test_temperatures_reach_the_journal(tmp_path: Path) -> None:
    # regression: nothing called Journal.temperature(), so nothing was known of the bed
    journal = Journal(tmp_path / "journal.sqlite")
    clock = iter(range(10**9))
    with (
        EmulatedPrinterProcess(printer=profile()) as emulator,
        SerialPrinter(
            emulator.port,
            journal=journal,
            supervise=False,
            clock=lambda: next(clock) * 0.01,  # every look at the clock takes 10 ms
        ) as printer,
    ):
        lines = ["M190 S60", "M109 S205", "G28", "M83", *moves(3000), "M140 S0", "G4 S3600"]
        report = printer.print(program([*lines, *moves(1500)]))
    assert report.ok
    noted = journal.temperatures()
    assert len(noted) > 10
    assert max(hotend_c for _, hotend_c, _ in noted) == pytest.approx(205.0, abs=1.0)
    assert min(bed_c for _, _, bed_c in noted if bed_c is not None) < 30.0
    journal.close()


def test_how_cold_the_bed_was_counts_from_when_it_was_warm(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.sqlite", clock=lambda: 0.0)
    journal.begin("a", "port", 0, 10)
    for bed_c in (22.0, 39.0, 60.0, 45.0, 60.0):
        journal.temperature(200.0, bed_c)
    assert journal.lowest_bed_c(40.0) == 45.0
    assert journal.lowest_bed_c(70.0) is None
    journal.settle(1, 5)
    journal.open_session()
    journal.begin("a", "port", 5, 10)  # the same program goes on: its part stood there all along
    journal.temperature(200.0, 38.0)
    assert journal.lowest_bed_c(40.0) == 38.0
    journal.open_session()
    journal.begin("a", "port", 0, 10)  # anew, on an empty bed
    assert journal.lowest_bed_c(40.0) is None
    journal.close()


class FullDisk(Journal):
    """Takes the job's beginning, then nothing more."""

    def _execute(self, sql: str, *values: object) -> sqlite3.Cursor:
        if "UPDATE" in sql or "note" in sql:
            raise JournalError("The journal cannot be written (disk full).")
        return super()._execute(sql, *values)


def test_a_full_disk_does_not_keep_the_heaters_on(tmp_path: Path) -> None:
    # regression: the safe exit's own remark was the next thing that could not be written
    journal = FullDisk(tmp_path / "journal.sqlite")
    with EmulatedPrinterProcess(printer=profile()) as emulator:
        printer = SerialPrinter(emulator.port, journal=journal, supervise=False)
        printer.connect()
        printer.command("M104 S100")
        with pytest.raises(JournalError, match="disk full"):
            printer.print(program(moves(100)))
        state = emulator.state()
        printer.close()
    assert state["hotend_target_c"] == 0
    assert "heaters off" in printer.notes[-1]


class FullLater(Journal):
    """Takes the job's beginning and its first step."""

    def _execute(self, sql: str, *values: object) -> sqlite3.Cursor:
        if "UPDATE step" in sql:
            raise JournalError("The journal cannot be written (disk full).")
        return super()._execute(sql, *values)


def test_what_could_not_be_reserved_is_not_sent(tmp_path: Path) -> None:
    """Steps are extended by a thread: its failure must reach the sender before the next line."""
    record = tmp_path / "executed"
    journal = FullLater(tmp_path / "journal.sqlite", step_lines=64, step_s=0.0)
    with EmulatedPrinterProcess(printer=profile(), record=record) as emulator:
        printer = SerialPrinter(emulator.port, journal=journal, supervise=False)
        printer.connect()
        with pytest.raises(JournalError, match="disk full"):
            printer.print(program(moves(100)))
        state = emulator.state()
        printer.close()
    journal.close()
    told = record.read_text().splitlines()
    assert [line for line in told if line in moves(100)] == moves(32)
    assert state["hotend_target_c"] == 0
    assert "heaters off" in printer.notes[-1]


def test_a_journal_is_made_whole_or_not_at_all(tmp_path: Path) -> None:
    # regression: killed between its tables and its version, it could never be opened again
    path = tmp_path / "journal.sqlite"
    said: list[str] = []
    original = sqlite3.connect

    class Watched(sqlite3.Connection):
        def executescript(self, script: str, /) -> sqlite3.Cursor:
            said.append(script)
            return super().executescript(script)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sqlite3, "connect", lambda *a, **k: original(*a, **k, factory=Watched))
        Journal(path).close()
    (script,) = said  # tables and version
    assert script.startswith("BEGIN IMMEDIATE;")
    assert script.endswith("PRAGMA user_version = 2; COMMIT;")
    Journal(path).close()


def test_a_journal_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.execute("CREATE TABLE job (id INTEGER)")
    with pytest.raises(JournalFileError, match="version 0"):
        Journal(path)


def test_a_file_that_is_no_journal_is_bad_input(tmp_path: Path) -> None:
    """regression: it passed for a fault of the link, exit code 4."""
    other = tmp_path / "part.stl"
    other.write_text("solid part\n" * 200)
    said = r"cannot be used \([^\[]*\); name another file"
    for path in (other, tmp_path, other / "journal"):
        with pytest.raises(JournalFileError, match=said) as told:
            Journal(path)
        assert told.value.exit_code == 2


class Occupied:
    """A server whose printer prints for somebody else."""

    def __init__(self) -> None:
        self.aborted = 0

    def connect(self) -> None:
        raise LinkError("The printer prints another job.")

    def abort(self) -> None:
        self.aborted += 1


def test_a_printer_that_refuses_us_is_not_ours_to_abort(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # regression: found in a merge; cancelling would have ended somebody else's print
    job, machine = tmp_path / "job.gcode", Occupied()
    job.write_text("G28\nG1 X10 Y10 Z5 F3000\n")
    monkeypatch.setattr("gcode.hosts.connect", lambda *_, **__: machine)
    with pytest.raises(LinkError, match="another job"):
        send(job, port="octoprint+http://nowhere", printer="generic_marlin")
    assert machine.aborted == 0


def test_who_will_not_wait_for_the_safe_exit_leaves_it_to_the_supervisor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Regression: a third Ctrl+C sent the supervisor home with a farewell, and the heaters on."""

    def interrupted() -> None:
        raise KeyboardInterrupt

    with EmulatedPrinterProcess(printer=profile()) as emulator:
        printer = SerialPrinter(emulator.port)
        printer.connect()
        printer.command("M104 S100")
        monkeypatch.setattr(printer, "_comes_to_rest", interrupted)
        monkeypatch.setattr(printer, "_go_past", interrupted)
        with pytest.raises(KeyboardInterrupt):
            printer.make_safe()
        helper = printer._supervisor
        assert helper is not None
        printer.close()
        with pytest.raises(PortBusyError):  # as long as the supervisor is at it
            SerialPrinter(emulator.port).connect()
        helper._process.wait(20)
        assert emulator.state()["hotend_target_c"] == 0
    assert "the supervisor goes on with it" in printer.notes[-1]


def test_an_interrupted_print_is_safe_whoever_called_it() -> None:
    """Regression: without a `with` around it, closing let go of a hot printer."""

    def interrupted(stage: str, done: float, total: float) -> None:
        if done > 0:
            raise KeyboardInterrupt

    with EmulatedPrinterProcess(printer=profile()) as emulator:
        printer = SerialPrinter(emulator.port, supervise=False)
        printer.connect()
        printer.command("M104 S100")
        with pytest.raises(KeyboardInterrupt):
            printer.print(program(moves(2000)), progress=interrupted)
        state = emulator.state()
        printer.close()
    assert state["hotend_target_c"] == 0
    assert "heaters off" in printer.notes[-1]
