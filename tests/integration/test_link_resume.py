"""A job ended by a crash goes on where that is provable; else it says what is known."""

from __future__ import annotations

import functools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_children import beads_of, job_lines
from link_forks import Forks, until

from gcode.hosts.journal import Journal

LINES = 6000
BEADS = beads_of("\n".join(job_lines(LINES)))
HEAD = len(job_lines(0)) - 2
assert len(set(BEADS)) == LINES


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    with Forks() as forks:
        yield forks


class Bench:
    """A printer, a journal, and one sender after another."""

    def __init__(self, forks: Forks, folder: Path, *, lines: int = LINES, **printer: Any) -> None:
        self.lines, self.beads = lines, BEADS[:lines]
        self.forks, self.folder = forks, folder
        self.port, self.journal = folder / "port", folder / "journal.sqlite"
        self.record, self.outcome = folder / "executed", folder / "outcome"
        self.dialect = printer.get("firmware", "marlin")
        self.printer = forks.printer(self.port, self.record, **printer)

    def send(self, **options: Any) -> int:
        self.outcome.unlink(missing_ok=True)
        return self.forks.sender(
            self.port,
            self.journal,
            outcome=str(self.outcome),
            lines=self.lines,
            dialect=self.dialect,
            **options,
        )

    def executed(self) -> list[str]:
        return beads_of(self.record.read_text()) if self.record.exists() else []

    def kill_after(self, sender: int, beads: int) -> None:
        """Kill the sender once the printer has executed so many beads."""
        until(lambda: len(self.executed()) >= beads)
        assert self.forks.kill(sender) == -signal.SIGKILL

    def heated(self, times: int) -> bool:
        return self.record.read_text().splitlines().count("M109 S205") >= times

    def told(self) -> Any:
        return json.loads(self.outcome.read_text())

    def go_on(self, **options: Any) -> Any:
        status = self.forks.wait(self.send(go_on=True, **options))
        told = self.told()
        assert (status == 0) == ("error" not in told), told
        assert status in (0, 4), told
        return told

    def say(self, *lines: bytes) -> None:
        """Somebody types at the printer, without line numbers."""
        fd = os.open(self.port, os.O_RDWR | os.O_NOCTTY)
        os.write(fd, b"".join(line + b"\n" for line in lines) + b"M118 done\n")
        until(lambda: self.record.read_text().endswith("M118 done\n"))
        os.close(fd)


@pytest.fixture
def bench(forks: Forks, tmp_path: Path) -> Bench:
    return Bench(forks, tmp_path)


def test_a_killed_sender_is_gone_on_from_and_every_line_runs_once(bench: Bench) -> None:
    for attempt, beads in enumerate((700, 1500, 2500, 4000)):
        bench.kill_after(bench.send(go_on=attempt > 0), beads)
    told = bench.go_on()
    assert told["first_line"] > 4000
    assert bench.executed() == BEADS
    record = bench.record.read_text().splitlines()
    assert record.count("M109 S205") == 5  # heated anew each time
    # Back at the part: not lifted, the extruder relative, as the job had it.
    again = record.index(BEADS[told["first_line"] - HEAD]) - 1
    assert record[again - 2 : again + 1] == ["G1 F6000", "M83", "M105"]
    assert "finished" in str(Journal(bench.journal).latest())


def test_a_sender_killed_while_it_gets_ready_to_go_on_loses_nothing(bench: Bench) -> None:
    bench.kill_after(bench.send(), 500)
    for count in (2, 3):  # in the middle of its heating, before the journal has a new job
        sender = bench.send(go_on=True)
        until(functools.partial(bench.heated, count))
        bench.forks.kill(sender)
    bench.go_on()
    assert bench.executed() == BEADS


def test_a_sender_killed_in_a_pause_is_gone_on_from(bench: Bench) -> None:
    """Its questions and its lift have wire numbers, too, that are no program lines."""
    sender = bench.send(pause=True)
    until(lambda: bench.record.exists() and "G1 Z5 F600" in bench.record.read_text())
    until(lambda: bench.record.read_text().count("M105") > 2)
    bench.forks.kill(sender)
    bench.go_on()
    assert bench.executed() == BEADS


def test_motors_that_may_have_let_go_need_a_rescan(bench: Bench) -> None:
    bench.kill_after(bench.send(), 600)
    assert "lets go of its motors" in bench.go_on(later_s=130.0)["error"]
    assert bench.go_on(later_s=130.0, pose_confirmed=True)["first_line"] > 600
    assert bench.executed() == BEADS


def test_a_bad_line_and_kills_together_lose_nothing(forks: Forks, tmp_path: Path) -> None:
    faults = "every 37 corrupt_in\nevery 53 garble_ok\nevery 71 noise_out\nevery 97 double_ok"
    bench = Bench(forks, tmp_path, lines=1500, faults=faults + "\nalways resend_without_ok")
    for attempt, beads in enumerate((300, 600, 900)):
        bench.kill_after(bench.send(go_on=attempt > 0), beads)
    bench.go_on()
    assert bench.executed() == bench.beads


def test_heaters_go_off_even_while_the_printer_waits_for_them(forks: Forks, tmp_path: Path) -> None:
    """In real time: M109 takes minutes, and what comes after it would have to wait."""
    bench = Bench(forks, tmp_path, accelerated=False)
    sender = bench.send()
    until(lambda: bench.record.exists() and "M190 S60" in bench.record.read_text())
    died_s = time.monotonic()
    bench.forks.kill(sender)
    until(lambda: bench.record.read_text().count("M140 S0") >= 1)
    assert time.monotonic() - died_s < 5.0  # the stated time
    assert "M104 S0" in bench.record.read_text()
    until(lambda: b"targets of 0" in _notes(bench.journal))


def test_a_pulled_cable_is_gone_on_from(forks: Forks, tmp_path: Path) -> None:
    bench = Bench(forks, tmp_path, faults="line 800 disconnect s=0.1")
    assert bench.forks.wait(bench.send()) == 4
    lost = bench.told()
    assert lost["executed"] - HEAD + 1 <= len(bench.executed()) <= lost["sent"] - HEAD + 1
    until(bench.port.exists)
    bench.go_on()
    assert bench.executed() == BEADS


@pytest.mark.parametrize("how", ["reset", "silent_reset", "killed"])
def test_a_printer_that_was_reset_is_refused_with_the_true_interval(
    how: str, forks: Forks, tmp_path: Path
) -> None:
    faults = "" if how == "killed" else f"line 900 {how}"
    bench = Bench(forks, tmp_path, faults=faults)
    sender = bench.send()
    if how == "killed":
        until(lambda: len(bench.executed()) > 800)
        bench.forks.kill(bench.printer)
        bench.printer = forks.printer(tmp_path / "port2", bench.record)
        (tmp_path / "port2").replace(bench.port)
    assert bench.forks.wait(sender) == 4
    before = len(bench.executed())
    told = bench.go_on()
    assert "reset" in told["error"]
    # Lines counted from 0; executed as the firmware read it, moved at most 80 lines later.
    assert told["executed"] - HEAD + 1 <= before - 64 < before <= told["sent"] - HEAD + 1
    assert told["sent"] - told["executed"] < 64 + 80 + 4
    assert f"up to {told['executed'] + 1} are executed" in told["error"]
    assert bench.executed() == BEADS[:before]
    assert "Now: heaters off (the printer reports targets of 0)" in told["error"]
    # It stays refused: the first attempt has not made the printer look as if it knew.
    assert "reset" in bench.go_on()["error"]
    assert bench.executed() == BEADS[:before]


def test_a_bed_that_was_cold_needs_a_rescan(bench: Bench) -> None:
    bench.kill_after(bench.send(), 600)
    until(lambda: b"targets of 0" in _notes(bench.journal))
    bench.say(b"M140 S0", b"G4 S3600")
    told = bench.go_on()
    assert "the bed fell to 22" in told["error"]
    assert "below the 40" in told["error"]
    assert "--pose-confirmed" in told["error"]
    assert "Now: heaters off (the printer reports targets of 0)" in told["error"]
    # Warming it up again changes nothing: the journal remembers.
    bench.say(b"M190 S60")
    assert "the bed fell to 22" in bench.go_on()["error"]
    assert len(bench.executed()) < LINES
    assert bench.go_on(pose_confirmed=True)["first_line"] > 600
    assert bench.executed() == BEADS


def test_a_bed_switched_off_and_on_while_nobody_looked_needs_a_rescan(bench: Bench) -> None:
    bench.kill_after(bench.send(), 600)
    until(lambda: b"targets of 0" in _notes(bench.journal))
    bench.say(b"M190 S60")
    assert "nobody noted how cold" in bench.go_on()["error"]


def test_a_nozzle_that_was_moved_is_refused(bench: Bench) -> None:
    bench.kill_after(bench.send(), 600)
    until(lambda: b"targets of 0" in _notes(bench.journal))
    bench.say(b"G1 X1 Y1")
    assert "the nozzle is at X1 Y1" in bench.go_on()["error"]


def test_a_numbered_line_of_somebody_elses_is_noticed(bench: Bench) -> None:
    bench.kill_after(bench.send(), 600)
    until(lambda: b"targets of 0" in _notes(bench.journal))
    bench.say(b"M110 N70")
    assert "somebody else has spoken to it" in bench.go_on()["error"]


def test_what_there_is_nothing_to_go_on_with_is_refused(bench: Bench) -> None:
    assert "no journal" in bench.go_on()["error"]
    assert bench.forks.wait(bench.send()) == 0
    assert "printed to its end" in bench.go_on()["error"]
    journal = Journal(bench.journal)
    journal.begin("another", str(bench.port), 0, 10)
    journal.close()
    assert "another program" in bench.go_on()["error"]
    assert bench.executed() == BEADS


@pytest.mark.parametrize("firmware", ["klipper", "reprap"])
def test_firmware_that_counts_no_lines_is_asked_for_its_place(
    firmware: str, forks: Forks, tmp_path: Path
) -> None:
    """One line at most is in doubt, and where the nozzle is decides."""
    bench = Bench(forks, tmp_path, firmware=firmware, lines=1200)
    bench.kill_after(bench.send(), 300)
    bench.kill_after(bench.send(go_on=True), 900)
    assert bench.go_on()["first_line"] > 900
    assert bench.executed() == bench.beads
    (tmp_path / "b").mkdir()
    bench = Bench(forks, tmp_path / "b", firmware=firmware)
    bench.kill_after(bench.send(), 300)
    bench.forks.kill(bench.printer)  # and its host, too
    bench.printer = forks.printer(tmp_path / "port2", bench.record, firmware=firmware)
    (tmp_path / "port2").replace(bench.port)
    told = bench.go_on()
    assert "counts no lines" in told["error"]
    assert told["executed"] <= len(bench.executed()) + HEAD <= told["sent"] + 2


def test_the_command_line_goes_on_after_a_kill(bench: Bench) -> None:
    file = bench.folder / "job.gcode"
    file.write_text("\n".join([*job_lines(LINES), "M107"]) + "\n")
    words = ["send", str(file), "--port", str(bench.port), "--printer", "generic_marlin"]
    words += ["--journal", str(bench.journal), "--json"]
    code = "from gcode.cli import main; main()"
    command = [sys.executable, "-W", "ignore", "-c", code, *words]
    first = subprocess.Popen(command, stdout=subprocess.PIPE)
    until(lambda: len(bench.executed()) > 1000)
    first.kill()
    first.communicate()
    assert first.returncode == -signal.SIGKILL
    until(lambda: b"targets of 0" in _notes(bench.journal))
    done = subprocess.run(
        [*command, "--resume"], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["ok"]
    assert told["first_line"] > 1000
    assert told["lines_acked"] == LINES + HEAD + 3 - told["first_line"]
    assert 0 < told["round_trip_ms"]["p50"] <= told["round_trip_ms"]["p99"]
    assert bench.executed() == BEADS
    again = subprocess.run(
        [*command, "--resume"], capture_output=True, text=True, timeout=120, check=False
    )
    assert again.returncode == 4
    assert "printed to its end" in again.stderr
    assert len(again.stderr.strip().splitlines()) == 1
    assert bench.executed() == BEADS


def _notes(journal: Path) -> bytes:
    book = Journal(journal)
    try:
        return "\n".join(book.notes()).encode()
    finally:
        book.close()
