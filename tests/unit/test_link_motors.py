"""Motors are held over long waits, or the job is not gone on with: let go, the place is lost."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from link_helpers import moves, print_with_a_pause, profile, program

import gcode.hosts.serial as serial_host
from gcode.errors import PrinterError
from gcode.firmware import EmulatedPrinterProcess, FirmwareCore
from gcode.hosts.port import PrintReport
from gcode.hosts.serial import SerialPrinter

MOVES = moves(1100)
LINES = ["G28", "M83", *MOVES]


@pytest.fixture(autouse=True)
def _no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_host, "require_checked", lambda checked: None)


def idle_for(seconds: float, *before: str, firmware: str = "marlin") -> tuple[FirmwareCore, bytes]:
    """A printer that has moved, rested and moved again; and what it said to the last move."""
    core = FirmwareCore(profile(), firmware)
    core.power_up()
    for command in ("G28", *before, "G1 X10 F6000", "M400"):
        core.feed(command.encode() + b"\n")
        core.run()
    core.pass_time(core.machine.clock_s + seconds)
    core.take_output()
    core.feed(b"G1 X20\n")
    core.run()
    return core, core.take_output()


@pytest.mark.parametrize(
    ("firmware", "before", "seconds", "let_go"),
    [
        ("marlin", (), 110.0, 0),
        ("marlin", (), 130.0, 1),
        ("marlin", ("M84 S0",), 1e6, 0),
        ("marlin", ("M84 S10",), 11.0, 1),
        ("prusa", ("M84 S0",), 1e6, 0),
        ("klipper", (), 590.0, 0),
        ("klipper", (), 610.0, 1),
        ("reprap", (), 1e6, 0),
    ],
)
def test_the_emulated_firmwares_let_go_of_their_motors(
    firmware: str, before: tuple[str, ...], seconds: float, let_go: int
) -> None:
    core, said = idle_for(seconds, *before, firmware=firmware)
    assert core.machine.let_go == let_go
    assert (b"!! Must home" in said) == (firmware == "klipper" and let_go == 1)


def test_heating_keeps_the_motors_on() -> None:
    core, _ = idle_for(100.0, "M190 S110", "M109 S260")
    assert core.machine.let_go == 0


def print_with_a_rest(printer: SerialPrinter, rest_s: float, late_s: list[float]) -> PrintReport:
    """Pause on the way, let the host's clock go on by `rest_s`, and go on."""
    return print_with_a_pause(printer, LINES, lambda: late_s.__setitem__(0, rest_s))


def test_a_pause_holds_the_motors_for_good(tmp_path: Path) -> None:
    record = tmp_path / "record"
    with EmulatedPrinterProcess(printer=profile(), record=record) as emulator:
        with SerialPrinter(emulator.port, supervise=False) as printer:
            assert print_with_a_rest(printer, 0.0, [0.0]).ok
        told = record.read_text().splitlines()
        assert emulator.state()["motors_let_go"] == 0
    lifted, held = told.index("G1 Z5 F600"), told.index("M84 S0")
    assert lifted < held < len(told) - 3
    assert [line for line in told if line in MOVES] == MOVES


def test_what_comes_between_two_parts_may_take_its_time(tmp_path: Path) -> None:
    record = tmp_path / "record"
    with (
        EmulatedPrinterProcess(printer=profile(), record=record) as emulator,
        SerialPrinter(emulator.port, supervise=False) as printer,
    ):
        printer.print(program(LINES), lines=range(10))
        assert "M84 S0" in record.read_text().splitlines()[-3:]
        printer.print(program(LINES), lines=range(10, len(LINES) + 1))
        assert record.read_text().count("M84 S0") == 1, "after the last part nothing is waited for"


@pytest.mark.parametrize(("rest_s", "goes_on"), [(300.0, True), (500.0, False)])
def test_where_the_motors_cannot_be_held_a_long_pause_ends_the_job(
    rest_s: float, goes_on: bool, tmp_path: Path
) -> None:
    record, late_s = tmp_path / "record", [0.0]
    with (
        EmulatedPrinterProcess("klipper", printer=profile(), record=record) as emulator,
        SerialPrinter(
            emulator.port,
            dialect="klipper",
            supervise=False,
            clock=lambda: time.monotonic() + late_s[0],
        ) as printer,
    ):
        if goes_on:
            assert print_with_a_rest(printer, rest_s, late_s).ok
        else:
            with pytest.raises(PrinterError, match=r"Home X and Y alone \(G28 X Y\), never Z"):
                print_with_a_rest(printer, rest_s, late_s)
        told = record.read_text().splitlines()
        assert not any(line.startswith(("M84", "M18")) for line in told), "Klipper lets go at once"
        assert emulator.state()["hotend_target_c"] == 0.0
    printed = [line for line in told if line in MOVES]
    assert printed == MOVES[: len(printed)]
    assert (len(printed) == len(MOVES)) == goes_on
