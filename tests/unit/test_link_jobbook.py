"""The journal is written before the wire, and an ok that a request takes back counts no more."""

from __future__ import annotations

import errno
import math
import os
import re
import sqlite3
import sys
from dataclasses import replace
from pathlib import Path
from typing import IO, cast

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from link_helpers import moves, profile, program

import gcode.hosts.serial as serial_host
from gcode.errors import InputError
from gcode.firmware import EmulatedPrinterProcess
from gcode.hosts.file import FilePrinter
from gcode.hosts.jobbook import JobBook
from gcode.hosts.journal import Journal
from gcode.protocol import LINK_DIALECTS, Link


def test_no_line_goes_out_before_the_disk_says_that_it_may(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At every write another connection to the journal already sees line and number reserved."""
    monkeypatch.setattr(serial_host, "require_checked", lambda checked: None)
    path = tmp_path / "journal.sqlite"
    lines = [*moves(300)]
    seen: list[int] = []
    with (
        EmulatedPrinterProcess(printer=profile()) as emulator,
        serial_host.SerialPrinter(
            emulator.port, journal=Journal(path, step_lines=64), supervise=False, guard=False
        ) as printer,
    ):
        reader = sqlite3.connect(path)
        write = os.write

        def watched(fd: int, data: bytes) -> int:
            match = re.match(rb"N(\d+) (.*)\*", data)
            if match is not None and (text := match.group(2).decode()) in lines:
                index = lines.index(text)
                line, number, reserved = reader.execute(
                    "SELECT line, number, reserved FROM step ORDER BY rowid DESC LIMIT 1"
                ).fetchone()
                assert line <= index < reserved
                assert int(match.group(1)) == number + index - line
                seen.append(index)
            return write(fd, data)

        monkeypatch.setattr(os, "write", watched)
        report = printer.print(program(lines))
        monkeypatch.undo()
        reader.close()
    assert report.ok
    assert seen == list(range(len(lines)))


def test_an_ok_that_is_taken_back_is_not_called_executed() -> None:
    # regression: a lost link named lines as acknowledged that the printer had asked for again
    link = Link()
    link.hello(0.0)
    link.receive(b"ok\n", 0.0)
    book = JobBook(link, None, lambda: 0.0)
    book.open(program(["G1"] * 20), 10, 20)
    for index in (10, 12, 13):
        book.before_line(index)
        link.send(f"G1 X{index}", 0.0)
        link.receive(b"ok\n", 0.0)
    assert (book.executed_line, book.last_sent_line, book.lines_acked) == (13, 13, 3)
    link.receive(b"Error:checksum mismatch\nResend: 2\n", 1.0)  # an earlier ok was a spare one
    assert (book.executed_line, book.last_sent_line, book.lines_acked) == (10, 13, 1)
    link.give_up("the cable was pulled")
    assert (book.executed_line, book.last_sent_line) == (10, 13)


@pytest.mark.parametrize(("dialect", "known"), [("marlin", 20), ("klipper", 9)])
@pytest.mark.parametrize("said", ["Error:Printer halted. kill() called!", "start"])
def test_what_waited_in_a_stopped_printers_buffers_is_not_called_executed(
    dialect: str, known: int, said: str
) -> None:
    """Regression: what was acknowledged was; a Klipper acknowledges what it has yet to move."""
    few = {"buffered_lines": 40} if dialect == "marlin" else {}
    link = Link(replace(LINK_DIALECTS[dialect], **few))
    link.hello(0.0)
    link.receive(b"ok\n", 0.0)
    book = JobBook(link, None, lambda: 0.0)
    book.open(program(["; comment", "G1 X1"] * 60), 10, 120)
    for index in range(11, 101, 2):
        book.before_line(index)
        link.send(f"G1 X{index}", 0.0)
        link.receive(b"ok\n", 0.0)
    assert book.executed_line == 99
    link.receive(said.encode() + b"\n", 1.0)
    assert book.executed_line == known


def test_before_the_first_line_nothing_is_executed() -> None:
    book = JobBook(Link(), None, lambda: 0.0)
    book.open(program([]), 5, 9)
    assert (book.executed_line, book.last_sent_line, book.lines_acked) == (4, 4, 0)


def test_a_file_says_which_part_it_took(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # regression: every adapter but the serial one reported line 0 as its first
    monkeypatch.setattr("gcode.hosts.file.require_checked", lambda checked: None)
    with FilePrinter(tmp_path / "part.gcode") as printer:
        report = printer.print(program(moves(9)), lines=range(3, 6))
    assert (report.first_line, report.next_line, report.lines_acked) == (3, 6, 3)


class _Full:
    """A file on a disk without room: it tells when it is flushed, and again when it is closed."""

    def write(self, line: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def close(self) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("written", [False, True])
def test_what_cannot_be_written_is_told_of_the_file_and_leaves_none(
    written: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """regression: it was told of a temporary file, which stayed."""
    monkeypatch.setattr("gcode.hosts.file.require_checked", lambda checked: None)
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="folder cannot be written: it is a folder"):
        FilePrinter(tmp_path / "folder").connect()
    printer = FilePrinter(tmp_path / "part.gcode")
    printer.connect()
    assert printer._file is not None
    printer._file.close()
    printer._file = cast("IO[str]", _Full())
    with pytest.raises(InputError, match=r"part\.gcode cannot be written \(No space"):
        printer.print(program(moves(9))) if written else printer.close()
    printer.close()
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_a_file_is_the_program_and_nothing_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # regression: after the last newline a further, empty line was written
    monkeypatch.setattr("gcode.hosts.file.require_checked", lambda checked: None)
    job = program([*moves(3), "; end"])
    for name, parts in (("whole", (None,)), ("parts", (range(2), range(2, 5)))):
        with FilePrinter(tmp_path / name) as printer:
            reports = [printer.print(job, lines=part) for part in parts]
        assert (tmp_path / name).read_text() == job.program.text
        assert reports[-1].next_line == 4


def test_a_clock_that_was_set_back_tells_no_silence(tmp_path: Path) -> None:
    """Regression: one that began anew, as a Raspberry Pi's, had the printer left alone for 0 s."""
    now_s = [10_000.0]
    journal = Journal(tmp_path / "journal.sqlite", clock=lambda: now_s[0])
    journal.open_session()
    journal.begin("0" * 64, "/dev/ttyACM0", 0, 9)
    journal.reserve(0, 1, 9, 0)
    for later_s, silence_s in ((40.0, 40.0), (0.0, 0.0), (-1.0, 0.0), (-3600.0, math.inf)):
        assert journal.longest_silence_s(now_s[0] + later_s) == silence_s
    journal.close()
