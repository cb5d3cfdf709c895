"""The OctoPrint adapter against a server in this process that behaves as asked."""

from __future__ import annotations

import json
import logging
import re
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from hashlib import sha1
from pathlib import Path
from typing import Any

import pytest
from link_helpers import moves, program
from web_harness import Answer, Asked, FakeServer

import gcode.hosts.server as server_host
from gcode.errors import InputError, LinkError, PortBusyError, PrinterError
from gcode.hosts import LinkLostError, PrintReport, connect
from gcode.hosts.octoprint import OctoPrintPrinter
from gcode.hosts.secret import ApiKey, find_key
from gcode.hosts.web import Address, WebTiming
from tests.commands import here

KEY = "SECRET0123456789"
QUICK = WebTiming(request_s=5.0, upload_s=5.0, answer_s=5.0, lost_s=0.3, poll_s=0.02)
JOB = program(["G28", "", "; a comment", *moves(20)])
AT_REST = {"operational": True, "ready": True, "printing": False}


class FakeOctoPrint:
    """The API as OctoPrint 1.11 answers it; `on_print` says what a print comes to."""

    def __init__(self) -> None:
        self.server = FakeServer(self.handle, self.greet)
        self.flags: dict[str, bool] = dict(AT_REST)
        self.text, self.error = "Operational", ""
        self.files: dict[str, bytes] = {}
        self.file = ""
        self.completion: float | None = None
        self.file_position = 0
        self.commands: list[str] = []
        self.heaters = {"tool0": {"actual": 205.4, "target": 205.0}}
        self.alter: Callable[[bytes], bytes] = lambda data: data
        self.on_print: Callable[[], None] = self.finish
        self.refuse: dict[tuple[str, str], Answer] = {}
        self.prints: dict[str, dict[str, Any]] = {}
        self.place = "X:1.50 Y:2.25 Z:3.00 E:0.00"

    def handle(self, asked: Asked) -> Answer:
        if asked.headers.get("x-api-key") != KEY:
            return 403, {"error": "You don't have the permission"}
        if (asked.method, asked.path) in self.refuse:
            return self.refuse[asked.method, asked.path]
        name = f"{asked.method} {asked.path}"
        if name == "GET /api/version":
            return 200, {"api": "0.1", "server": "1.11.8", "text": "OctoPrint 1.11.8"}
        if name == "POST /api/login":
            return 200, {"name": "me", "session": "5e5510n"}
        if name == "GET /api/printer":
            if self.flags.get("closedOrError"):
                return 409, {"error": "Printer is not operational"}
            return 200, {"state": {"flags": self.flags}, "temperature": self.heaters}
        if name == "GET /api/job":
            return 200, self.news()
        if name == "POST /api/job":
            return self.control(asked.json)
        if name == "POST /api/printer/command":
            return self.send(asked.json)
        return self.storage(asked)

    def storage(self, asked: Asked) -> Answer:
        name = asked.path.removeprefix("/api/files/local").strip("/")
        if asked.method == "POST" and not name:
            match = re.search(rb'filename="(.*?)"\r\n.*?\r\n\r\n(.*)\r\n--', asked.body, re.DOTALL)
            assert match is not None
            self.files[match.group(1).decode()] = self.alter(match.group(2))
            return 201, {"done": True}
        if asked.method == "GET" and not name:
            rows = [
                {"path": file, "date": 1.0, "prints": self.prints.get(file, {})}
                for file in self.files
            ]
            return 200, {"files": rows}
        if asked.method == "GET":
            data = self.files[name]
            return 200, {"size": len(data), "hash": sha1(data).hexdigest()}
        if asked.method == "DELETE":
            return 204, self.files.pop(name) and None
        assert asked.json == {"command": "select", "print": True}
        self.file, self.flags = name, {"operational": True, "printing": True}
        self.text, self.completion = "Printing", 0.0
        threading.Thread(target=self.on_print).start()
        return 204, None

    def control(self, command: dict[str, Any]) -> Answer:
        if not self.flags.get("printing") and not self.flags.get("paused"):
            return 409, {"error": "Printer is neither printing nor paused"}
        if command["command"] == "cancel":
            self.end("PrintCancelled")
        elif command["action"] == "pause":
            self.change(paused=True)
        else:
            assert command["action"] == "resume"
            self.change(printing=True)
        return 204, None

    def send(self, command: dict[str, Any]) -> Answer:
        if self.flags.get("closedOrError"):
            return 409, {"error": "Printer is not operational"}
        for text in command["commands"]:
            self.commands.append(text)
            answers = {
                "M105": ["T:21.50 /60.00 B:22.00 /0.00"],
                "M114": [f"{self.place} Count X:150"],
                "M115": ["FIRMWARE_NAME:Marlin 2.1.2 PROTOCOL_VERSION:1.0", "Cap:EEPROM:1"],
            }.get(text, [])
            said = ["T:20.0 /0.0", *answers, "ok"]
            logs = ["Recv: ok", f"Send: N9 {text}*77", *(f"Recv: {line}" for line in said)]
            self.push(logs=logs)
        return 204, None

    def news(self) -> dict[str, Any]:
        return {
            "state": self.text,
            "error": self.error,
            "job": {"file": {"path": self.file, "name": self.file}},
            "progress": {"completion": self.completion, "filepos": self.file_position},
        }

    def push(self, kind: str = "current", logs: list[str] | None = None) -> None:
        state = {"text": self.text, "error": self.error, "flags": self.flags}
        self.server.push({kind: {**self.news(), "state": state, "logs": logs or []}})

    def greet(self) -> None:
        self.push("history")

    def change(self, **flags: bool) -> None:
        self.flags = {"operational": True, **flags}
        self.push()

    def event(self, kind: str, **payload: object) -> None:
        self.server.push({"event": {"type": kind, "payload": {"path": self.file, **payload}}})

    def end(self, kind: str) -> None:
        self.event(kind)
        self.text = "Operational"
        self.completion = 100.0 if kind == "PrintDone" else None
        self.change(**AT_REST)

    def finish(self) -> None:
        self.file_position = len(self.files[self.file])
        self.prints[self.file] = {"success": 1, "last": {"success": True, "date": time.time()}}
        self.push()
        self.end("PrintDone")

    def break_down(self) -> None:
        self.file_position = 60
        self.push()
        self.text, self.error = "Error", "MINTEMP triggered"
        self.change(closedOrError=True, error=True)


@pytest.fixture(autouse=True)
def _no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_host, "require_checked", lambda checked: None)


@pytest.fixture
def fake() -> Iterator[FakeOctoPrint]:
    octoprint = FakeOctoPrint()
    with octoprint.server:
        yield octoprint


def printer_at(fake: FakeOctoPrint, key: str = KEY, **options: Any) -> OctoPrintPrinter:
    address = Address.parse(f"octoprint+{fake.server.base}")
    return OctoPrintPrinter(address, ApiKey(key), timing=QUICK, **options)


def test_a_print_is_uploaded_whole_and_followed_to_its_end(fake: FakeOctoPrint) -> None:
    seen: list[bytes] = []
    fake.alter = lambda data: seen.append(data) or data
    told: list[float] = []
    with printer_at(fake) as printer:
        report = printer.print(JOB, progress=lambda stage, done, total: told.append(done / total))
    assert seen == [JOB.program.text.encode()]
    assert report.ok
    assert report.lines_acked == 21
    assert report.next_line == JOB.program.text.count("\n") + 1
    assert told[-1] == 1.0
    assert fake.files == {}, "what is printed is not left on the server"


def test_a_part_of_a_program_uploads_that_part(fake: FakeOctoPrint) -> None:
    seen: list[bytes] = []
    fake.alter = lambda data: seen.append(data) or data
    with printer_at(fake) as printer:
        report = printer.print(JOB, lines=range(3, 6))
    assert seen[0].decode().split("\n") == [*moves(3), ""]
    # regression: first_line was left out, and so 0
    assert (report.lines_acked, report.first_line, report.next_line) == (3, 3, 6)


def test_an_unknown_command_is_told_once(fake: FakeOctoPrint) -> None:
    said = 'echo:Unknown command: "M900 K0.1"'

    def prints() -> None:
        fake.push(logs=["Send: N9 M900 K0.1*77", f"Recv: {said}", f"Recv: {said}", "Recv: ok"])
        fake.finish()

    fake.on_print = prints
    with printer_at(fake) as printer:
        assert printer.print(JOB).warnings == (said,)


def test_questions_are_answered_from_the_terminal(fake: FakeOctoPrint) -> None:
    with printer_at(fake) as printer:
        assert printer.position_mm() == (1.5, 2.25, 3.0)
        assert printer.capabilities().firmware == "Marlin 2.1.2"
        assert printer.capabilities().caps["EEPROM"]
        there = printer.temperatures()
        printer.finish_moves()
    assert (there.hotend_c, there.hotend_target_c, there.bed_c) == (205.4, 205.0, None)
    assert fake.commands == ["M114", "M115", "M400"]


def test_temperatures_that_nobody_polled_yet_are_asked_for(fake: FakeOctoPrint) -> None:
    fake.heaters = {}
    with printer_at(fake) as printer:
        there = printer.temperatures()
    assert (there.hotend_c, there.hotend_target_c) == (21.5, 60.0)
    assert (there.bed_c, there.bed_target_c) == (22.0, 0.0)


def test_the_key_travels_in_the_header_and_shows_nowhere_else(
    fake: FakeOctoPrint, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    log = tmp_path / "wire.log"
    with printer_at(fake, wire_log=log) as printer:
        printer.print(JOB)
        shown = repr(printer) + repr(vars(printer)) + str(ApiKey(KEY))
    assert all(asked.headers["x-api-key"] == KEY for asked in fake.server.asked)
    assert KEY not in "".join(asked.path for asked in fake.server.asked)
    text = log.read_text()
    assert "POST /api/login" in text
    assert "PrintDone" in text
    for place in (text, shown, caplog.text):
        assert KEY not in place
        assert "5e5510n" not in place


@pytest.mark.parametrize(("key", "what"), [("", "none is set"), ("WRONG", "refuses the API key")])
def test_a_missing_or_wrong_key_is_told_apart(fake: FakeOctoPrint, key: str, what: str) -> None:
    with pytest.raises(LinkError, match=what) as caught:
        printer_at(fake, key).connect()
    assert caught.value.exit_code == 4
    assert "OCTOPRINT_API_KEY" in str(caught.value)
    assert "WRONG" not in str(caught.value)


def test_a_server_that_is_not_there_is_one_sentence() -> None:
    printer = OctoPrintPrinter(Address.parse("octoprint+http://127.0.0.1:9"), ApiKey(KEY))
    with pytest.raises(LinkError, match=r"OctoPrint at http://127.0.0.1:9 cannot be reached"):
        printer.connect()
    with pytest.raises(LinkError, match="cannot be reached"):  # the lock was given back
        printer.connect()


def test_a_server_without_a_printer_is_refused(fake: FakeOctoPrint) -> None:
    fake.text, fake.flags = "Offline", {"closedOrError": True}
    with pytest.raises(LinkError, match=r"not operational \(it says 'Offline'\)"):
        printer_at(fake).connect()


def test_a_moonraker_that_answers_as_octoprint_is_named(fake: FakeOctoPrint) -> None:
    text = {"text": "OctoPrint (Moonraker v0.11.0)"}
    fake.refuse["GET", "/api/version"] = (200, text)
    with pytest.raises(LinkError, match=r"write moonraker\+http://127"):
        printer_at(fake).connect()


@pytest.mark.parametrize("answer", [None, [], {}, {"state": 1}, {"state": {"flags": []}}])
def test_something_else_behind_the_address_is_one_sentence(
    fake: FakeOctoPrint, answer: object
) -> None:
    fake.refuse["GET", "/api/printer"] = (200, answer)
    with pytest.raises(LinkError, match="does not answer as OctoPrint does"):
        printer_at(fake).connect()


def test_a_printer_that_prints_already_is_refused(fake: FakeOctoPrint) -> None:
    fake.flags, fake.file, fake.completion = {"printing": True}, "benchy.gcode", 31.0
    printer = printer_at(fake)
    with pytest.raises(PortBusyError, match=r"printing 'benchy.gcode' already \(31 %\)"):
        printer.connect()
    printer.abort()
    assert fake.flags == {"printing": True}, "another's print was cancelled"


def test_somebody_else_who_starts_first_keeps_the_printer(fake: FakeOctoPrint) -> None:
    plain = fake.handle
    fake.server.handle = lambda asked: (
        (409, {"error": "Printer is already printing"})
        if asked.method == "POST" and asked.path.startswith("/api/files/local/")
        else plain(asked)
    )
    with printer_at(fake) as printer, pytest.raises(PortBusyError, match="already printing"):
        printer.print(JOB)
    assert "M104 S0" not in fake.commands, "another's print was cooled down"


def test_an_upload_that_was_altered_is_not_printed(fake: FakeOctoPrint) -> None:
    fake.alter = lambda data: data.replace(b"G28", b"G29")
    with printer_at(fake) as printer, pytest.raises(LinkError, match="another file"):
        printer.print(JOB)
    assert fake.file == ""


def test_a_second_sender_is_refused(fake: FakeOctoPrint) -> None:
    with printer_at(fake), pytest.raises(PortBusyError, match="is held by process"):
        printer_at(fake).connect()


def test_pause_and_resume_name_their_action(fake: FakeOctoPrint) -> None:
    begun = threading.Event()
    fake.on_print = begun.set
    report: list[PrintReport] = []
    with printer_at(fake) as printer:
        thread = threading.Thread(target=lambda: report.append(printer.print(JOB)))
        thread.start()
        assert begun.wait(5)
        printer.pause()
        printer.pause()  # without an action it would toggle
        assert fake.flags == {"operational": True, "paused": True}
        printer.resume()
        fake.finish()
        thread.join(5)
    assert report[0].ok


def test_pausing_nothing_says_so(fake: FakeOctoPrint) -> None:
    with printer_at(fake) as printer, pytest.raises(LinkError, match="neither printing nor paused"):
        printer.pause()


def test_abort_cancels_cools_and_lifts(fake: FakeOctoPrint) -> None:
    begun = threading.Event()
    fake.on_print = begun.set
    report: list[PrintReport] = []
    with printer_at(fake) as printer:
        thread = threading.Thread(target=lambda: report.append(printer.print(JOB)))
        thread.start()
        assert begun.wait(5)
        printer.abort()
        thread.join(5)
    assert not report[0].ok
    assert report[0].next_line == 0
    assert fake.commands == ["M104 S0", "M140 S0", "M107", "G91", "G1 Z5 F600", "G90"]


def test_an_interrupt_cancels_the_print_on_the_server(fake: FakeOctoPrint) -> None:
    def interrupt(stage: str, done: float, total: float) -> None:
        raise KeyboardInterrupt

    fake.on_print = fake.push
    with printer_at(fake) as printer, pytest.raises(KeyboardInterrupt):
        printer.print(JOB, progress=interrupt)
    assert fake.text == "Operational"
    assert fake.commands[:3] == ["M104 S0", "M140 S0", "M107"]


def test_a_fault_of_the_printer_names_what_is_uncertain(fake: FakeOctoPrint) -> None:
    fake.on_print = fake.break_down
    printer = printer_at(fake)
    printer.connect()
    with pytest.raises(PrinterError, match="MINTEMP triggered; lines 1 to 24 are") as caught:
        printer.print(JOB)
    printer.close()
    assert "HEATERS COULD NOT BE REACHED" in str(caught.value)
    assert f"read up to line {JOB.program.text[:60].count(chr(10)) + 1}" in str(caught.value)


def test_an_end_that_was_missed_is_asked_for(fake: FakeOctoPrint) -> None:
    def drop() -> None:
        fake.completion, fake.flags, fake.text = 100.0, dict(AT_REST), "Operational"
        fake.server.drop_sockets()

    fake.on_print = drop
    with printer_at(fake) as printer:
        assert printer.print(JOB).ok
    assert len(fake.server.socket_headers) == 2


def test_news_that_never_come_are_asked_for(fake: FakeOctoPrint) -> None:
    def end_in_silence() -> None:
        fake.completion, fake.flags, fake.text = 100.0, dict(AT_REST), "Operational"

    fake.on_print = end_in_silence
    with printer_at(fake) as printer:
        assert printer.print(JOB).ok


def test_a_server_that_forgot_the_print_is_a_lost_job(fake: FakeOctoPrint) -> None:
    def restart() -> None:
        fake.file, fake.completion, fake.flags = "", None, dict(AT_REST)
        fake.text = "Operational"
        fake.server.drop_sockets()

    fake.on_print = restart
    with printer_at(fake) as printer, pytest.raises(LinkLostError) as caught:
        printer.print(JOB, lines=range(3, 12))
    assert (caught.value.last_executed_line, caught.value.last_sent_line) == (2, 11)
    assert "Heaters were told to switch off." in str(caught.value), "its target is still 205"


def test_a_server_that_stays_away_may_print_on(fake: FakeOctoPrint) -> None:
    def die() -> None:
        fake.refuse = {("GET", "/api/job"): (502, {"error": "Bad Gateway"})}
        fake.refuse["POST", "/api/login"] = fake.refuse["GET", "/api/job"]
        fake.server.drop_sockets()

    fake.on_print = die
    with pytest.raises(LinkLostError, match="may be printing on by itself"), printer_at(fake) as p:
        p.print(JOB)


def test_the_emergency_stop_is_m112_at_once(fake: FakeOctoPrint) -> None:
    with printer_at(fake) as printer:
        printer.emergency_stop()
    assert fake.commands == ["M112"]


def test_gcode_send_prints_through_it(
    fake: FakeOctoPrint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = tmp_path / "job.gcode"
    job.write_text("G28\nG1 X10 Y10 F6000\n")
    port = f"octoprint+{fake.server.base}"

    def send(key: str) -> subprocess.CompletedProcess[str]:
        monkeypatch.setenv("OCTOPRINT_API_KEY", key)
        return here("send", job, "--port", port, "--json", program="gcode")

    done = send(KEY)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["lines_acked"] == 2
    assert fake.commands == ["M400"]
    refused = send("WR0NG")
    assert refused.returncode == json.loads(refused.stdout)["exit_code"] == 4
    assert "refuses the API key" in refused.stderr
    assert "WR0NG" not in refused.stderr + refused.stdout


# ---------------------------------------------------------------------- addresses and keys


@pytest.mark.parametrize("kind", ["octoprint", "moonraker"])
@pytest.mark.parametrize("rest", ["http://me:5ECRET@host", "http://host?apikey=5ECRET"])
def test_a_secret_in_the_address_is_refused_and_not_repeated(kind: str, rest: str) -> None:
    with pytest.raises(InputError, match="environment variable") as caught:
        connect(f"{kind}+{rest}")
    assert "5ECRET" not in str(caught.value)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    "port", ["octoprint+ftp://host", "octoprint+http://", "moonraker+http://h:x"]
)
def test_an_address_that_is_none_is_refused(port: str) -> None:
    with pytest.raises(InputError, match="no address of a print server"):
        connect(port)


def test_a_port_names_its_adapter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OCTOPRINT_API_KEY", KEY)
    printer = connect("octoprint+http://octopi.local:5000/")
    assert isinstance(printer, OctoPrintPrinter)
    assert printer.address.base == "http://octopi.local:5000"


def test_a_journal_is_for_serial_ports(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="leave --journal out"):
        connect("octoprint+http://host", journal=tmp_path / "j")


def test_keys_come_from_the_environment_or_a_private_file(tmp_path: Path) -> None:
    spec = "moonraker+http://voron.local:7125"
    place = {"XDG_CONFIG_HOME": str(tmp_path)}
    assert find_key("moonraker", spec, place).headers == {}
    path = tmp_path / "gcode" / "keys.toml"
    path.parent.mkdir()
    path.write_text(f'"{spec}" = "{KEY}"\n')
    path.chmod(0o644)
    with pytest.raises(InputError, match=r"others may read it \(mode 644\)") as caught:
        find_key("moonraker", spec, place)
    assert KEY not in str(caught.value)
    path.chmod(0o600)
    assert find_key("moonraker", spec, place).value == KEY
    assert find_key("octoprint", "octoprint+http://other", place).value == ""
    given = {**place, "MOONRAKER_API_KEY": "FROM_ENVIRONMENT"}
    assert find_key("moonraker", spec, given).value == "FROM_ENVIRONMENT"


@pytest.mark.parametrize("text", [f"{KEY} =", '"SPEC" = 7', f'"SPEC" = "{KEY}ä"'])
def test_a_keys_file_that_is_wrong_does_not_leak(tmp_path: Path, text: str) -> None:
    path = tmp_path / "gcode" / "keys.toml"
    path.parent.mkdir()
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(InputError) as caught:
        find_key("octoprint", "SPEC", {"XDG_CONFIG_HOME": str(tmp_path)})
    assert KEY not in str(caught.value)
