"""Every way out of a job that heats several heads leaves all of them off, and every way back in
heats those that were on.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from link_forks import until
from link_helpers import moves, profile, program
from test_hosts_moonraker import FakeMoonraker
from test_hosts_moonraker import printer_at as moonraker_at
from test_hosts_octoprint import FakeOctoPrint
from test_hosts_octoprint import printer_at as octoprint_at
from test_link_safety import answering
from test_octoprint_plugin import HOLD_PATIENCE_S, JOB, LOOK, Wire

import gcode.hosts.serial as serial_host
from gcode.firmware import EmulatedPrinterProcess
from gcode.hosts.journal import Journal
from gcode.hosts.port import LinkLostError
from gcode.hosts.resume import resume
from gcode.hosts.serial import SerialPrinter

HOT = ["M104 T1 S180", "M104 T0 S200", "M140 S60", "M109 T1 S180", "G28", "T1", "G1 Z2 F600", "M83"]
PROFILE = profile().model_copy(update={"heads": 3})


@pytest.fixture(autouse=True)
def _no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_host, "require_checked", lambda checked: None)


def targets(emulator: EmulatedPrinterProcess) -> object:
    return emulator.state()["hotend_targets_c"]


@pytest.mark.parametrize("firmware", ["marlin", "klipper", "reprap"])
def test_an_abort_in_the_middle_leaves_every_head_off(firmware: str) -> None:
    """regression: M104 S0 switched the head off that was chosen, and the others stayed hot."""
    lines = [*HOT, *moves(3000)]
    with EmulatedPrinterProcess(printer=PROFILE, firmware=firmware) as emulator:
        with SerialPrinter(emulator.port, dialect=firmware, supervise=False) as printer:

            def stop(stage: str, done: float, total: float) -> None:
                if done > 100:
                    assert targets(emulator) == [200, 180, 0]
                    printer.abort()

            report = printer.print(program(lines), progress=stop)
            assert not report.ok
            assert printer.notes[-1].startswith("heaters off (the printer reports targets of 0)")
        assert targets(emulator) == [0, 0, 0]


def test_heaters_that_are_asked_to_go_off_all_do() -> None:
    with (
        EmulatedPrinterProcess(printer=PROFILE) as emulator,
        SerialPrinter(emulator.port, supervise=False) as printer,
    ):
        for line in ("M104 T2 S100", "M104 S90", "T1", "M104 S80", "M140 S50"):
            printer.command(line)
        there = printer.temperatures()
        assert (there.hotend_target_c, there.hotend_targets_c) == (80, (90, 80, 100))
        printer.heaters_off()
        assert targets(emulator) == [0, 0, 0]
        assert emulator.state()["bed_target_c"] == 0


@pytest.mark.parametrize("firmware", ["marlin", "klipper"])
def test_a_killed_sender_s_supervisor_switches_every_head_off(firmware: str) -> None:
    with EmulatedPrinterProcess(printer=PROFILE, firmware=firmware) as emulator:
        pid = os.fork()
        if pid == 0:
            printer = SerialPrinter(emulator.port, dialect=firmware)
            printer.connect()
            for line in ("M104 T2 S100", "M104 T0 S90", "T1"):
                printer.command(line)
            os.kill(os.getpid(), signal.SIGKILL)
        os.waitpid(pid, 0)
        until(lambda: targets(emulator) == [0, 0, 0])


@pytest.mark.parametrize(
    ("reports", "off"),
    [
        (
            [b"ok T:9 /0 B:9 /0 T0:201 /200 T1:9 /0\n"] * 2
            + [b"ok T:9 /0 B:9 /0 T0:201 /0 T1:9 /0\n"] * 2,
            True,
        ),
        ([b"ok T:9 /0 B:9 /0 T0:9 /0 T1:201 /200\n"] * 9, False),
    ],
)
def test_heads_that_the_printer_tells_of_at_the_end_are_not_forgotten(
    reports: list[bytes], off: bool
) -> None:
    """regression: of several targets the last was believed."""
    said, heard = answering(iter(reports))
    assert ("heaters off" in said) == off
    assert (b"M104 T0 S0" if off else b"M104 T1 S0") in heard


def test_a_job_that_is_gone_on_with_finds_every_head_hot(tmp_path: Path) -> None:
    lines, told = [*HOT, *moves(3000)], tmp_path / "executed"
    job, journal = program(lines), Journal(tmp_path / "journal.sqlite")
    with EmulatedPrinterProcess(printer=PROFILE, record=told) as emulator:

        def lose(stage: str, done: float, total: float) -> None:
            if done > 100:
                raise LinkLostError("gone", 0, 0)

        printer = SerialPrinter(emulator.port, journal=journal, supervise=False)
        with pytest.raises(LinkLostError), printer:
            printer.print(job, progress=lose)
        assert targets(emulator) == [0, 0, 0]
        with SerialPrinter(emulator.port, journal=journal, supervise=False) as printer:
            seen: list[object] = []

            def look(stage: str, done: float, total: float) -> None:
                seen.append(seen or targets(emulator))

            resume(printer, job, release_c=40.0, pose_confirmed=True, progress=look)
        assert seen[0] == [200, 180, 0]
    again = told.read_text().splitlines()[-3100:]
    assert again.index("M109 T0 S200") < again.index("M109 S180")


def test_octoprint_is_told_to_switch_each_head_off() -> None:
    fake = FakeOctoPrint()
    fake.heaters = {f"tool{k}": {"actual": 20.0, "target": 10.0 * k} for k in range(3)}
    with fake.server, octoprint_at(fake) as printer:
        there = printer.temperatures()
        assert (there.hotend_target_c, there.hotend_targets_c) == (20.0, (0.0, 10.0, 20.0))
        printer.heaters_off()
    assert fake.commands[-3:] == ["M104 T0 S0", "M104 T1 S0", "M104 T2 S0"]


def test_moonraker_tells_of_the_head_that_is_chosen() -> None:
    fake = FakeMoonraker()
    fake.objects["extruder1"] = {"temperature": 180.1, "target": 180.0}
    fake.objects["heaters"] = {"available_heaters": ["heater_bed", "extruder", "extruder1"]}
    fake.objects["toolhead"]["extruder"] = "extruder1"
    with fake.server, moonraker_at(fake) as printer:
        there = printer.temperatures()
    assert (there.hotend_c, there.hotend_target_c) == (180.1, 180.0)
    assert there.hotend_targets_c == (205.0, 180.0)


class Heads(Wire):
    """A printer with two heads behind OctoPrint."""

    def __init__(self) -> None:
        super().__init__()
        self.targets = [210.0, 170.0, 60.0]
        self.chosen = 0

    def _execute(self, line: str) -> None:
        self.executed.append(line)
        name, *words = line.split()
        told = {word[0]: float(word[1:]) for word in words if word[0] in "ST"}
        if name in ("M104", "M109"):
            self.targets[int(told.get("T", self.chosen))] = told["S"]
        elif name in ("M140", "M190"):
            self.targets[-1] = told["S"]


def test_heads_that_wait_too_long_at_a_look_go_off_and_on_again() -> None:
    wire = Heads().begin()
    wire.now_s = HOLD_PATIENCE_S + 1
    wire.held.tick()
    wire.settle()
    assert wire.targets == [0.0, 0.0, 0.0]
    wire.held.press({"what": "pass"})
    wire.settle()
    assert wire.targets == [210.0, 170.0, 60.0]
    first = wire.executed.index("M190 S60")
    assert wire.executed[first:] == [
        "M190 S60", "M104 T0 S210", "M104 T1 S170", "M109 T0 S210", "M109 T1 S170", "M400",
        *JOB[LOOK:],
    ]  # fmt: skip
