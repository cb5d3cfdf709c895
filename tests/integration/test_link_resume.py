"""A job ended by a crash goes on where that is provable."""

from __future__ import annotations

import functools
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_bench import BEADS, HEAD, Bench, notes
from link_children import job_lines
from link_forks import Forks, until

from gcode.cli import main
from gcode.hosts.journal import Journal
from tests.commands import here


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    with Forks() as forks:
        yield forks


@pytest.fixture
def bench(forks: Forks, tmp_path: Path) -> Bench:
    return Bench(forks, tmp_path)


@pytest.mark.parametrize("firmware", ["marlin", "prusa"])
def test_a_killed_sender_is_gone_on_from_and_every_line_runs_once(
    firmware: str, forks: Forks, tmp_path: Path
) -> None:
    bench = Bench(forks, tmp_path, firmware=firmware)
    for attempt, beads in enumerate((400, 500, 600, 700)):
        bench.kill_after(bench.send(go_on=attempt > 0), beads)
    told = bench.go_on()
    assert told["first_line"] > 2200
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


def test_a_bad_line_and_kills_together_lose_nothing(forks: Forks, tmp_path: Path) -> None:
    faults = "every 37 corrupt_in\nevery 53 garble_ok\nevery 71 noise_out\nevery 97 double_ok"
    bench = Bench(forks, tmp_path, lines=500, faults=faults + "\nalways resend_without_ok")
    for attempt, beads in enumerate((150, 150)):
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
    until(lambda: b"targets of 0" in notes(bench.journal))


def test_a_pulled_cable_is_gone_on_from(forks: Forks, tmp_path: Path) -> None:
    bench = Bench(forks, tmp_path, faults="line 800 disconnect s=0.1")
    assert bench.forks.wait(bench.send()) == 4
    lost = bench.told()
    assert lost["executed"] - HEAD + 1 <= len(bench.executed()) <= lost["sent"] - HEAD + 1
    until(bench.port.exists)
    bench.go_on()
    assert bench.executed() == BEADS


@pytest.mark.parametrize("firmware", ["klipper", "reprap"])
def test_firmware_that_counts_no_lines_is_asked_for_its_place(
    firmware: str, forks: Forks, tmp_path: Path
) -> None:
    """One line at most is in doubt, and where the nozzle is decides."""
    bench = Bench(forks, tmp_path, firmware=firmware, lines=1200)
    bench.kill_after(bench.send(), 300)
    bench.kill_after(bench.send(go_on=True), 400)
    assert bench.go_on()["first_line"] > 700
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


def test_the_command_line_goes_on_after_a_kill(
    forks: Forks,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bench = Bench(forks, tmp_path, lines=1200)
    file = bench.folder / "job.gcode"
    file.write_text("\n".join([*job_lines(bench.lines), "M107"]) + "\n")
    words = ["send", str(file), "--port", str(bench.port), "--printer", "generic_marlin"]
    words += ["--journal", str(bench.journal), "--json"]
    code = "from gcode.cli import main; main()"
    command = [sys.executable, "-W", "ignore", "-c", code, *words]
    first = subprocess.Popen(command, stdout=subprocess.PIPE)
    until(lambda: len(bench.executed()) > 400)
    first.kill()
    first.communicate()
    assert first.returncode == -signal.SIGKILL
    until(lambda: b"targets of 0" in notes(bench.journal))
    done = here(*words, "--resume", program="gcode")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["ok"]
    assert told["first_line"] > 400
    assert told["lines_acked"] == bench.lines + HEAD + 3 - told["first_line"]
    assert 0 < told["round_trip_ms"]["p50"] <= told["round_trip_ms"]["p99"]
    assert bench.executed() == bench.beads
    monkeypatch.setattr(sys, "argv", ["gcode", *words, "--resume"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 4
    again = capsys.readouterr().err.strip().splitlines()
    assert "printed to its end" in again[-1]
    assert bench.executed() == bench.beads
