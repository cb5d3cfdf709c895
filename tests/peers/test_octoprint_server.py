"""A real OctoPrint server: our adapter drives it, and it prints through our emulated printer."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from link_helpers import profile, program
from octoprint_server import KEY, QUICK, Server, octoprint
from peer_harness import Printing, Web, end, wait_for

from gcode.errors import LinkError, PortBusyError, PrinterError
from gcode.firmware import EmulatedPrinterProcess
from gcode.hosts import LinkLostError
from gcode.hosts.octoprint import OctoPrintPrinter
from gcode.hosts.secret import ApiKey
from gcode.hosts.web import Address, WebTiming

pytestmark = pytest.mark.peers

# The virtual printer takes the time that its moves would take, from 200 mm/min on.
SHORT = ["G90", "G1 F60000", *(f"G1 X{50 + i / 100:.2f} Y50" for i in range(150))]
LONG = [
    "G90",
    "G1 F60000",
    *(line for i in range(200) for line in (f"G1 X{i / 100:.2f}", "G4 P40")),
]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with octoprint(tmp_path_factory.mktemp("octoprint"), "VIRTUAL") as found:
        yield found


def test_upload_print_temperatures_position(server: Server) -> None:
    with server.printer() as printer:
        assert printer.capabilities().firmware == "Virtual Marlin 1.0"
        printer.command("M104 S60")
        report = printer.print(program(SHORT))
        printer.finish_moves()
        there = printer.temperatures()
        x_mm, y_mm, z_mm = printer.position_mm()
        printer.heaters_off()
    assert report.ok
    assert report.lines_acked == len(SHORT)
    assert report.resends >= 1, "the virtual printer asks for line 100 again"
    assert there.hotend_target_c == 60.0
    assert (x_mm, y_mm, z_mm) == pytest.approx((51.49, 50.0, 0.0))


def test_pause_resume_cancel(server: Server) -> None:
    with server.printer() as printer:
        printing = Printing(printer, program(LONG))
        printing.wait_until(200.0)
        printer.pause()
        web = Web(server.base, KEY)
        wait_for("it rests", lambda: web.get("/api/job")["state"] == "Paused", server.log, 20.0)
        rests_at = web.get("/api/job")["progress"]["filepos"]
        with pytest.raises(PortBusyError, match="already"):
            printer.print(program(SHORT))
        printer.resume()
        printing.wait_until(rests_at + 200.0)
        printer.abort()
        report = printing.finish()
        web.http.close()
        assert printer.temperatures().hotend_target_c == 0.0
    assert report is not None, printing.error
    assert not report.ok
    assert report.next_line == 0, "what OctoPrint had sent is not known"


def test_a_users_own_key_will_do(server: Server) -> None:
    """The global key ends with OctoPrint 1.13."""
    web = Web(server.base, KEY)
    answer = web.http.post("/api/access/users/me/apikey")
    web.http.close()
    assert answer.status_code == 200, answer.text
    key = ApiKey(answer.json()["apikey"])
    with OctoPrintPrinter(Address.parse(f"octoprint+{server.base}"), key, timing=QUICK) as printer:
        assert printer.print(program(SHORT[:20])).ok
        assert printer.position_mm()[1] == pytest.approx(50.0)


def test_an_emergency_stop_ends_the_print(tmp_path: Path) -> None:
    with octoprint(tmp_path, "VIRTUAL") as server:
        printer = server.printer()
        printer.connect()
        printing = Printing(printer, program(LONG))
        printing.wait_until(200.0)
        printer.emergency_stop()
        printing.finish()
        printer.close()
    assert isinstance(printing.error, LinkLostError | PrinterError)
    assert "HEATERS COULD NOT BE REACHED" in str(printing.error)


def test_a_wrong_key_and_a_second_sender(server: Server) -> None:
    wrong = OctoPrintPrinter(Address.parse(f"octoprint+{server.base}"), ApiKey("WRONG"))
    with pytest.raises(LinkError, match="refuses the API key"):
        wrong.connect()
    with server.printer(), pytest.raises(PortBusyError):
        server.printer().connect()


def test_octoprint_prints_through_our_emulator_and_dies(tmp_path: Path) -> None:
    """As a host: every command once, in order. Then M112, then the server is killed."""
    record = tmp_path / "executed"
    lines = ["G28", "G1 F6000", *(f"G1 X{20 + i / 10:.1f} Y50 E0.01" for i in range(400))]
    faults = "line 60 corrupt_in\nline 120 lose_ok\nline 180 double_ok"
    with (
        EmulatedPrinterProcess(printer=profile(), record=record, faults=faults) as emulator,
        octoprint(tmp_path, emulator.port) as server,
    ):
        printer = server.printer()
        printer.connect()
        job = program(lines)
        parts = [printer.print(job, lines=part) for part in (range(150), range(150, len(lines)))]
        printer.finish_moves()
        assert printer.position_mm() == pytest.approx((59.9, 50.0, 0.0))
        executed = [row for row in record.read_text().splitlines() if row in set(lines)]
        assert all(part.ok for part in parts)
        assert executed == lines
        end(server.running)
        with pytest.raises(LinkError, match="cannot be reached"):
            printer.temperatures()
        printer.close()


def test_a_server_killed_in_mid_print_is_a_lost_job(tmp_path: Path) -> None:
    with octoprint(tmp_path, "VIRTUAL") as server:
        timing = WebTiming(request_s=2.0, answer_s=2.0, lost_s=1.0, poll_s=0.2)
        printer = OctoPrintPrinter(
            Address.parse(f"octoprint+{server.base}"), ApiKey(KEY), timing=timing
        )
        printer.connect()
        printing = Printing(printer, program(LONG))
        printing.wait_until(200.0)
        end(server.running)
        printing.finish()
        printer.close()
    assert isinstance(printing.error, LinkLostError)
    assert "HEATERS COULD NOT BE REACHED" in str(printing.error)
    assert printing.error.last_sent_line == len(LONG)
