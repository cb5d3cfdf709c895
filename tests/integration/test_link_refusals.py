"""Where it is not provable how to go on, it is refused, and what is known is said."""

from __future__ import annotations

import contextlib
import sqlite3
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_bench import BEADS, HEAD, LINES, Bench, notes
from link_forks import Forks, until

from gcode.hosts.journal import Journal


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    with Forks() as forks:
        yield forks


@pytest.fixture
def bench(forks: Forks, tmp_path: Path) -> Bench:
    return Bench(forks, tmp_path)


def test_motors_that_may_have_let_go_need_a_rescan_and_are_homed_anew(bench: Bench) -> None:
    bench.kill_after(bench.send(), 600)
    until(lambda: b"targets of 0" in notes(bench.journal))
    left_alone(bench.journal, 130.0)
    assert "lets go of its motors" in bench.go_on()["error"]
    # regression: what the refused attempt had noted was taken for a sign of life
    assert "was left alone for 13" in bench.go_on()["error"]
    before = bench.record.read_text()
    assert bench.go_on(pose_confirmed=True)["first_line"] > 600
    assert bench.executed() == BEADS
    again = bench.record.read_text().removeprefix(before).splitlines()
    lift = next(i for i, line in enumerate(again) if line.startswith("G1 Z"))
    assert again[lift : lift + 3] == [again[lift], "G90", "G28 X Y"]
    assert float(again[lift].split()[1][1:]) > 0, "away from the part before X and Y move"
    assert not any(line.startswith("G28") for line in again[lift + 3 :]), "never Z"


def left_alone(journal: Path, seconds: float) -> None:
    """Make everything that the journal holds so much older."""
    with contextlib.closing(sqlite3.connect(journal)) as db:
        for table in ("step", "note", "temperature"):
            db.execute(f"UPDATE {table} SET time_s = time_s - ?", (seconds,))
        db.execute("UPDATE job SET started_s = started_s - ?", (seconds,))
        db.commit()


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
    until(lambda: b"targets of 0" in notes(bench.journal))
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
    until(lambda: b"targets of 0" in notes(bench.journal))
    bench.say(b"M190 S60")
    assert "nobody noted how cold" in bench.go_on()["error"]


def test_a_nozzle_that_was_moved_is_refused(bench: Bench) -> None:
    bench.kill_after(bench.send(), 600)
    until(lambda: b"targets of 0" in notes(bench.journal))
    bench.say(b"G1 X1 Y1")
    assert "the nozzle is at X1 Y1" in bench.go_on()["error"]


def test_a_numbered_line_of_somebody_elses_is_noticed(bench: Bench) -> None:
    bench.kill_after(bench.send(), 600)
    until(lambda: b"targets of 0" in notes(bench.journal))
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


def test_a_place_that_fits_several_lines_is_refused(forks: Forks, tmp_path: Path) -> None:
    """Klipper counts no lines, and the job goes to and fro between two places."""
    bench = Bench(forks, tmp_path, firmware="klipper")
    bench.kill_after(bench.send(there_and_back=True), 300)
    told = bench.go_on(there_and_back=True)
    assert "the nozzle's place fits" in told["error"]
    assert told["executed"] - HEAD + 1 <= len(bench.executed()) <= told["sent"] - HEAD + 1
    assert told["sent"] - told["executed"] <= 17
