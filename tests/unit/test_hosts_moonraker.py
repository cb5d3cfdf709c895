"""The Moonraker adapter against a server in this process that behaves as asked."""

from __future__ import annotations

import logging
import re
import threading
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
from link_helpers import moves, program
from web_harness import Answer, Asked, FakeServer

import gcode.hosts.server as server_host
from gcode.errors import LinkError, PortBusyError, PrinterError
from gcode.hosts import LinkLostError, PrintReport
from gcode.hosts.moonraker import MoonrakerPrinter
from gcode.hosts.secret import ApiKey
from gcode.hosts.web import Address, WebTiming

KEY = "SECRET0123456789"
QUICK = WebTiming(request_s=5.0, upload_s=5.0, answer_s=5.0, lost_s=0.4, poll_s=0.02)
JOB = program(["G28", "", "; a comment", *moves(20)])


class FakeMoonraker:
    """The API as Moonraker 0.11 answers it; `on_print` says what a print comes to."""

    def __init__(self) -> None:
        self.server = FakeServer(self.handle, on_message=self.called)
        self.klippy = "ready"
        self.objects: dict[str, dict[str, Any]] = {
            "webhooks": {"state": "ready", "state_message": "Printer is ready"},
            "print_stats": {"state": "standby", "filename": "", "message": ""},
            "virtual_sdcard": {"file_position": 0},
            "extruder": {"temperature": 204.8, "target": 205.0},
            "gcode_move": {"gcode_position": [1.5, 2.25, 3.0, 0.0]},
            "toolhead": {"homed_axes": "xyz"},
        }
        self.files: dict[str, bytes] = {}
        self.begun: float | None = None
        self.uploads: list[bytes] = []
        self.calls: list[str] = []
        self.scripts: list[str] = []
        self.on_print: Callable[[], None] = self.finish
        self.on_script: Callable[[str], dict[str, Any]] = lambda script: {"result": "ok"}

    def handle(self, asked: Asked) -> Answer:
        name = f"{asked.method} {asked.path}"
        if asked.headers.get("x-api-key") != KEY:
            return 401, {"error": {"code": 401, "message": "Unauthorized"}}
        if name == "GET /server/info":
            return 200, {"result": {"klippy_state": self.klippy}}
        if name == "POST /printer/emergency_stop":
            self.shut_down("Shutdown due to webhooks request")
            return 200, {"result": "ok"}
        if name == "POST /server/files/upload":
            parts = asked.body.split(b"--" + asked.headers["content-type"].split("=")[1].encode())
            fields = {}
            for part in parts[1:-1]:
                head, _, data = part.strip(b"\r\n").partition(b"\r\n\r\n")
                match = re.search(rb' name="(\w+)"', head)
                assert match is not None
                fields[match.group(1).decode()] = data
                if file := re.search(rb'filename="(.*?)"', head):
                    fields["filename"] = file.group(1)
            data = part_of(asked.body)
            if sha256(data).hexdigest() != fields["checksum"].decode():
                return 422, {"error": {"message": "checksum"}}
            self.files[fields["filename"].decode()] = data
            self.uploads.append(data)
            return 201, {"result": {}}
        if name.startswith("GET /server/files/list"):
            return 200, {"result": [{"path": file, "modified": 1.0} for file in self.files]}
        if name.startswith("GET /server/files/metadata"):
            return 200, {"result": {"print_start_time": self.begun}}
        assert asked.method == "DELETE"
        del self.files[asked.path.removeprefix("/server/files/gcodes/")]
        return 200, {"result": {}}

    def called(self, message: dict[str, Any]) -> None:
        method, params = message["method"], message["params"]
        self.calls.append(method)
        answer: dict[str, Any] = {"result": "ok"}
        if method == "server.info":
            answer = {"result": {"klippy_state": self.klippy}}
        elif method in {"printer.objects.subscribe", "printer.objects.query"}:
            found = {name: self.objects.get(name, {}) for name in params["objects"]}
            answer = {"result": {"status": found}}
        elif method == "printer.gcode.script":
            self.scripts.append(params["script"])
            answer = self.on_script(params["script"])
        elif method == "printer.info":
            answer = {"result": {"software_version": "v0.13"}}
        elif method == "printer.objects.list":
            answer = {"result": {"objects": ["virtual_sdcard"]}}
        elif method == "printer.print.cancel":
            self.stats(state="cancelled")
        elif method == "printer.print.pause":
            self.stats(state="paused")
        elif method == "printer.print.resume":
            self.stats(state="printing")
        if answer:
            self.server.push({"jsonrpc": "2.0", "id": message["id"], **answer})
        if method == "printer.print.start":
            self.objects["print_stats"].update(state="printing", filename=params["filename"])
            threading.Thread(target=self.on_print).start()

    def stats(self, **changed: str) -> None:
        self.tell({"print_stats": changed})

    def tell(self, status: dict[str, Any]) -> None:
        for name, changed in status.items():
            self.objects[name].update(changed)
        self.server.push({"method": "notify_status_update", "params": [status, 1.0]})

    def finish(self) -> None:
        (data,) = self.files.values()
        self.tell({"virtual_sdcard": {"file_position": len(data)}})
        self.stats(state="complete")

    def shut_down(self, why: str) -> None:
        self.klippy = "shutdown"
        self.tell({"webhooks": {"state": "shutdown", "state_message": why}})


def part_of(body: bytes) -> bytes:
    match = re.search(rb'filename=".*?"\r\n.*?\r\n\r\n(.*?)\r\n--', body, re.DOTALL)
    assert match is not None
    return match.group(1)


@pytest.fixture(autouse=True)
def _no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_host, "require_checked", lambda checked: None)


@pytest.fixture
def fake() -> Iterator[FakeMoonraker]:
    moonraker = FakeMoonraker()
    with moonraker.server:
        yield moonraker


def printer_at(fake: FakeMoonraker, key: str = KEY, **options: Any) -> MoonrakerPrinter:
    address = Address.parse(f"moonraker+{fake.server.base}")
    return MoonrakerPrinter(address, ApiKey(key), **{"timing": QUICK, **options})


def test_a_print_is_uploaded_whole_and_followed_to_its_end(fake: FakeMoonraker) -> None:
    told: list[float] = []
    with printer_at(fake) as printer:
        report = printer.print(JOB, progress=lambda stage, done, total: told.append(done / total))
        part = printer.print(JOB, lines=range(3, 6))
    assert fake.uploads[0] == JOB.program.text.encode()
    assert fake.uploads[1].decode().split("\n") == [*moves(3), ""]
    assert (report.ok, report.lines_acked) == (True, 21)
    # regression: first_line was left out, and so 0
    assert (part.lines_acked, part.first_line, part.next_line) == (3, 3, 6)
    assert told[-1] == 1.0
    assert fake.files == {}


def test_questions(fake: FakeMoonraker) -> None:
    with printer_at(fake) as printer:
        assert printer.position_mm() == (1.5, 2.25, 3.0)
        assert printer.capabilities().firmware == "Klipper v0.13"
        assert printer.capabilities().caps["VIRTUAL_SDCARD"]
        assert not printer.capabilities().caps["PAUSE_RESUME"]
        there = printer.temperatures()
        printer.finish_moves()
    assert (there.hotend_c, there.hotend_target_c, there.bed_c) == (204.8, 205.0, None)
    assert fake.scripts == ["M400"]


def test_arcs_go_only_to_a_klipper_that_has_them(fake: FakeMoonraker) -> None:
    # regression: without [gcode_arcs] Klipper says "unknown command" and prints on without them
    arcs = program(["G28", "G2 X60 Y50 I5 J0 E1"])
    with printer_at(fake) as printer:
        fake.objects["configfile"] = {"settings": {"extruder": {}}}
        with pytest.raises(PrinterError, match=r"first in line 2.*gcode_arcs"):
            printer.print(arcs)
        assert not fake.uploads
        fake.objects["configfile"] = {"settings": {"gcode_arcs": {"resolution": 1.0}}}
        assert printer.print(arcs).ok


def test_a_long_script_is_waited_for(fake: FakeMoonraker) -> None:
    """Moonraker#437: a script takes as long as its moves; no request time-out ends it."""
    fake.on_script = lambda script: {}
    done = threading.Event()
    with printer_at(fake) as printer:
        vars(printer)["_open"]._timing = WebTiming(request_s=0.05)
        thread = threading.Thread(target=lambda: (printer.finish_moves(), done.set()))
        thread.start()
        assert not done.wait(0.2), "four time-outs of a request have passed"
        fake.server.push({"id": 999, "result": "ok"})  # somebody else's answer
        assert not done.wait(0.05)
        fake.server.push({"id": 4, "result": "ok"})
        thread.join(5)
    assert done.is_set()


def test_the_key_shows_nowhere(
    fake: FakeMoonraker, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    log = tmp_path / "wire.log"
    with printer_at(fake, wire_log=log) as printer:
        printer.print(JOB)
        shown = repr(printer) + repr(vars(printer))
    assert all(asked.headers["x-api-key"] == KEY for asked in fake.server.asked)
    assert "printer.print.start" in log.read_text()
    for place in (log.read_text(), shown, caplog.text):
        assert KEY not in place


@pytest.mark.parametrize(("key", "what"), [("", "none is set"), ("WRONG", "refuses the API key")])
def test_a_missing_or_wrong_key_is_told_apart(fake: FakeMoonraker, key: str, what: str) -> None:
    with pytest.raises(LinkError, match=what) as caught:
        printer_at(fake, key).connect()
    assert caught.value.exit_code == 4


@pytest.mark.parametrize("klippy", ["startup", "disconnected"])
def test_a_klipper_that_is_not_ready_is_refused(fake: FakeMoonraker, klippy: str) -> None:
    fake.klippy = klippy
    with pytest.raises(LinkError, match=rf"is not ready \(it is {klippy}\)"):
        printer_at(fake).connect()


def test_a_klipper_that_has_shut_down_is_refused(fake: FakeMoonraker) -> None:
    fake.shut_down("MCU 'mcu' shutdown: ADC out of range\nOnce the underlying issue is corrected")
    with pytest.raises(PrinterError, match=r"ADC out of range\); mend the cause and run FIRM"):
        printer_at(fake).connect()


def test_a_printer_that_prints_already_is_refused(fake: FakeMoonraker) -> None:
    fake.objects["print_stats"].update(state="paused", filename="benchy.gcode")
    with pytest.raises(PortBusyError, match=r"is printing 'benchy.gcode' already"):
        printer_at(fake).connect()


def test_a_refused_script_carries_klippers_words(fake: FakeMoonraker) -> None:
    said = """{'error': 'CommandError', 'message': 'Must home axis first: 1.0 [0.0]'}"""
    fake.on_script = lambda script: {"error": {"code": 400, "message": said}}
    with (
        printer_at(fake) as printer,
        pytest.raises(PrinterError, match=r"script: Must home axis first: 1\.0"),
    ):
        printer.command("G1 X1")


def test_pause_resume_and_cancel(fake: FakeMoonraker) -> None:
    begun = threading.Event()
    fake.on_print = begun.set
    report: list[PrintReport] = []
    with printer_at(fake) as printer:
        thread = threading.Thread(target=lambda: report.append(printer.print(JOB)))
        thread.start()
        assert begun.wait(5)
        printer.pause()
        assert fake.objects["print_stats"]["state"] == "paused"
        printer.resume()
        half = JOB.program.text.index(moves(10)[-1])
        fake.tell({"virtual_sdcard": {"file_position": half}})
        printer.abort()
        thread.join(5)
    assert not report[0].ok
    assert report[0].next_line == 3 + 9, "what Klipper took is carried out, no more is claimed"
    assert report[0].lines_acked == 1 + 9
    assert fake.scripts == ["TURN_OFF_HEATERS\nM107", "G91\nG1 Z5 F600\nG90"]


def test_a_cancel_macro_that_resets_the_file_is_a_cancel(fake: FakeMoonraker) -> None:
    begun, plain = threading.Event(), fake.called

    def cancel(message: dict[str, Any]) -> None:
        if message["method"] == "printer.print.cancel":
            fake.stats(state="standby", filename="")
            fake.server.push({"id": message["id"], "result": "ok"})
        else:
            plain(message)

    fake.server.on_message = cancel
    fake.on_print = begun.set
    report: list[PrintReport] = []
    with printer_at(fake) as printer:
        thread = threading.Thread(target=lambda: report.append(printer.print(JOB)))
        thread.start()
        assert begun.wait(5)
        printer.abort()
        thread.join(5)
    assert not report[0].ok


def test_an_unhomed_printer_is_not_lifted(fake: FakeMoonraker) -> None:
    fake.objects["toolhead"]["homed_axes"] = ""
    with printer_at(fake) as printer:
        printer.abort()
    assert fake.scripts == ["TURN_OFF_HEATERS\nM107"]


def test_an_interrupt_cancels_the_print_on_the_server(fake: FakeMoonraker) -> None:
    def interrupt(stage: str, done: float, total: float) -> None:
        raise KeyboardInterrupt

    fake.on_print = lambda: None
    with printer_at(fake) as printer, pytest.raises(KeyboardInterrupt):
        printer.print(JOB, progress=interrupt)
    assert "printer.print.cancel" in fake.calls
    assert fake.scripts[0] == "TURN_OFF_HEATERS\nM107"


def test_the_emergency_stop_has_its_own_endpoint_and_ends_the_print(fake: FakeMoonraker) -> None:
    begun = threading.Event()
    fake.on_print = begun.set
    caught: list[Exception] = []

    def go() -> None:
        try:
            printer.print(JOB)
        except PrinterError as error:
            caught.append(error)

    with printer_at(fake) as printer:
        thread = threading.Thread(target=go)
        thread.start()
        assert begun.wait(5)
        printer.emergency_stop()
        thread.join(5)
    assert "M112" not in "".join(fake.scripts), "a script would wait its turn"
    assert "Shutdown due to webhooks request; lines 1 to 24 are uncertain" in str(caught[0])


def test_an_unknown_command_is_told_once(fake: FakeMoonraker) -> None:
    """Regression: on a serial port it was, through Moonraker nobody heard of it."""
    said = '// Unknown command:"M900"'

    def prints() -> None:
        for text in (said, said, "// probe at 1,2 is z=0.1"):
            fake.server.push({"method": "notify_gcode_response", "params": [text]})
        fake.finish()

    fake.on_print = prints
    with printer_at(fake) as printer:
        assert printer.print(JOB).warnings == (said,)
        fake.on_print = fake.finish
        assert printer.print(JOB).warnings == ()


def test_an_unknown_command_ends_the_print_where_it_matters(fake: FakeMoonraker) -> None:
    fake.on_print = lambda: fake.server.push(
        {"method": "notify_gcode_response", "params": ['// Unknown command:"G2"']}
    )
    with (
        pytest.raises(PrinterError, match="does not know G2"),
        printer_at(fake) as printer,
    ):
        printer.print(JOB)
    assert "printer.print.cancel" in fake.calls
    assert fake.scripts[0] == "TURN_OFF_HEATERS\nM107"


def test_a_failing_command_in_the_file_is_the_printers_fault(fake: FakeMoonraker) -> None:
    fake.on_print = lambda: fake.stats(state="error", message="Extrude below minimum temp\nSee")
    with (
        pytest.raises(PrinterError, match="Extrude below minimum temp") as caught,
        printer_at(fake) as p,
    ):
        p.print(JOB)
    assert "Heaters were told to switch off." in str(caught.value), "its target is still 205"
    assert fake.scripts.count("TURN_OFF_HEATERS\nM107") == 1


def test_a_moonraker_that_restarts_finds_klipper_printing_on(fake: FakeMoonraker) -> None:
    def restart() -> None:
        fake.server.drop_sockets()
        fake.objects["print_stats"]["state"] = "complete"  # told to nobody

    fake.on_print = restart
    with printer_at(fake) as printer:
        assert printer.print(JOB).ok
    assert len(fake.server.socket_headers) == 2


def test_a_klipper_that_restarts_has_lost_the_job(fake: FakeMoonraker) -> None:
    def restart() -> None:
        fake.tell({"virtual_sdcard": {"file_position": 60}})
        fake.server.push({"method": "notify_klippy_disconnected", "params": []})
        fake.objects["print_stats"].update(state="standby", filename="")
        fake.server.push({"method": "notify_klippy_ready", "params": []})

    fake.on_print = restart
    with printer_at(fake) as printer, pytest.raises(LinkLostError) as caught:
        printer.print(JOB, lines=range(3, 12))
    assert (caught.value.last_executed_line, caught.value.last_sent_line) == (2, 11)
    assert "no longer knows the file" in str(caught.value)


def test_a_server_that_stays_away_lets_klipper_print_on(fake: FakeMoonraker) -> None:
    def die() -> None:
        fake.klippy = "disconnected"
        fake.server.drop_sockets()

    fake.on_print = die
    with pytest.raises(LinkLostError, match="may be printing on by itself"), printer_at(fake) as p:
        p.print(JOB)
