"""One conversation with a printer on a serial port: `protocol.Link` with a port and a clock.

It opens the port, greets, tests, asks and listens; it knows nothing of programs and journals
(`serial` does). DTR is left as it is: raising it resets most boards in mid-print.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from operator import eq
from pathlib import Path
from typing import NoReturn, TypeVar

import serial

from gcode.dialects import dialect_of
from gcode.errors import LinkError, LocalProtocolError
from gcode.hosts.journal import Journal
from gcode.hosts.port import Capabilities, LinkLostError, Temperatures
from gcode.hosts.unknown import fault_of
from gcode.hosts.wirelog import WireLog
from gcode.protocol import Link, LinkDialect, LinkTiming
from gcode.protocol import events as ev
from gcode.protocol.lines import numbered

Answer = TypeVar("Answer")
REPORT_TRIES = 10
"""At one damaged byte in 200 a report is damaged every fourth time: ten in a row, one in 10^6."""
MOST_WAIT_S = 0.5
_READABLE = bytes((*range(0x20, 0x7F), *b"\t\r\n"))
UNREADABLE_BYTES, UNREADABLE_SHARE = 64, 0.25
"""Bytes to judge by, and the share of them that is no text's: of random ones 0.62 is none."""
WIRE_FAULTS = (ev.LineError, ev.ResendRequested, ev.ResendRefused, ev.UnknownCommand)
"""What is said after bytes were damaged on their way to the printer."""
ALIKE_C = 3.0
"""No heater changes as much from one report to the next; a digit more or less is ten times that."""
PROOF_QUIET_S = 0.2
"""A printer that has said nothing for so long has nothing left to say."""


def _no_port(error: OSError) -> str:
    """Why, and what to do."""
    if error.errno is None:  # a file that is none
        return "it is no serial port; give a device's path"
    why = os.strerror(error.errno)
    if error.errno == errno.EACCES:
        return f"{why}; have your user added to the group that owns it (dialout, mostly)"
    return f"{why}; check the path, the cable and the printer's switch"


def _alike(one: ev.TemperatureReport, other: ev.TemperatureReport) -> bool:
    """Whether two reports a moment apart tell of the same heaters, as no wire damaged them."""
    return one.heaters.keys() == other.heaters.keys() and all(
        heater.target_c == other.heaters[name].target_c
        and abs(heater.current_c - other.heaters[name].current_c) <= ALIKE_C
        for name, heater in one.heaters.items()
    )


def unreadable(said: bytes) -> bool:
    """Whether what was said is no text, as of a port at another speed.

    Where one byte in twenty is damaged on its way, that is so once in 10^8 times.
    """
    odd = len(said.translate(None, _READABLE))
    return len(said) >= UNREADABLE_BYTES and odd > UNREADABLE_SHARE * len(said)


@dataclass(frozen=True, slots=True)
class Line:
    """A port and how it is spoken over; what each is for stands at `SerialPrinter`."""

    port: str
    baud: int
    dialect: str
    window: int
    wire_log: Path | None
    journal: Journal | None
    timing: LinkTiming | None
    clock: Callable[[], float]
    supervise: bool
    guard: bool


class SerialConversation:
    """A printer that can be asked things.

    Those who build on it are told of what it has no use for itself, by the methods that begin
    with `_on`, `_before`, `_fault` and `_lost_error`.
    """

    def __init__(self, line: Line) -> None:
        self._line = line
        self.port = line.port
        self._clock = line.clock
        self._link = Link(line.dialect, window=line.window, timing=line.timing)
        self._log: WireLog | None = None
        self._serial: serial.Serial | None = None
        self._fd = -1
        self._poll = select.poll()
        self._mutex = threading.RLock()
        self._capabilities = Capabilities("")
        self._position: ev.PositionReport | None = None
        self._temperatures: ev.TemperatureReport | None = None
        self._heads: set[int] = set()  # that reports told of, where there are several
        self._asked = {"M114": 0, "M115": 0}
        self._heard = {"M114": 0, "M115": 0}
        self._went_wrong = False  # on the wire, since the last proof
        self._failure: Exception | None = None
        self._ended_by = ""  # why another thread has ended the link
        self._warnings: deque[str] = deque(maxlen=100)
        self._stalls = self._bytes_sent = 0
        self._refused_numbers: list[int] = []
        self._greeted = False
        self._said = b""  # between the hello and its answer

    # ------------------------------------------------------------------ for those who build on it

    def _before_own_command(self) -> None:
        """Take note that the next line on the wire is none of a program's."""

    def _on_other_event(self, event: ev.Event) -> None:
        """Take note of an event that the conversation itself has no use for."""

    def _fault(self, failed: ev.CommandFailed) -> Exception:
        return LinkError(f"The printer reports a fault: {failed.text}.")

    def _lost_error(self, why: str) -> LinkLostError:
        return LinkLostError(f"The link to {self.port} is lost: {why}.", -1, -1, why=why)

    def _stranger(self) -> LinkLostError:
        """What is there has not answered the hello."""
        said = (
            "what it says is no answer, so its speed is another, most likely: see 'baud' of its "
            "profile"
            if self._said
            else "is it switched on, and this its port?"
        )
        why = f"no answer at {self._line.baud} baud; {said}"
        return LinkLostError(f"The printer on {self.port} does not greet: {why}", -1, -1, why=why)

    # ------------------------------------------------------------------ connection

    def _open_port(self) -> None:
        if self._line.wire_log is not None:
            self._log = WireLog(self._line.wire_log, epoch_s=time.time() - self._clock())
        device = serial.Serial(baudrate=self._line.baud, timeout=0, exclusive=False)
        device.port = self.port
        device.dtr = False  # a rising DTR resets the board (pyserial#124)
        device.rts = False
        try:
            device.open()
        except (serial.SerialException, OSError) as error:
            raise LinkError(f"{self.port} cannot be opened: {_no_port(error)}.") from error
        self._serial = device
        self._fd = device.fileno()
        self._set_up_port()
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def _set_up_port(self) -> None:
        """Clear HUPCL: closing the port must not drop DTR and so reset the printer.

        And say how long a read waits, where one waits (`fast_path`): VTIME, tenths of a second.
        """
        import termios

        wait_s = min(self._link.timing.silence_s, MOST_WAIT_S)
        with contextlib.suppress(termios.error):
            attributes = termios.tcgetattr(self._fd)
            attributes[2] &= ~termios.HUPCL
            attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 0, max(1, int(10 * wait_s))
            termios.tcsetattr(self._fd, termios.TCSANOW, attributes)

    def _close_port(self) -> None:
        if self._serial is not None:
            with contextlib.suppress(OSError, serial.SerialException):
                self._serial.close()
            self._serial = None
        if self._log is not None:
            self._log.close()
            self._log = None

    def _greet(self, number: int = 0) -> None:
        self._greeted, self._said = False, b""
        self._failure, self._ended_by = None, ""
        self._write(self._link.hello(self._clock(), number=number))
        while not self._greeted:
            self._pump()
        self._settle()

    def _settle(self, quiet_s: float = 0.05) -> None:
        """Hear out what a half line or an earlier sender may still cause."""
        until_s = self._clock() + quiet_s
        while (now_s := self._clock()) < until_s:
            if self._pump(limit_s=until_s - now_s):
                until_s = self._clock() + quiet_s / 2

    def _test_guard(self) -> None:
        """Send a line with a wrong checksum and one with a wrong number: both must bounce."""
        number = self._link.last_sent + 1
        for what, line in (
            ("checksums", b"N%d M105*0\n" % number),
            ("line numbers", numbered(number + 7, b"M105")),
        ):
            refused = False
            for _ in range(REPORT_TRIES):
                self._refused_numbers.clear()
                self._write(line)
                until_s = self._clock() + max(self._link.timing.doubt_s, 0.3)
                while not self._refused_numbers and (left_s := until_s - self._clock()) > 0:
                    self._pump(limit_s=left_s)
                if self._refused_numbers:
                    refused = True
                    break
            self._settle(0.02)
            if not refused:
                self._link.give_up(f"the firmware ignores {what}")
                raise LinkError(
                    f"The printer on {self.port} takes lines with wrong {what}: corruption could "
                    f"not be noticed and nothing was printed; use another firmware or cable."
                )
        self._failure = None
        self._greet(self._link.last_sent)

    def _learn(self) -> None:
        self._capabilities = Capabilities.told(self._ask("M115"))
        self._ask("M105")  # of which heads it tells

    def _log_wire(self, direction: bytes, data: bytes) -> None:
        if self._log is not None:
            self._log.add(self._clock(), direction, data)

    # ------------------------------------------------------------------ questions

    @property
    def dialect(self) -> LinkDialect:
        """How the firmware speaks."""
        return self._link.dialect

    @property
    def forgot(self) -> bool:
        """Whether the printer has stopped or started anew: what waited in its buffers is gone."""
        return self._link.forgot

    def capabilities(self) -> Capabilities:
        """Return what the firmware said on connecting."""
        return self._capabilities

    def temperatures(self) -> Temperatures:
        """Ask for temperatures (M105)."""
        report = self._heaters()
        hotend, bed = report.hotend, report.heaters.get("B")
        if hotend is None:
            raise LinkError("The printer reports no hotend temperature; check its firmware.")
        return Temperatures(
            hotend.current_c,
            hotend.target_c or 0.0,
            bed.current_c if bed else None,
            (bed.target_c or 0.0) if bed else None,
            tuple(heater.target_c or 0.0 for _, heater in sorted(report.heads.items())),
        )

    @property
    def heads(self) -> int:
        """How many heads the printer tells of, each heated by itself."""
        return max(self._heads, default=0) + 1

    def heads_off(self) -> tuple[str, ...]:
        """Lines that switch off each of several heads that the printer has ever told of.

        Its word for the hotend means the one that is chosen.
        """
        word = dialect_of(self._link.dialect.name).head_off
        return tuple(word.format(k=k) for k in sorted(self._heads))

    def position_mm(self) -> tuple[float, float, float]:
        """Ask for the logical position (M114)."""
        report = self._where()
        return report.x_mm, report.y_mm, report.z_mm

    def place(self) -> ev.PositionReport:
        """Ask for the logical position, extruder included, once all moves are made."""
        self._ask("M400")
        return self._where()

    def _where(self) -> ev.PositionReport:
        return self._agreed("M114", lambda: self._position, "position", eq)

    def _targets_c(self) -> dict[str, float | None]:
        """What the heaters aim at, by the names that the printer gives them."""
        return {name: heater.target_c for name, heater in self._heaters().heaters.items()}

    def _heaters(self) -> ev.TemperatureReport:
        return self._agreed("M105", lambda: self._temperatures, "temperatures", _alike)

    def _agreed(
        self,
        command: str,
        read: Callable[[], Answer | None],
        what: str,
        alike: Callable[[Answer, Answer], bool],
    ) -> Answer:
        """What two reports in a row agree on: a report has no checksum."""
        before = None
        for _ in range(REPORT_TRIES):
            report = self._answer(command, read, what)
            if before is not None and alike(report, before):
                return report
            before = report
        raise LinkError(f"The printer reports another {what} each time; let it come to rest.")

    def _answer(self, command: str, read: Callable[[], Answer | None], what: str) -> Answer:
        for _ in range(REPORT_TRIES):
            self._temperatures = self._position = None
            self._ask(command)
            value = read()
            if value is not None:
                return value
        raise LinkError(f"The printer does not report its {what} to {command}; is it a printer?")

    def _ask(self, command: str) -> list[ev.Event]:
        """Send one command outside of any job and return what is said until its `ok`."""
        if self._serial is None:  # nothing would ever answer
            raise LocalProtocolError("The printer is not connected; call connect() first.")
        with self._mutex:
            heard: list[ev.Event] = []
            while not self._link.ready:
                if self._link.ended:  # it would not be ready ever again
                    self._lost(self._link.ended_by or "it has ended")
                heard += self._pump()
            if command in self._asked:
                self._asked[command] += 1
            self._before_own_command()
            self._write(self._link.send(command, self._clock()))
            while not self._link.idle:
                heard += self._pump()
            return heard

    def _prove(self) -> None:
        """Make sure that the printer has received every line, whatever its `ok`s say.

        A question is carried out once and answered once: when all questions of a kind are
        answered, the last of them has been received, and with it every line before. Where one is
        missing, an answer was garbled, or the `ok`s are ahead of the printer: it is heard out, and
        from then on only new questions count. A firmware that verifies numbers tells its line
        instead, and also after anything that went wrong on the wire, or where there are more
        answers than questions: half of one was carried out without its number then. (Without
        numbers the link asks questions of its own where an `ok` is missing: more are no wonder.)
        """
        verifies = self._link.dialect.verifies
        for kind in (*("M114",) * 4, "M115", "M114", "M115"):
            self._ask(kind)
            spare = self._heard[kind] - self._asked[kind]
            doubtful = verifies and (self._went_wrong or spare > 0)
            if spare >= 0 and not doubtful:
                self._link.confirm()
                return
            self._settle(PROOF_QUIET_S)
            if verifies:
                self._prove_place()
                return
            self._asked[kind] = self._heard[kind] = 0
        self._lost("the printer does not prove that it received the last lines")

    def _prove_place(self) -> None:
        """Have the printer say which line it took last, until that is the last there is."""
        for _ in range(REPORT_TRIES):
            with self._mutex:
                self._write(self._link.ask_place(self._clock()))
                heard: list[ev.Event] = []
                while not self._link.idle:
                    heard += self._pump()
            if any(isinstance(event, ev.Proved) for event in heard):
                self._asked, self._heard = {"M114": 0, "M115": 0}, {"M114": 0, "M115": 0}
                self._went_wrong = False
                return
        self._lost("the printer does not prove that it received the last lines")

    def command(self, text: str) -> None:
        """Send one command of the host's own (parking, heating), outside any program."""
        self._ask(text)

    def hold_motors(self) -> bool:
        """Ask the firmware to hold its motors however long nothing moves; whether it will.

        Motors let go lose the nozzle's place. Where the time cannot be set (Klipper), it is left
        as it is: the firmware itself then refuses to move until it is homed.
        """
        dialect = self._link.dialect
        if not dialect.hold_motors:
            return dialect.motors_off_s == math.inf
        heard = self._ask(dialect.hold_motors)
        return not any(isinstance(event, ev.UnknownCommand) for event in heard)

    def finish_moves(self) -> None:
        """Return when every buffered move has been made."""
        self._ask("M400")

    # ------------------------------------------------------------------ the wire

    def _write(self, data: bytes) -> None:
        if self._log is not None:
            self._log.add(self._clock(), b">", data)
        try:
            while data:
                if not select.select([], [self._fd], [], MOST_WAIT_S)[1]:
                    self._lost("the port takes no bytes")
                written = os.write(self._fd, data)
                self._bytes_sent += written
                data = data[written:]
        except OSError as error:
            self._lost(f"the port failed ({error})")

    def _pump(self, limit_s: float | None = None) -> list[ev.Event]:
        """Wait for the printer or for a deadline of the link, and act on what comes."""
        wait_s = min(self._link.next_deadline_s() - self._clock(), MOST_WAIT_S)
        if limit_s is not None:
            wait_s = min(wait_s, limit_s)
        if not self._poll.poll(wait_s * 1000 + 0.5 if wait_s > 0 else 0):
            return self._digest(self._link.tick(self._clock()))
        data = self._read()
        return self._hear(data) if data is not None else []

    def _read(self) -> bytes | None:
        """What the printer said; None where somebody else has read it."""
        try:
            return os.read(self._fd, 65536)
        except BlockingIOError:
            return None
        except OSError as error:
            self._lost(f"the port failed ({error})")

    def _hear(self, data: bytes) -> list[ev.Event]:
        """Act on what the printer said."""
        if not data:
            self._lost("the port was closed")
        now_s = self._clock()
        if not self._greeted:
            self._said += data
        if self._log is not None:
            self._log.add(now_s, b"<", data)
        events = self._digest(self._link.receive(data, now_s))
        if not self._greeted and unreadable(self._said):
            failure = self._stranger()
            self._link.give_up(failure.why)
            raise failure
        return events

    def _digest(self, events: list[ev.Event]) -> list[ev.Event]:
        """Write what the link wants written, and act on what was said."""
        if output := self._link.take_output():
            self._write(output)
        for event in events:
            self._on_event(event)
        if self._ended_by:
            why, self._ended_by = self._ended_by, ""
            raise self._lost_error(why)
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure
        if self._link.ended:  # somebody has heard why, who was asked meanwhile
            raise self._lost_error(self._link.ended_by or "it has ended")
        return events

    def _lost(self, why: str) -> NoReturn:
        """Raise for a dead port."""
        self._link.give_up(why)
        raise self._lost_error(why)

    def _on_event(self, event: ev.Event) -> None:
        if isinstance(event, ev.Acknowledged):
            return
        self._went_wrong |= isinstance(event, WIRE_FAULTS)
        if isinstance(event, ev.TemperatureReport):
            self._temperatures = event
            if len(event.heads) > 1:
                self._heads |= event.heads.keys()
        elif isinstance(event, ev.PositionReport):
            self._position = event
            self._heard["M114"] += 1
        elif isinstance(event, ev.FirmwareInfo):
            self._heard["M115"] += 1
        elif isinstance(event, ev.Greeted):
            self._greeted = True
        elif isinstance(event, ev.ResendRequested):
            self._refused_numbers.append(event.number)
        elif isinstance(event, ev.Probed):
            self._stalls += 1
        elif isinstance(event, ev.UnknownCommand):
            if event.text not in self._warnings:
                self._warnings.append(event.text)
            self._failure = self._failure or fault_of(event.text)
        elif self._failure is not None:
            pass  # the first fault is the cause, the rest its consequences
        elif isinstance(event, ev.CommandFailed):
            self._failure = self._fault(event)
        elif isinstance(event, ev.LinkLost):
            self._failure = self._lost_error(event.why) if self._greeted else self._stranger()
        self._on_other_event(event)
