"""A real Moonraker server, driven by our adapter, with a stand-in for Klipper's API socket."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from link_helpers import program
from peer_harness import HERE, MOONRAKER, Printing, Web, end, free_port, peer, process, wait_for

from gcode.errors import LinkError, PortBusyError, PrinterError
from gcode.hosts import LinkLostError
from gcode.hosts.moonraker import MoonrakerPrinter
from gcode.hosts.secret import ApiKey
from gcode.hosts.web import Address, WebTiming

pytestmark = pytest.mark.peers

# Nobody is trusted: every client needs the key.
AUTHORIZATION = """\
[authorization]
enable_api_key: True
"""
QUICK = WebTiming(answer_s=20.0, lost_s=30.0, poll_s=0.2)
LINES_PER_S = 200
SHORT = ["G28", *(f"G1 X{i / 10:.1f} Y50 E{i / 10:.1f}" for i in range(150))]
LONG = ["G28", *(f"G1 X{i / 10:.1f} Y50 E{i / 10:.1f}" for i in range(1200))]


class Stack:
    """Klipper's stand-in and Moonraker, each of which may be ended and started again."""

    def __init__(self, folder: Path, keep: ExitStack) -> None:
        self.folder, self.keep = folder, keep
        self.record, self.log = folder / "executed", folder / "moonraker.log"
        self.klippy, self.own = folder / "klippy.sock", folder / "moonraker.sock"
        self.port = free_port()
        for name in ("config", "gcodes", "logs", "database"):
            (folder / name).mkdir()
        text = MOONRAKER.format(port=self.port, klippy=self.klippy) + AUTHORIZATION
        (folder / "config" / "moonraker.conf").write_text(text)
        self.start_klipper()
        self.start_moonraker()
        wait_for("Moonraker answers", self.own_key, self.log)
        self.web = Web(f"http://127.0.0.1:{self.port}", self.key)
        self.wait_ready()

    def start_klipper(self) -> None:
        script = HERE / "klippy_standin.py"
        gcodes, rate = self.folder / "gcodes", str(LINES_PER_S)
        command = (peer("moonraker"), script, self.klippy, gcodes, self.record, rate)
        self.klipper = self.keep.enter_context(process(*command, log=self.folder / "klippy.log"))

    def start_moonraker(self) -> None:
        command = (peer("moonraker"), "-m", "moonraker", "-d", self.folder, "-u", self.own)
        self.moonraker = self.keep.enter_context(process(*command, log=self.log))

    def own_key(self) -> bool:
        """Ask for the API key on Moonraker's own socket, which only this user can open."""
        try:
            with socket.socket(socket.AF_UNIX) as connection:
                connection.connect(str(self.own))
                request = {"jsonrpc": "2.0", "method": "access.get_api_key", "id": 1}
                connection.sendall(json.dumps(request).encode() + b"\x03")
                self.key = str(json.loads(connection.recv(4096).rstrip(b"\x03"))["result"])
        except (OSError, ValueError, KeyError):
            return False
        return True

    def wait_ready(self) -> None:
        def ready() -> bool:
            info = self.web.get("/server/info").get("result", {})
            return bool(info.get("klippy_state") == "ready")

        wait_for("Klipper is ready", ready, self.log)

    def printer(self) -> MoonrakerPrinter:
        address = Address.parse(f"moonraker+{self.web.base}")
        return MoonrakerPrinter(address, ApiKey(self.key), timing=QUICK)

    def executed(self) -> list[str]:
        return [row for row in self.record.read_text().splitlines() if row in set(LONG + SHORT)]


@pytest.fixture
def stack(tmp_path: Path) -> Iterator[Stack]:
    with ExitStack() as keep:
        found = Stack(tmp_path, keep)
        yield found
        found.web.http.close()


def test_upload_print_temperatures_position(stack: Stack) -> None:
    with stack.printer() as printer:
        assert printer.capabilities().firmware == "Klipper stand-in-1"
        printer.command("M104 S205\nM140 S60")
        job, half = program(SHORT), len(SHORT) // 2
        parts = [printer.print(job, lines=part) for part in (range(half), range(half, len(SHORT)))]
        printer.finish_moves()
        there = printer.temperatures()
        assert printer.position_mm() == pytest.approx((14.9, 50.0, 0.0))
        printer.heaters_off()
        assert printer.temperatures().hotend_target_c == 0.0
    assert all(part.ok for part in parts)
    assert sum(part.lines_acked for part in parts) == len(SHORT)
    assert stack.executed() == SHORT
    assert (there.hotend_target_c, there.bed_target_c) == (205.0, 60.0)


def test_pause_resume_cancel(stack: Stack) -> None:
    with stack.printer() as printer:
        printing = Printing(printer, program(LONG))
        printing.wait_until(500.0)
        printer.pause()
        rests_at = len(stack.executed())
        with pytest.raises(PortBusyError, match="already"):
            printer.print(program(SHORT))
        assert len(stack.executed()) <= rests_at + 1
        printer.resume()
        printing.wait_until(printing.done_bytes + 1000.0)
        printer.abort()
        report = printing.finish()
    assert report is not None, printing.error
    assert not report.ok
    done = stack.executed()
    assert done == LONG[: len(done)]
    assert 0 < report.next_line <= len(done), "no more is claimed than was carried out"


def test_a_wrong_key_is_refused(stack: Stack) -> None:
    wrong = MoonrakerPrinter(Address.parse(f"moonraker+{stack.web.base}"), ApiKey("WRONG"))
    with pytest.raises(LinkError, match="refuses the API key"):
        wrong.connect()


def test_the_emergency_stop_ends_the_print_at_once(stack: Stack) -> None:
    with stack.printer() as printer:
        printing = Printing(printer, program(LONG))
        printing.wait_until(500.0)
        printer.emergency_stop()
        done = len(stack.executed())
        printing.finish()
        assert len(stack.executed()) <= done + 1
    assert isinstance(printing.error, PrinterError)
    assert "Shutdown due to webhooks request" in str(printing.error)
    with pytest.raises(PrinterError, match="FIRMWARE_RESTART"):
        stack.printer().connect()


def test_moonraker_restarts_in_mid_print_and_the_print_is_followed_on(stack: Stack) -> None:
    with stack.printer() as printer:
        printing = Printing(printer, program(LONG))
        printing.wait_until(500.0)
        end(stack.moonraker)
        stack.start_moonraker()
        report = printing.finish()
    assert report is not None, printing.error
    assert report.ok
    assert stack.executed() == LONG


def test_klipper_restarts_in_mid_print_and_the_job_is_lost(stack: Stack) -> None:
    with stack.printer() as printer:
        printing = Printing(printer, program(LONG))
        printing.wait_until(500.0)
        end(stack.klipper)
        stack.start_klipper()
        printing.finish()
    error = printing.error
    assert isinstance(error, LinkLostError)
    assert "no longer knows the file" in str(error)
    done = stack.executed()
    assert done == LONG[: len(done)]
    assert error.last_executed_line < len(done) <= error.last_sent_line + 1


def test_both_die(stack: Stack) -> None:
    printer = stack.printer()
    printer._timing = WebTiming(request_s=2.0, lost_s=1.0, poll_s=0.2)
    printer.connect()
    printing = Printing(printer, program(LONG))
    printing.wait_until(500.0)
    end(stack.moonraker)
    end(stack.klipper)
    printing.finish()
    printer.close()
    assert isinstance(printing.error, LinkLostError)
    assert "may be printing on by itself" in str(printing.error)
    assert "HEATERS COULD NOT BE REACHED" in str(printing.error)
