"""Interrupted, aborted, stopped in the middle of a line or of heating: safe, and it says so."""

from __future__ import annotations

import contextlib
import errno
import os
import pty
import re
import signal
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from link_forks import until
from link_helpers import Unjudged, moves, profile, program

import gcode.hosts.serial as serial_host
from gcode.errors import LinkError, LocalProtocolError, PrinterError
from gcode.firmware import EmulatedPrinterProcess
from gcode.hosts import LinkLostError, supervisor
from gcode.hosts.fast_path import waiting
from gcode.hosts.port import NothingMetError
from gcode.hosts.serial import SerialPrinter
from gcode.moves import Program
from gcode.protocol import Link, LinkTiming
from gcode.protocol import events as ev

HEAD = ["M104 S200", "G28", "G1 Z2 F600", "M83"]
MOVES = moves(900)


@pytest.fixture(autouse=True)
def _no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_host, "require_checked", lambda checked: None)


class Bench:
    """A printer, and somebody who does something once it has carried out some command."""

    def __init__(self, emulator: EmulatedPrinterProcess, record: Path) -> None:
        self.emulator, self.record = emulator, record

    def told(self) -> list[str]:
        return self.record.read_text().splitlines() if self.record.exists() else []

    def once(self, command: str, act: Callable[[], object]) -> threading.Thread:
        def wait() -> None:
            until(lambda: command in self.told())
            act()

        thread = threading.Thread(target=wait, daemon=True)
        thread.start()
        return thread

    def targets_c(self) -> tuple[object, object]:
        state = self.emulator.state()
        return state["hotend_target_c"], state["bed_target_c"]


@contextmanager
def bench(tmp_path: Path, **options: object) -> Iterator[Bench]:
    record = tmp_path / "executed"
    with EmulatedPrinterProcess(printer=profile(), record=record, **options) as emulator:  # type: ignore[arg-type]
        yield Bench(emulator, record)


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_an_interrupt_in_the_middle_of_a_line_lifts_the_nozzle(tmp_path: Path) -> None:
    # regression: an interrupt nearly always comes while an answer is awaited, and then nothing was
    # lifted and nothing confirmed
    lines = [*HEAD, *moves(400)]
    with bench(tmp_path, faults="always slow_reader s=0.004") as it:
        printer = SerialPrinter(it.emulator.port, supervise=False)
        thread = it.once(lines[50], interrupt)
        with pytest.raises(KeyboardInterrupt), printer:
            printer.print(program(lines))
        thread.join(10)
        told, state = it.told(), it.emulator.state()
    assert printer.notes[-1] == "heaters off (the printer reports targets of 0), nozzle lifted"
    printed = [line for line in told if line in lines]
    assert len(printed) < len(lines)
    assert printed == lines[: len(printed)]
    assert (state["hotend_target_c"], state["bed_target_c"]) == (0, 0)
    assert told[-6:] == ["G21", "G91", "G1 Z5 F600", "G90", "M105", "M105"]


@pytest.mark.parametrize(
    ("firmware", "said"), [("marlin", "heaters off"), ("prusa", "told to switch off")]
)
def test_an_interrupt_while_it_heats_waits_for_no_heater(
    firmware: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """In real time; a firmware without emergency parser reads nothing before M190 has ended."""
    monkeypatch.setattr(supervisor, "PORT_ANSWERS_S", 0.2)
    with bench(tmp_path, firmware=firmware, accelerated=False) as it:
        printer = SerialPrinter(it.emulator.port, supervise=False, dialect=firmware)
        thread = it.once("M190 S60", interrupt)
        with pytest.raises(KeyboardInterrupt), printer:
            printer.print(program(["M104 S200", "M190 S60", "G28"]))
        thread.join(10)
        assert said in printer.notes[-1]
        assert ("heats on until that is done" in caplog.text) == (firmware == "prusa")
        assert it.targets_c() == ((0, 0) if firmware == "marlin" else (200, 60))
        assert "G28" not in it.told()


def test_an_abort_while_it_heats_waits_for_no_heater(tmp_path: Path) -> None:
    # regression: the job ended when the bed was warm
    with bench(tmp_path, accelerated=False) as it:
        printer = SerialPrinter(it.emulator.port, supervise=False)
        printer.connect()
        thread = it.once("M190 S60", printer.abort)
        report = printer.print(program(["M104 S200", "M190 S60", "G28"]))
        thread.join(10)
        assert (report.ok, report.next_line) == (False, 1)
        assert it.targets_c() == (0, 0)
        assert "G28" not in it.told()
        printer.close()


def test_an_answer_that_an_interrupt_took_away_is_asked_for_again(tmp_path: Path) -> None:
    # regression: an interrupt between a read and what was to be done with it
    with bench(tmp_path) as it, SerialPrinter(it.emulator.port, supervise=False) as printer:
        printer.command("M104 S100")
        printer._write(printer._link.send("G1 X5", printer._clock()))
        with waiting(printer._fd):
            assert os.read(printer._fd, 100) == b"ok\n"
        printer.make_safe()
        assert printer.notes[-1].endswith("nozzle lifted")
        assert it.told()[-6:] == ["G21", "G91", "G1 Z5 F600", "G90", "M105", "M105"]
        assert it.told().count("G1 X5") == 1


def test_another_threads_job_does_not_hold_up_a_safe_exit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gcode.hosts.guarded.REST_S", 0.2)
    lines, caught = [*HEAD, *moves(3000)], list[Exception]()
    with bench(tmp_path, faults="always slow_reader s=0.004") as it:
        printer = SerialPrinter(it.emulator.port, supervise=False)
        printer.connect()

        def job() -> None:
            try:
                printer.print(program(lines))
            except LinkLostError as error:
                caught.append(error)

        thread = threading.Thread(target=job)
        thread.start()
        it.once(lines[20], lambda: None).join(10)
        printer.make_safe()
        thread.join(20)
        assert it.targets_c() == (0, 0)
        assert len([line for line in it.told() if line in lines]) < len(lines)
        printer.close()
    assert "the printer was made safe" in str(caught[0])


def test_an_emergency_stop_of_a_printer_that_says_nothing_ends_the_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # regression: who waited for an answer waited for ever
    monkeypatch.setattr(supervisor, "PORT_ANSWERS_S", 0.01)
    lines = [*HEAD, *moves(60)]
    with (
        bench(tmp_path, faults="line 40 dead") as it,
        SerialPrinter(it.emulator.port, supervise=False) as printer,
    ):
        before = len(it.told())

        def stop_once_it_is_dead() -> None:
            told = -1
            while told != (told := len(it.told())):
                time.sleep(0.2)
            printer.emergency_stop()

        thread = it.once(lines[20], stop_once_it_is_dead)
        with pytest.raises(LinkLostError, match="an emergency stop was asked for") as caught:
            printer.print(program(lines))
        thread.join(10)
        printed = [line for line in it.told()[before:] if line in lines]
    assert caught.value.last_executed_line < len(printed) <= caught.value.last_sent_line + 1


def test_a_link_that_was_lost_can_be_greeted_anew() -> None:
    # regression: what an ended conversation had left unsaid ended the next one
    link = Link()
    link.hello(0.0)
    link.receive(b"ok\n", 0.0)
    link.send("G1 X1", 0.0)
    link.give_up("the cable was pulled")
    link.hello(1.0)
    assert link.receive(b"ok\n", 1.0) == [ev.Greeted()]


def test_the_printers_own_buttons_pause_and_go_on(tmp_path: Path) -> None:
    # regression: a pause by the printer's display could not be ended there (`//action:resume`)
    lines = [*HEAD, *MOVES[:20], "M118 A1 action:pause", *MOVES[20:]]
    with bench(tmp_path) as it, SerialPrinter(it.emulator.port, supervise=False) as printer:
        fd = os.open(it.emulator.port, os.O_RDWR | os.O_NOCTTY)
        press = lambda: os.write(fd, b"M118 A1 action:resume\n")  # noqa: E731
        thread = it.once("G1 Z5 F600", press)
        report = printer.print(program(lines))
        thread.join(10)
        os.close(fd)
        assert report.ok
        assert list(printer.actions) == ["pause", "resume"]
        assert {"paused", "resumed"} <= set(printer.notes)
    assert [line for line in it.told() if line in MOVES] == MOVES


@pytest.mark.parametrize("firmware", ["klipper", "reprap"])
@pytest.mark.parametrize(
    ("lines", "said"), [(["G28", *MOVES[:60]], "started anew"), (MOVES, "hom")]
)
def test_a_restart_is_noticed_where_lines_are_not_verified(
    firmware: str,
    lines: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By what they say as they start; where that is lost, by the refusal to move unhomed."""
    monkeypatch.setattr(supervisor, "PORT_ANSWERS_S", 0.05)
    with bench(tmp_path, firmware=firmware, faults="line 30 reset") as it:
        printer = SerialPrinter(it.emulator.port, dialect=firmware, supervise=False)
        printer.connect()
        with pytest.raises(LinkError, match=said):
            printer.print(program(lines))
        told = it.told()
        printer.close()
    assert sum(line in lines for line in told) < (35 if "G28" in lines else 2)


def test_a_klipper_that_shuts_down_is_heard_out(tmp_path: Path) -> None:
    """regression: it "started anew", for no reason that was told; and then it was asked for ever.

    A live Klipper gives the cause to whatever it is told next, and reports its targets unchanged.
    """
    with bench(tmp_path, firmware="klipper", faults="line 30 thermal_runaway") as it:
        printer = SerialPrinter(it.emulator.port, dialect="klipper", supervise=False)
        printer.connect()
        with pytest.raises(PrinterError, match="Klipper has shut down: Thermal Runaway") as caught:
            printer.print(program([*HEAD, *MOVES[:60]]))
        # regression: all that was acknowledged was called executed, though never moved
        assert "known to be executed is 0 (up to 1000 acknowledged after" in str(caught.value)
        with pytest.raises(LinkLostError, match="has ended"):
            printer.temperatures()
        assert re.search(r"nothing confirms it: .* stopped \(Thermal", printer.notes[-1])
        printer.close()
    assert MOVES[40] not in it.told()


def test_a_garbled_answer_does_not_cost_the_job_its_proof(tmp_path: Path) -> None:
    # regression: one M114 and one M115 whose answers were garbled, and no later one would do
    with bench(tmp_path) as it, SerialPrinter(it.emulator.port, supervise=False) as printer:
        for kind in ("M114", "M115"):
            printer._asked[kind] += 1  # as if one had been asked, and its answer not been heard
        assert printer.print(program(["G28", *MOVES[:50]])).ok


def test_nothing_is_waited_for_on_a_port_that_was_never_opened() -> None:
    """Regression: a run refused before it connected waited for ever for its heaters' `ok`."""
    printer = SerialPrinter("/dev/ttyNOBODY", supervise=False)
    for ask in (printer.heaters_off, printer.temperatures):
        with pytest.raises(LocalProtocolError, match="not connected"):
            ask()


@pytest.mark.parametrize(
    ("what", "said"),
    [("nothing", "No such file or directory; check the path"), ("file", "it is no serial port"),
     ("folder", "Is a directory; check"), ("forbidden", "Permission denied; have your user added")],
)  # fmt: skip
def test_a_port_that_cannot_be_opened_is_one_sentence(
    what: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = tmp_path / "tty"
    if what == "folder":
        port.mkdir()
    elif what != "nothing":
        port.touch()
    if what == "forbidden":  # root may open anything
        denied = PermissionError(errno.EACCES, "Permission denied")
        monkeypatch.setattr("serial.Serial.open", Mock(side_effect=denied))
    with pytest.raises(LinkError, match=f"cannot be opened: {said}"):
        SerialPrinter(str(port)).connect()


@pytest.mark.parametrize(
    ("says", "give_up_s", "said"),
    [
        (b"\x00\xe0\xfe", 0.4, "its speed is another"),
        (bytes(range(256)), 600.0, "its speed is another"),  # regression: told after a minute
        (b"", 0.4, "is it switched on"),
    ],
)
def test_a_printer_at_another_speed_is_told_from_one_that_is_off(
    says: bytes, give_up_s: float, said: str
) -> None:
    """Regression: for both, 'program lines up to 0 are acknowledged, heaters may be on'."""
    theirs, ours = os.openpty()
    tty.setraw(ours)
    quick = LinkTiming(give_up_s=give_up_s, doubt_s=0.02)
    printer = SerialPrinter(os.ttyname(ours), baud=57600, timing=quick, supervise=False)
    threading.Thread(target=lambda: os.read(theirs, 99) and os.write(theirs, says)).start()
    with pytest.raises(LinkLostError, match=f"does not greet: no answer at 57600 baud; .*{said}"):
        printer.connect()
    os.close(theirs)
    os.close(ours)


def test_who_interrupts_is_told_what_became_of_the_heaters(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    # regression: the command line said "interrupted", and what was noted of the heaters was lost
    lines = [*HEAD, *moves(400)]
    with bench(tmp_path, faults="always slow_reader s=0.004") as it:
        printer = SerialPrinter(it.emulator.port, supervise=False)
        it.once(lines[50], interrupt)
        with pytest.raises(KeyboardInterrupt), printer:
            printer.print(program(lines))
    assert "printer: heaters off (the printer reports targets of 0), nozzle lifted" in caplog.text


def test_a_printer_is_made_safe_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Regression: by the job that failed and by who gave it, each lifting and logging its line."""
    with bench(tmp_path, firmware="klipper") as it:
        printer = SerialPrinter(it.emulator.port, dialect="klipper", supervise=False)
        with pytest.raises(PrinterError, match="out of range"), printer:
            printer.print(program([*HEAD, "G1 X999", *MOVES[:5]]))
    assert [r.getMessage() for r in caplog.records if r.name.startswith("gcode.hosts")] == [
        "printer: heaters off (the printer reports targets of 0), nozzle lifted"
    ]
    assert it.told().count("G1 Z5 F600") == 1


@pytest.mark.parametrize("fault", ["no_arcs", "no_inches"])
def test_a_command_that_the_firmware_lacks_ends_the_job_where_it_matters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    # regression: Marlin without arcs answers "unknown command" and goes on from where it was
    word = {"no_arcs": "G2 X60 Y50 I5 J0 E0.4", "no_inches": "G20"}[fault]
    monkeypatch.setattr(serial_host, "require_arcs", lambda checked, ask: None)  # it may not say
    with bench(tmp_path, faults=f"always {fault}") as it:
        printer = SerialPrinter(it.emulator.port, supervise=False)
        with pytest.raises(PrinterError, match=rf"does not know {word.split()[0]}"), printer:
            printer.print(program([*HEAD, "M73 P5", "G1 X50 Y50", word, "G1 X70 Y50"]))
        assert it.targets_c() == (0, 0)
    assert "G1 X70 Y50" not in it.told()


def test_arcs_are_refused_before_anything_moves_where_the_firmware_has_none(tmp_path: Path) -> None:
    with bench(tmp_path, faults="always no_arcs") as it, SerialPrinter(it.emulator.port) as printer:
        with pytest.raises(PrinterError, match=r"arcs .*first in line 7\b"):
            printer.print(program([*HEAD, "G28 ; home", "; G2 is none", " g02 X1 Y1 I1 J0"]))
        assert printer.print(program([*HEAD, "G20", "G28", "G21", "G200"])).ok
    assert "G28 ; home" not in it.told()


def test_a_touch_that_meets_nothing_leaves_the_link_as_it_was() -> None:
    """regression: a live Klipper says `!!` a moment before its `ok`, and the link was given up.

    Nobody asked then whether Z was put right, and whatever was asked next was waited for.
    """
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    heard: list[bytes] = []

    def answer() -> None:
        with contextlib.suppress(OSError), os.fdopen(ours, "rb", buffering=0) as port:
            for line in port:
                heard.append(line.strip())
                if line.startswith(b"AMREPAIR_TOUCH"):
                    os.write(ours, b"!! No trigger on probe after full movement\n")
                    time.sleep(0.05)
                    os.write(ours, b"ok\n// amrepair: nothing was touched\n")
                elif line.startswith(b"M105"):
                    os.write(ours, b"ok B:20.0 /0.0 T0:20.0 /0.0\n")
                elif line.startswith(b"M114"):
                    os.write(ours, b"X:1.000 Y:1.000 Z:5.500 E:0.000\nok\n")
                else:
                    os.write(ours, b"ok\n")

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    printer = SerialPrinter(os.ttyname(theirs), dialect="klipper", supervise=False)
    printer.connect()
    os.close(theirs)
    touches = Unjudged(Program("AMREPAIR_TOUCH DEPTH=2.5 SPEED=2", "klipper"))
    with pytest.raises(NothingMetError):
        printer.touch(touches, range(1))
    assert printer.position_mm()[2] == 5.5
    assert "nozzle lifted" in printer.notes[-1]
    printer.close()
    thread.join(10)
    assert heard.count(b"G1 Z5 F600") == 1
    assert not any(b"CLEAR_HOMED" in line for line in heard), "Z was put right"


def test_an_interrupt_while_an_emulated_printer_starts_leaves_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """regression: it came up on its own, found its folder gone, and ended in a traceback."""
    started: list[int] = []

    def pressed(printer: EmulatedPrinterProcess) -> dict[str, object]:
        started.append(printer.pid)
        raise KeyboardInterrupt

    monkeypatch.setattr(EmulatedPrinterProcess, "_answer", pressed)
    with pytest.raises(KeyboardInterrupt):
        EmulatedPrinterProcess(printer=profile())
    with pytest.raises(ProcessLookupError):
        os.kill(started[0], 0)
