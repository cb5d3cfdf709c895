"""What random damage on whole jobs found (tests/property/test_hosts_wire_fuzz.py), one by one."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from link_children import beads_of, job_lines
from link_helpers import profile, program
from link_port import VirtualPort, virtual_printer
from test_link_bugs import greeted
from test_link_safety import answering

import gcode.hosts.serial as serial_host
from gcode.errors import LinkError, PrinterError
from gcode.firmware import FirmwareCore, parse_faults
from gcode.hosts import LinkLostError, ResumeRefusedError
from gcode.hosts.journal import Journal
from gcode.hosts.port import PrintReport
from gcode.hosts.resume import resume
from gcode.hosts.serial import SerialPrinter
from gcode.protocol import Link
from gcode.protocol import events as ev
from gcode.protocol.replies import parse_reply

COUNT = 60
LINES = job_lines(COUNT)
JOB = program(LINES)
HEAD = LINES.index("G1 X20 Y20.00 E0.01 F6000")
HOT_C, COLD_C = (205.0, 60.0), (0.0, 0.0)


class KilledError(BaseException):
    """The sender is no more."""


class Bench:
    """A printer, a journal, one sender after another."""

    def __init__(self, folder: Path, dialect: str = "marlin", faults: str = "") -> None:
        self.folder, self.dialect = folder, dialect
        self.record: list[bytes] = []
        self.core = FirmwareCore(
            profile(), dialect, faults=parse_faults(faults), record=self.record.append
        )
        self.port = VirtualPort(self.core)
        self.journal = Journal(folder / "journal.sqlite", clock=self.port.clock)

    def sender(self) -> SerialPrinter:
        return virtual_printer(self.port, self.folder, dialect=self.dialect, journal=self.journal)

    def resume(self, printer: SerialPrinter) -> PrintReport:
        return resume(printer, JOB, release_c=40.0, wall_clock=self.port.clock)

    @property
    def beads(self) -> list[str]:
        return beads_of(b"\n".join(self.record).decode())

    @property
    def targets_c(self) -> tuple[float, float]:
        return self.core.machine.hotend.target_c, self.core.machine.bed.target_c

    def when(self, command: str, act: object) -> None:
        """Have something raised, or called, once the printer has carried out a command."""

        def record(line: bytes) -> None:
            self.record.append(line)
            if line == command.encode():
                self.core.record = self.record.append
                self.port.at[self.port.calls + 1] = do

        def do() -> None:
            if isinstance(act, BaseException):
                raise act
            act()  # type: ignore[operator]

        self.core.record = record

    def killed_at(self, line: str) -> None:
        """A job whose sender was killed, and its supervisor with it."""
        self.when(line, KilledError())
        printer = self.sender()
        printer.connect()
        with pytest.raises(KilledError):
            printer.print(JOB)
        printer._lock.release()


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Bench:
    monkeypatch.setattr(serial_host, "require_checked", lambda checked: None)
    found = Bench(tmp_path, *getattr(request, "param", ()))
    found.port.install(monkeypatch)
    return found


@pytest.mark.parametrize(
    ("command", "said"), [("M109 S205", "was made safe"), ("M107", "somebody has ended it")]
)
def test_a_job_that_is_cancelled_while_it_is_got_ready_to_go_on_prints_nothing(
    command: str, said: str, bench: Bench
) -> None:
    """By the printer's display, say: it had gone on, cold, and 5 mm above the part."""
    bench.killed_at(LINES[HEAD + 30])
    printer = bench.sender()
    bench.when(command, printer.abort)
    done = len(bench.beads)
    with pytest.raises(ResumeRefusedError, match=said) as caught:
        bench.resume(printer)
    assert len(bench.beads) == done == caught.value.last_executed_line + 1 - HEAD
    assert bench.targets_c == COLD_C
    printer.close()
    assert bench.resume(bench.sender()).ok
    assert bench.beads == beads_of("\n".join(LINES))


def test_an_abort_between_two_parts_of_a_job_ends_it(bench: Bench) -> None:
    printer = bench.sender()
    printer.connect()
    assert printer.print(JOB, lines=range(HEAD + 20)).ok
    printer.abort()
    assert not printer.print(JOB, lines=range(HEAD + 20, len(LINES))).ok
    assert len(bench.beads) == 20
    assert bench.targets_c == COLD_C
    assert printer.print(JOB).ok  # another one


@pytest.mark.parametrize("bench", [("klipper",), ("marlin",)], indirect=True)
def test_a_printer_that_does_not_greet_who_goes_on_is_told_to_go_cold(bench: Bench) -> None:
    """Its heaters had been left as they were, and "nothing was sent to the printer"."""
    bench.killed_at(LINES[HEAD + 30])
    assert bench.targets_c == HOT_C
    bench.core.mute_until_s = math.inf
    with pytest.raises(ResumeRefusedError, match="Now: heaters told to switch off, NO ANSWER"):
        bench.resume(bench.sender())
    assert bench.targets_c == COLD_C


@pytest.mark.parametrize("bench", [("klipper",)], indirect=True)
def test_a_line_that_fails_is_not_called_executed(bench: Bench) -> None:
    lines = [*LINES[: HEAD + 3], "G1 X999", *LINES[HEAD + 3 :]]
    with pytest.raises(PrinterError, match=f"known to be executed is {HEAD + 3}\\b"):  # noqa: SIM117
        with bench.sender() as printer:
            printer.print(program(lines))
    job = bench.journal.latest()
    assert job is not None
    assert job.acked == HEAD + 3


def test_a_bad_command_is_one_though_it_repeats_what_no_text_is() -> None:
    """RepRapFirmware's answer to a line that lost its number was passed over, and so the line."""
    said = parse_reply(b"Error: Bad command: N\xd33 G1 X20 Y20.00 E0.01 F6000*47")
    assert isinstance(said, ev.CommandFailed)
    assert not said.fatal


@pytest.mark.parametrize(
    "said",
    [
        b"Eror: Bad command: \x0e1 G1 X25 Y20.00 E0.03*67",
        b"Errr: Bd comand: N G1 X2 Y20.00 E0.03*7",
    ],
)
def test_a_text_that_repeats_the_line_is_its_refusal_whatever_is_damaged(said: bytes) -> None:
    """Seeds 61826 and 64601: it was passed over, its `ok` taken for the line's."""
    link = Link("reprap")
    link.hello(0.0)
    link.receive(b"ok\n", 0.0)
    link.send("G1 X25 Y20.00 E0.03", 0.0)
    events = link.receive(b"Printing paused*67\n" + said + b"\nok\n", 0.1)
    assert [event.acked for event in events if isinstance(event, ev.CommandFailed)] == [0]


def test_a_runaway_is_fatal_though_a_letter_is_missing() -> None:
    said = parse_reply(b"Error: Thermal Runawa, system stopped! Heater_ID: E0")
    assert isinstance(said, ev.CommandFailed)
    assert said.fatal


@pytest.mark.parametrize("bench", [("marlin", "line 60 silent_reset")], indirect=True)
def test_what_waited_in_a_printer_that_started_anew_without_a_word_is_not_executed(
    bench: Bench,
) -> None:
    with pytest.raises(LinkLostError, match="lost its place") as caught, bench.sender() as printer:
        printer.print(JOB)
    assert "are executed (up to 80 acknowledged after it may have been lost" in str(caught.value)
    job = bench.journal.latest()
    assert job is not None
    assert job.phase == "forgotten"
    bench.core.mute_until_s = math.inf
    printer.close()
    with pytest.raises(ResumeRefusedError, match="does not say") as refused:
        bench.resume(bench.sender())
    assert refused.value.last_executed_line < HEAD
    assert refused.value.last_sent_line >= caught.value.last_sent_line


def test_a_report_that_lost_a_digit_makes_no_heater_cold() -> None:
    """It has no checksum: `/205.0` had become `/0.0` on its way, and the nozzle was called off."""
    off, on = b"ok T:205.0 /0.0 B:60.0 /0.0\n", b"ok T:205.0 /205.0 B:60.0 /0.0\n"
    nameless = b"ok B60.0 /60.0 T0:205.0 /0.0\n"  # twice in a row, seed 62773
    for reports in ([off, *9 * [on]], [on, off, *9 * [on]], 9 * [nameless]):
        said, _ = answering(iter(reports))
        assert "heaters off" not in said


def test_a_heater_that_a_damaged_line_left_on_is_told_again() -> None:
    """Seed 51305: `M140 S0` had become `M140 S4`, and the printer reported it."""
    on, off = b"ok T:205.0 /0.0 B:60.0 /4.0\n", b"ok T:205.0 /0.0 B:60.0 /0.0\n"
    said, heard = answering(iter([on, on, off, off]))
    assert said == "heaters off (the printer reports targets of 0), nozzle lifted"
    assert heard[-3:] == [b"M140 S0", b"M105", b"M105"]


def test_temperatures_are_what_two_reports_agree_on(bench: Bench) -> None:
    printer = bench.sender()
    printer.connect()
    printer.command("M190 S60")
    damaged = iter([b"B:6.00"])
    bench.port.damage = lambda said: said.replace(b"B:60.00", next(damaged, b"B:60.00"))
    assert printer.temperatures().bed_c == 60.0


def test_a_damaged_answer_to_who_goes_on_is_asked_for_again(bench: Bench) -> None:
    """A line break was damaged: after a minute's silence the job could not be resumed."""
    bench.killed_at(LINES[HEAD + 30])
    damaged = iter([b"\x02Resend"])
    bench.port.damage = lambda said: said.replace(b"\nResend", next(damaged, b"\nResend"))
    began_s = bench.port.now_s
    assert bench.resume(bench.sender()).ok
    assert bench.port.now_s < began_s + 10.0
    assert bench.beads == beads_of("\n".join(LINES))


def test_who_is_asked_for_its_place_has_as_long_as_for_any_answer() -> None:
    """The link was given up after ten questions in 4 s, where the printer was silent for 3."""
    link = greeted()
    link.send("G1 X1", 0.0)
    link.receive(b"ok\n", 0.0)
    link.ask_place(0.0)
    now_s = asked = 0
    while now_s < 50.0:
        now_s = link.next_deadline_s()
        link.tick(now_s)
        asked += bool(link.take_output())
    assert not link.ended
    assert asked < 15, "its buffer holds no more"
    said = b"Error:Line Number is not Last Line Number+1, Last Line: 1\nResend: 2\nok\n"
    assert ev.Proved(1) in link.receive(said, now_s)
    link.ask_place(100.0)
    while not link.ended:
        link.tick(link.next_deadline_s())
    assert link.ended_by == "the printer does not say which line it took last"


def test_the_ok_of_a_refusal_whose_number_was_damaged_acknowledges_nothing() -> None:
    link = greeted()
    line = link.send("G1 X1", 0.0)
    link.receive(b"Error:checksum mismatch, Last Line: 0\nResend: \xb1\nok\n", 0.1)
    assert link.last_acked == 0
    link.tick(link.next_deadline_s())
    assert link.take_output() == b"\n" + line


def test_nobody_waits_for_a_link_that_has_ended_meanwhile(bench: Bench) -> None:
    """Somebody within had heard of it, and whoever had asked first waited for ever."""
    printer = bench.sender()
    printer.connect()
    bench.when("G28", lambda: printer._link.give_up("it was made safe"))
    with pytest.raises(LinkLostError, match="it was made safe"):
        printer.command("G28")


@pytest.mark.parametrize("bench", [("klipper",)], indirect=True)
def test_a_job_whose_last_moves_were_lost_was_not_printed_to_its_end(bench: Bench) -> None:
    printer = bench.sender()
    printer.connect()
    assert printer.print(JOB).ok
    bench.core.machine.kill("Lost communication with MCU")
    with pytest.raises(PrinterError, match="Lost communication"):
        printer.finish_moves()
    printer.close()
    with pytest.raises(LinkError) as caught:
        bench.resume(bench.sender())
    assert "printed to its end" not in str(caught.value)


def test_an_interrupt_of_a_safe_exit_does_not_cut_it_short(bench: Bench) -> None:
    printer = bench.sender()
    printer.connect()
    printer.command("M109 S205")
    bench.port.at[bench.port.calls + 2] = lambda: (_ for _ in ()).throw(KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        next(iter([printer.make_safe()]))
    assert bench.targets_c[0] == 0.0
    assert any("heaters off" in note for note in printer.notes)


def test_m105_of_a_firmware_with_advanced_ok_says_an_ok_of_its_own() -> None:
    core = FirmwareCore(profile(), "marlin")
    core.enable_advanced_ok()
    core.power_up()
    core.take_output()
    core.feed(b"M105\nG90\n")
    core.run()
    first, second = core.take_output().splitlines()
    assert first.startswith(b"ok T:")
    assert second.startswith(b"ok N0 P")
