"""The fifteen bugs that other senders shipped, one test each, in the order of their list."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import sys
import threading
import tty
from dataclasses import dataclass
from pathlib import Path

import pytest
import serial

sys.path.insert(0, str(Path(__file__).parent))
from link_harness import Conversation
from link_helpers import moves, print_with_a_pause, profile, program

import gcode.hosts.serial as serial_host
from gcode.errors import LocalProtocolError
from gcode.firmware import EmulatedPrinterProcess
from gcode.hosts.serial import SerialPrinter
from gcode.protocol import HISTORY_LINES, Link, LinkTiming, State, checksum
from gcode.protocol import events as ev

LINES = [f"G1 X{i} Y{i * 3 % 170} F6000" for i in range(60)]


@pytest.fixture(autouse=True)
def _no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    """These tests judge the link, on programs that no checker has seen."""
    monkeypatch.setattr(serial_host, "require_checked", lambda checked: None)


def greeted(window: int = 1) -> Link:
    link = Link(window=window)
    link.hello(0.0)
    link.receive(b"ok\n", 0.0)
    return link


def test_bug_01_no_endless_off_by_one_resend() -> None:
    """A duplicate earns a stale request, serving it the next, for ever (OctoPrint#470)."""
    talk = Conversation("line 20 silence s=30")  # long enough for several probes of one line
    assert talk.job(LINES)
    assert talk.program == LINES
    served = [e for e in talk.events if isinstance(e, ev.ResendRequested) and e.served]
    assert len(served) <= 3


def test_bug_02_right_line_after_a_resend_without_ok() -> None:
    """Without an ok after `Resend:` the next ok belongs to the line itself (OctoPrint#2285)."""
    talk = Conversation("always resend_without_ok\nevery 7 corrupt_in")
    assert talk.job(LINES)
    assert talk.program == LINES


def test_bug_03_a_line_that_left_the_history_stops_the_job() -> None:
    """OctoPrint#4671: stop and name the interval; never send something else in its place."""
    link = greeted()
    for i in range(HISTORY_LINES + 50):
        link.send(f"G1 X{i}", 0.0)
        if i < HISTORY_LINES + 49:
            link.receive(b"ok\n", 0.0)
    events: list[ev.Event] = []
    for attempt in range(3):
        events += link.receive(b"Resend: 20\nok\n", float(attempt))
    lost = [e for e in events if isinstance(e, ev.LinkLost)]
    assert lost
    assert link.state is State.LOST
    assert lost[0].last_sent == HISTORY_LINES + 50
    assert link.take_output() == b""


@pytest.mark.parametrize(
    "text", [b"Resend: hours", b"rs", b"Resend:", b"resend 12x", b"Resend: -4", b"Resend: 1 2"]
)
def test_bug_04_loose_text_is_no_resend(text: bytes) -> None:
    """OctoPrint#205 crashed on "hours"."""
    link = greeted()
    link.send("G1 X1", 0.0)
    (event,) = link.receive(text + b"\n", 0.1)
    assert isinstance(event, ev.Unrecognised)
    assert link.take_output() == b""


def test_bug_05_checksum_error_without_resend_does_not_wait_for_ever() -> None:
    """OctoPrint#2226: an error, then nothing; the line is sent again after a while."""
    link = greeted()
    line = link.send("G1 X1", 0.0)
    link.receive(b"Error:checksum mismatch, Last Line: 0\n", 0.1)
    link.tick(link.next_deadline_s())
    assert link.take_output() == b"\n" + line


@pytest.mark.parametrize("said", [b"Error:No Line Number with checksum, Last Line: 0\n", b"wait\n"])
def test_bug_05_what_tells_of_a_lost_line_is_acted_on_at_once(said: bytes) -> None:
    """Beside OctoPrint on its own virtual printer, the ordinary silence made us twice as slow."""
    link = greeted()
    line = link.send("G1 X1", 0.0)
    link.receive(said, 1.0)
    assert link.next_deadline_s() == pytest.approx(1.1)
    link.tick(link.next_deadline_s())
    assert link.take_output() == b"\n" + line


@pytest.mark.parametrize("fault", ["lose_ok", "garble_ok"])
def test_bug_06_a_lost_or_garbled_ok_does_not_stall(fault: str) -> None:
    """OctoPrint#2454, even while temperatures keep coming; nothing runs twice."""
    talk = Conversation(f"every 6 {fault}")
    assert talk.job(LINES)
    assert talk.program == LINES


def test_bug_06_temperature_reports_are_no_sign_of_life_of_a_line() -> None:
    link = greeted()
    line = link.send("G1 X1", 0.0)
    deadline_s = link.next_deadline_s()
    for second in range(1, 8):
        link.receive(b" T:200.00 /200.00 B:60.00 /60.00 @:0 B@:0\n", float(second))
    assert link.next_deadline_s() == deadline_s
    link.tick(deadline_s)
    assert link.take_output() == b"\n" + line


def test_bug_06_a_firmware_that_says_busy_is_asked_again_sooner() -> None:
    """A native Marlin, behind a wire that lost an ok, had the nozzle stand for 8 s."""
    link = greeted()
    link.send("G28", 0.0)
    assert link.next_deadline_s() == link.timing.slow_silence_s
    link.receive(b"echo:busy: processing\n", 2.0)
    assert link.next_deadline_s() == 2.0 + link.timing.busy_silence_s
    link.receive(b"ok\n", 4.0)
    link.send("G1 X1", 4.0)
    assert link.next_deadline_s() == 4.0 + link.timing.busy_silence_s


def test_bug_07_pause_abort_and_resend_cannot_deadlock() -> None:
    """OctoPrint#2524: pause and resume from another thread while lines are resent."""
    with EmulatedPrinterProcess(printer=profile(), faults="every 9 corrupt_in") as emulator:
        printer = SerialPrinter(emulator.port, supervise=False)
        printer.connect()
        done = threading.Event()
        half = threading.Event()

        def tell(stage: str, count: float, total: float) -> None:
            if count >= total / 3:
                half.set()

        def meddle() -> None:
            half.wait(20)
            for _ in range(3):
                printer.pause()
                printer.resume()
            done.set()

        thread = threading.Thread(target=meddle)
        thread.start()
        report = printer.print(program(moves(1500)), progress=tell)
        thread.join(20)
        printer.close()
    assert report.ok
    assert done.is_set()


def test_bug_08_an_unknown_number_kills_nobody() -> None:
    """Printrun#594: KeyError in the sender's thread for a line it does not have."""
    link = greeted()
    link.send("G1 X1", 0.0)
    for number in (0, 5, 999999999) * 3 + (0,):
        assert link.state is State.WAITING
        assert any(
            isinstance(e, ev.ResendRefused) for e in link.receive(b"Resend: %d\n" % number, 1.0)
        )
    assert link.state is State.LOST  # ten contradictions in a row


def test_one_senseless_number_again_and_again_is_no_noise() -> None:
    """A printer that started anew without a word asks for the same line every time."""
    link = greeted()
    for i in range(9):
        link.send(f"G1 X{i}", float(i))
        link.receive(b"ok\n", float(i))
    link.confirm()
    link.send("G1 X9", 9.0)
    for attempt in range(3):
        assert not link.ended
        link.receive(b"Error:Line Number is not Last Line Number+1, Last Line: 0\n", 9.0 + attempt)
        link.receive(b"Resend: 1\nok\n", 9.0 + attempt)
    assert link.state is State.LOST


def test_a_request_that_contradicts_itself_is_asked_again() -> None:
    """Found on a wire with one damaged byte in 200: the number after `Resend:` has no checksum."""
    link = greeted()
    for i in range(30):
        link.send(f"G1 X{i}", 0.0)
        link.receive(b"ok\n", 0.0)
    line = link.send("G1 X30", 0.0)
    link.receive(b"Error:checksum mismatch, Last Line: 30\n", 0.1)
    events = link.receive(b"Resend: 21\nok\n", 0.1)
    assert [type(event) for event in events] == [ev.ResendRefused, ev.SpareOk]
    link.tick(link.next_deadline_s())
    assert link.take_output() == b"\n" + line
    assert isinstance(link.receive(b"ok\n", 0.5)[0], ev.Acknowledged)
    assert link.idle


def test_an_ok_that_lost_its_end_is_asked_for_soon() -> None:
    link = greeted()
    line = link.send("G1 X1", 0.0)
    link.receive(b"ok", 1.0)
    assert link.next_deadline_s() == pytest.approx(1.0 + link.timing.doubt_s)
    link.tick(link.next_deadline_s())
    assert link.take_output() == b"\n" + line


def test_the_ok_of_a_refused_hello_greets_nobody() -> None:
    link = Link()
    hello = link.hello(0.0)
    link.receive(b"Error:checksum mismatch, Last Line: 812\nResend: 813\nok\n", 0.1)
    assert link.state is State.GREETING
    link.tick(link.next_deadline_s())
    assert link.take_output() == hello
    assert isinstance(link.receive(b"ok\n", 0.3)[0], ev.Greeted)


def test_the_place_is_proved_by_a_number_said_twice() -> None:
    """Counting the answers to M114 proved too much: an older one may come late."""
    link = greeted()
    link.send("G1 X1", 0.0)
    link.receive(b"ok\n", 0.0)  # garbled refusals lie before it: the line has not been received
    question = link.ask_place(0.1)
    assert not link.ready
    assert question.startswith(b"\nN10 M105*")
    refusal = b"Error:Line Number is not Last Line Number+1, Last Line: %d\nResend: %d\nok\n"
    link.receive(refusal % (3, 1), 0.2)
    link.tick(link.next_deadline_s())
    assert link.take_output() == question  # that made no sense
    link.receive(refusal % (0, 1), 0.4)
    assert b"G1 X1" in link.take_output()
    link.receive(b"ok\n", 0.5)
    assert link.idle
    link.ask_place(0.6)
    assert ev.Proved(1) in link.receive(refusal % (1, 2), 0.7)
    assert link.idle
    link.send("G1 X2", 0.8)
    for attempt in range(2):
        link.receive(b"Resend: 1\nok\n", 1.0 + attempt)  # proved: never sent again
    assert b"N1 " not in link.take_output()


def test_more_answers_than_questions_prove_nothing() -> None:
    """Regression, native Marlin behind a bad wire: a line break in a question left half of it.

    The half was carried out without a number and answered, and so was the question itself, sent
    again. That spare answer proved the last line of the job later on, which had never arrived.
    """
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    taken: list[bytes] = []
    place = b"X:1.00 Y:1.00 Z:5.00 E:0.00 Count X:0 Y:0 Z:0\nok\n"

    def answer() -> None:
        last, split, lost = 0, False, False
        with contextlib.suppress(OSError), os.fdopen(ours, "rb", buffering=0) as port:
            for line in port:
                said = re.match(rb"N(\d+) ?([^*]+)", line)
                if said is None:
                    continue
                number, command = int(said[1]), said[2].strip()
                whole = line.strip().endswith(b"*%d" % checksum(said[0]))
                asked, say = command == b"M114", b"ok\n"
                if command.startswith(b"M110"):
                    last = number
                elif number != last + 1 or not whole or (asked and not split):
                    why = (
                        b"Line Number is not Last Line Number+1" if whole else b"checksum mismatch"
                    )
                    say = b"Error:%s, Last Line: %d\nResend: %d\nok\n" % (why, last, last + 1)
                    if (
                        number == last + 1 and whole
                    ):  # of the first question a half was one without a number
                        split, say = True, say + place
                elif asked and b"G1 X2" in taken and not lost:
                    lost = True  # the answer to something else is taken for this line's
                else:
                    last = number
                    taken.append(command)
                    if command.startswith(b"M115"):
                        say = b"FIRMWARE_NAME:Marlin 2.0.9 PROTOCOL_VERSION:1.0\nok\n"
                    elif asked:
                        say = place
                    elif command.startswith(b"M105"):
                        say = b"ok T:20.0 /0.0 B:20.0 /0.0\n"
                os.write(ours, say)

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    printer = SerialPrinter(os.ttyname(theirs), supervise=False)
    printer.connect()
    os.close(theirs)
    assert printer.print(program(["G1 X1", "G1 X2"])).ok
    after = taken[taken.index(b"G1 X2") :]
    assert b"M114" in after, after
    assert [line for line in taken if line.startswith(b"G1")] == [b"G1 X1", b"G1 X2"]
    printer.close()
    thread.join(10)


def test_where_no_number_is_verified_the_links_own_questions_are_no_doubt() -> None:
    """Regression: where an `ok` is lost the link asks itself, and had more answers than questions.

    It had taken them for a doubt and asked again, until it gave the printer up.
    """
    quick = LinkTiming(silence_s=0.2, doubt_s=0.05, resend_grace_s=0.05)
    faults = "every 3 lose_ok"
    with EmulatedPrinterProcess(printer=profile(), firmware="klipper", faults=faults) as emulator:
        printer = SerialPrinter(emulator.port, dialect="klipper", supervise=False, timing=quick)
        printer.connect()
        printer.close()


def test_bug_09_comments_stay_here_and_rs_is_heard() -> None:
    """Printrun#271."""
    link = greeted()
    line = link.send("G1 X1 ; to the edge", 0.0)
    assert line == b"N1 G1 X1*%d\n" % checksum(b"N1 G1 X1")
    link.receive(b"rs N1\nok\n", 0.1)
    assert link.take_output() == b"\n" + line


def test_bug_10_a_purge_in_a_pause_makes_no_giant_extrusion() -> None:
    """Printrun#70, Klipper#2624: absolute E, 8 mm purged by hand while paused."""
    lines = ["M82", "G92 E0", "G28"]
    lines += [f"G1 X{20 + i % 50} Y{30 + i % 3} E{0.02 * (i + 1):.4f} F6000" for i in range(2000)]
    with EmulatedPrinterProcess(printer=profile()) as emulator:
        printer = SerialPrinter(emulator.port, supervise=False)
        printer.connect()
        report = print_with_a_pause(printer, lines, lambda: printer.command("G1 E8 F300"))
        printer.finish_moves()
        motion = emulator.take_motion()
        printer.close()
    assert report.ok
    # The purge itself is one move in place; no other move pushes more than its own bead.
    beads = [e for e in motion.filament_mm if abs(e) > 0.021]
    assert len(beads) <= 1
    assert sum(e for e in motion.filament_mm if 0 < e <= 0.021) == pytest.approx(40.0, abs=0.05)


def paused_on_the_way(lines: list[str], pauses: int) -> tuple[tuple[float, ...], float]:
    """Where a program ends that is paused so often at once and resumed, and its greatest Z, mm."""
    with EmulatedPrinterProcess(printer=profile()) as emulator:
        printer = SerialPrinter(emulator.port, supervise=False)
        printer.connect()
        print_with_a_pause(printer, lines, pauses=pauses)
        place = printer.position_mm()
        highest_mm = float(emulator.take_motion().end_mm[:, 2].max())
        printer.close()
    return place, highest_mm


def test_bug_11_z_and_modes_come_back_after_a_pause_even_a_nested_one() -> None:
    """Marlin#10875, Klipper#2412: two pauses, relative moves, Z as the program wants it."""
    lines = ["G28", "G90", "G1 Z3 F600", "G91", "M83"] + ["G1 X0.1 F3000"] * 1500
    place, _ = paused_on_the_way(lines, 2)
    assert place == pytest.approx((150.0, 0.0, 3.0), abs=0.01)


def test_bug_11_a_program_in_inches_is_lifted_by_millimetres() -> None:
    """Found in review: G91 and Z5 after G20 are five inches."""
    lines = ["G28", "G20", "G90", "G1 Z0.1 F20", "G91", "M83"] + ["G1 X0.004 F100"] * 1500
    place, highest_mm = paused_on_the_way(lines, 1)
    assert place == pytest.approx((152.4, 0.0, 2.54), abs=0.01)
    assert highest_mm == pytest.approx(7.54, abs=0.01)


def test_bug_12_opening_the_port_raises_no_dtr(monkeypatch: pytest.MonkeyPatch) -> None:
    """pyserial#124, Printrun#1068: DTR must be down before the port is opened."""
    seen: list[bool] = []
    original = serial.Serial.open

    def watch(self: object) -> None:
        seen.extend((self.dtr, self.rts))  # type: ignore[attr-defined]
        original(self)

    monkeypatch.setattr(serial.Serial, "open", watch)
    with EmulatedPrinterProcess(printer=profile()) as emulator:
        printer = SerialPrinter(emulator.port, supervise=False)
        printer.connect()
        printer.close()
    assert seen == [False, False]


@pytest.mark.parametrize("command", ["M190 S110", "M190S110", "m0190 s110"])
def test_bug_13_a_slow_command_never_forces_the_next_line(command: str) -> None:
    """OctoPrint#553, #2026: ten minutes of heating without a word; one line is under way."""
    link = greeted()
    line = link.send(command, 0.0)
    now_s = 0.0
    while now_s < 600.0:
        now_s = link.next_deadline_s()
        link.tick(now_s)
        assert link.take_output() in (b"", b"\n" + line)  # the same line at most: it is idempotent
        assert not link.ready
    assert link.state is State.PROBING


@pytest.mark.parametrize("dialect", ["klipper", "marlin"])
def test_bug_14_a_long_script_does_not_time_out(dialect: str) -> None:
    """Moonraker#437: a macro takes as long as its moves; 25 minutes without a word are none too
    many, nothing is sent again that cannot be, and its ok is taken when it comes.

    (The adapter of Moonraker itself has its own: scripts go by the websocket, without a limit.)
    """
    link = Link(dialect)
    link.hello(0.0)
    link.receive(b"ok\n", 0.0)
    line = link.send("PRINT_START EXTRUDER_TEMP=210 BED_TEMP=60", 0.0)
    now_s = 0.0
    while now_s < 1500.0:
        now_s = min(link.next_deadline_s(), 1500.0)
        link.tick(now_s)
        again = b"M114\nM114\n" if dialect == "klipper" else b"\n" + line  # a question, or itself
        assert link.take_output() in (b"", again)
        assert not link.ended
        assert not link.ready
    link.receive(b"ok\n", 1500.0)
    if dialect == "klipper":  # the questions that were asked meanwhile are answered, too
        link.receive(b"X:0.000 Y:0.000 Z:0.000 E:0.000\nok\n" * 2, 1500.0)
        link.tick(link.next_deadline_s())
    assert link.idle
    link.send("G1 X1", 1500.0)
    assert link.next_deadline_s() < 1500.0 + 61.0  # an ordinary line is not waited for so long


def test_bug_15_advanced_ok_numbers_are_not_believed_blindly() -> None:
    """Marlin#2952: numbers off by whatever; the job goes on all the same."""
    link = greeted(window=4)
    for i in range(4):
        link.send(f"G1 X{i}", 0.0)
    for number in (900, 901, 902, 903):
        link.receive(b"ok N%d P15 B3\n" % number, 0.1)
    assert link.idle
    assert link.last_acked == 4


def test_m110_in_a_message_renumbers_nothing() -> None:
    link = greeted()
    assert b"M110" not in link.send("M117 M110 N5", 0.0)
    link.receive(b"ok\n", 0.0)
    with pytest.raises(LocalProtocolError, match="M110"):
        link.send("M110 N7", 0.0)


def test_a_line_the_firmware_would_cut_is_refused() -> None:
    link = greeted()
    with pytest.raises(LocalProtocolError, match="95"):
        link.send("G1 " + "X1.000000 " * 12, 0.0)


def test_a_second_sender_is_refused() -> None:
    from gcode.errors import PortBusyError

    with EmulatedPrinterProcess(printer=profile()) as emulator:
        first = SerialPrinter(emulator.port, supervise=False)
        first.connect()
        with pytest.raises(PortBusyError, match=str(os.getpid())):
            SerialPrinter(emulator.port, supervise=False).connect()
        first.close()
        with SerialPrinter(emulator.port, supervise=False) as second:
            assert second.temperatures().hotend_c > 0


@dataclass
class Raw:
    text: str


def test_what_nobody_checked_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from gcode.hosts.proof import require_checked

    with pytest.raises(LocalProtocolError, match="CheckedProgram"):
        require_checked(Raw("G1 X1"))
