"""The wire log and the counters."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))
from link_forks import ROOT

from gcode.hosts.telemetry import RoundTrips
from gcode.hosts.wirelog import FLUSH_ENTRIES, WireLog
from tests.commands import here


def test_the_log_turns_over_and_keeps_the_latest(tmp_path: Path) -> None:
    log = WireLog(tmp_path / "wire.log", max_bytes=200_000, keep=2)
    count = 12 * FLUSH_ENTRIES
    for i in range(count):
        log.add(i * 1e-5, b">", b"N%d G1 X%d*1\n" % (i, i))
    log.close()
    files = sorted(tmp_path.iterdir())
    assert [file.name for file in files] == ["wire.log", "wire.log.1", "wire.log.2"]
    assert all(file.stat().st_size <= 200_000 for file in files)
    text = b"".join(file.read_bytes() for file in reversed(files))
    numbers = [int(row.split()[2][1:]) for row in text.splitlines()]
    assert numbers == list(range(numbers[0], count))  # nothing lost or out of order in between
    times = [float(row.split()[0]) for row in text.splitlines()]
    assert times == sorted(times)


def test_a_log_goes_on_where_an_earlier_one_ended(tmp_path: Path) -> None:
    for word in (b"ok one\n", b"ok two\n"):
        log = WireLog(tmp_path / "wire.log", epoch_s=1000.0)
        log.add(1.5, b"<", word)
        log.close()
    assert (tmp_path / "wire.log").read_bytes() == b"1001.500000 < ok one\n1001.500000 < ok two\n"


def test_what_was_said_a_second_ago_is_on_the_disk(tmp_path: Path) -> None:
    """A killed sender leaves its log behind but for the last second."""
    log = WireLog(tmp_path / "wire.log")
    log.add(10.0, b">", b"G28\n")
    log.add(11.1, b"<", b"ok\n")
    assert (tmp_path / "wire.log").read_bytes().count(b"\n") == 2
    log.close()


def test_noise_and_several_lines_make_one_row_each(tmp_path: Path) -> None:
    log = WireLog(tmp_path / "wire.log")
    log.add(1.0, b"<", b"ok\nT:1\n\xff\x00\n")
    log.close()
    assert (tmp_path / "wire.log").read_bytes() == b"1.000000 < ok\\nT:1\\n\xff\x00\n"


@given(st.lists(st.floats(2e-6, 200.0), min_size=1, max_size=300))
def test_percentiles_are_right_to_five_percent(trips_s: list[float]) -> None:
    trips = RoundTrips()
    trips.add(trips_s[:100])
    trips.add(trips_s[100:])
    for percent in (50.0, 95.0, 99.0):
        true_s = float(np.percentile(trips_s, percent, method="inverted_cdf"))
        assert trips.percentile_s(percent) == pytest.approx(true_s, rel=0.05)
    assert trips.count == len(trips_s)


def test_no_trips_no_percentiles() -> None:
    assert RoundTrips().summary_s() == (0.0, 0.0, 0.0)


def test_the_command_line_tells_counters_and_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    job, wire = tmp_path / "job.gcode", tmp_path / "wire.log"
    lines = ["M190 S60", "M109 S205", "G28", "G90", "M83", "G1 Z5 F600"]
    lines += [f"G1 X{50 + i % 90} Y{60 + i % 7} F6000" for i in range(300)]
    job.write_text("\n".join([*lines, "M104 S0", "M140 S0", ""]))
    faults = tmp_path / "faults.txt"
    faults.write_text("# a bad cable\nevery 40 corrupt_in\nline 150 garble_ok\n")
    before_s = time.time()
    program = [sys.executable, "-W", "ignore", "-c", "from gcode.cli import main; main()"]
    printer = ["--printer", "generic_marlin"]
    with subprocess.Popen(
        [*program, "emulate", *printer, "--faults", str(faults), "--accelerated"],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    ) as emulator:
        assert emulator.stdout is not None
        port = emulator.stdout.readline().strip()
        words = ["send", str(job), "--port", port, *printer, "--window", "1"]
        words += ["--wire-log", str(wire), "--json"]
        done = here(*words, program="gcode")
        emulator.send_signal(signal.SIGINT)
    assert emulator.returncode == 0
    assert not Path(port).exists()
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["lines_acked"] == len(lines) + 2
    assert told["resends"] >= 7
    assert told["stalls"] == 1
    assert told["bytes_sent"] > 300 * 20
    trip = told["round_trip_ms"]
    assert 0 < trip["p50"] <= trip["p95"] <= trip["p99"]
    rows = wire.read_bytes().splitlines()
    assert before_s <= float(rows[0].split()[0]) <= time.time()
    assert sum(b"Resend: " in row for row in rows) >= 7
    assert len(list((tmp_path / "gcode").iterdir())) >= 1  # the journal, where nobody named one


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no disk without room to write on")
def test_a_full_disk_ends_the_log_and_not_the_print(caplog: pytest.LogCaptureFixture) -> None:
    """Regression: a print, and then its safe exit, ended in the error of its log."""
    log = WireLog(Path("/dev/full"))
    for now_s in (0.0, 10.0, 20.0):
        log.add(now_s, b">", b"M104 S0\n")
        log.flush()
    log.close()
    assert caplog.text.count("the wire log /dev/full ends here: No space left on device") == 1
