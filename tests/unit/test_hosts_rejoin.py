"""Print servers that were left in the middle of a job: what they say of it, and going on."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from link_helpers import moves, program
from test_hosts_moonraker import KEY as MOON_KEY
from test_hosts_moonraker import QUICK as MOON_QUICK
from test_hosts_moonraker import FakeMoonraker
from test_hosts_octoprint import FakeOctoPrint, printer_at

import gcode.hosts.server as server_host
from gcode.errors import PortBusyError
from gcode.hosts import ResumeRefusedError
from gcode.hosts.moonraker import MoonrakerPrinter
from gcode.hosts.rejoin import rejoin
from gcode.hosts.secret import ApiKey
from gcode.hosts.upload import JobFile
from gcode.hosts.web import Address

JOB = program(["G28", "G90", "M83", "M140 S60", *moves(10), "G1 X1.5 Y2.25 Z3 F600", *moves(3)])
LINES = range(0, 15)  # it rests at 1.5, 2.25, 3
RELEASE_C = 40.0


@pytest.fixture(autouse=True)
def _no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_host, "require_checked", lambda checked: None)


@pytest.fixture
def octo() -> Iterator[FakeOctoPrint]:
    fake = FakeOctoPrint()
    fake.heaters = {
        "tool0": {"actual": 205.0, "target": 0.0}, "bed": {"actual": 59.0, "target": 60.0},
    }  # fmt: skip
    with fake.server:
        yield fake


@pytest.fixture
def moon() -> Iterator[FakeMoonraker]:
    fake = FakeMoonraker()
    fake.objects["heater_bed"] = {"temperature": 59.0, "target": 60.0}
    with fake.server:
        yield fake


def moon_printer(fake: FakeMoonraker) -> MoonrakerPrinter:
    address = Address.parse(f"moonraker+{fake.server.base}")
    return MoonrakerPrinter(address, ApiKey(MOON_KEY), timing=MOON_QUICK)


def gone_on(printer: Any, *, done: bool = False, **options: Any) -> Any:
    try:
        return rejoin(printer, JOB, LINES, done=done, before=(), release_c=RELEASE_C, **options)
    finally:
        printer.close()


def left_there(fake: Any) -> str:
    """A part's file, as a killed sender left it."""
    job = JobFile.of(JOB, LINES)
    fake.files[job.name] = job.data
    return job.name


def test_a_part_s_file_stays_until_the_next_begins(octo: FakeOctoPrint) -> None:
    printer = printer_at(octo)
    printer.connect()
    printer.print(JOB, lines=LINES)
    (first,) = octo.files
    printer.print(JOB, lines=range(15, 18))
    (second,) = octo.files
    assert second != first
    printer.close()
    assert not octo.files


def test_what_never_began_is_printed(octo: FakeOctoPrint, moon: FakeMoonraker) -> None:
    assert gone_on(printer_at(octo)) is None
    assert gone_on(moon_printer(moon)) is None
    for fake in (octo, moon):  # uploaded, not started: it goes, and is sent anew
        left_there(fake)
    assert gone_on(printer_at(octo)) is None
    assert gone_on(moon_printer(moon)) is None
    assert not octo.files
    assert not moon.files


def test_what_is_under_way_is_followed_to_its_end(octo: FakeOctoPrint, moon: FakeMoonraker) -> None:
    octo.file = left_there(octo)
    octo.flags, octo.text, octo.completion = {"operational": True, "printing": True}, "P", 40.0
    threading.Timer(1.0, octo.finish).start()
    report = gone_on(printer_at(octo))
    assert (report.ok, report.first_line, report.next_line) == (True, 0, 15)
    moon.objects["print_stats"].update(state="printing", filename=left_there(moon))
    threading.Timer(1.0, moon.finish).start()
    report = gone_on(moon_printer(moon))
    assert (report.ok, report.next_line) == (True, 15)
    assert not any("print.start" in call for call in moon.calls)


def test_what_ended_unnoticed_is_reported_once(octo: FakeOctoPrint, moon: FakeMoonraker) -> None:
    octo.file = left_there(octo)
    octo.finish()
    assert gone_on(printer_at(octo)).ok
    moon.objects["print_stats"].update(state="complete", filename=left_there(moon))
    assert gone_on(moon_printer(moon)).ok
    assert gone_on(moon_printer(moon), done=True) is None  # its end was known


def test_what_failed_or_was_overtaken_is_refused(octo: FakeOctoPrint, moon: FakeMoonraker) -> None:
    octo.prints[left_there(octo)] = {"failure": 1, "last": {"success": False, "date": 1.0}}
    with pytest.raises(ResumeRefusedError, match="failed, or was cancelled"):
        gone_on(printer_at(octo))
    left_there(moon)
    moon.begun = 1.0
    moon.objects["print_stats"].update(state="standby", filename="other.gcode")
    with pytest.raises(ResumeRefusedError, match="failed, or was cancelled"):
        gone_on(moon_printer(moon))


def test_somebody_else_s_print_is_left_alone(octo: FakeOctoPrint, moon: FakeMoonraker) -> None:
    octo.file, octo.flags = "other.gcode", {"operational": True, "printing": True}
    with pytest.raises(PortBusyError, match=r"other\.gcode"):
        gone_on(printer_at(octo))
    moon.objects["print_stats"].update(state="printing", filename="other.gcode")
    with pytest.raises(PortBusyError, match=r"other\.gcode"):
        gone_on(moon_printer(moon))


def test_a_moved_nozzle_a_cold_bed_free_motors_and_a_long_rest_are_refused(
    octo: FakeOctoPrint, moon: FakeMoonraker
) -> None:
    octo.file = left_there(octo)
    octo.finish()
    late = octo.prints[octo.file]["last"]["date"] + 500.0
    with pytest.raises(ResumeRefusedError, match="has rested for 5"):
        gone_on(printer_at(octo), wall_clock=lambda: late)
    octo.file = left_there(octo)
    octo.finish()
    with pytest.raises(ResumeRefusedError, match="has rested for a time no clock tells"):
        gone_on(printer_at(octo), wall_clock=lambda: late - 1000.0)  # regression: 0 s
    left_there(octo)
    octo.prints[octo.file] = {"success": 1, "last": {"success": True}}
    octo.files = {octo.file: octo.files.popitem()[1]}
    octo.place = "X:7.00 Y:2.25 Z:3.00 E:0.00"
    with pytest.raises(ResumeRefusedError, match="the nozzle is at X7"):
        gone_on(printer_at(octo))
    name = left_there(moon)
    moon.objects["print_stats"].update(state="complete", filename=name)
    moon.objects["heater_bed"]["temperature"] = 30.0
    with pytest.raises(ResumeRefusedError, match="the bed is at 30"):
        gone_on(moon_printer(moon))
    moon.files[name] = b"G28\n"
    moon.objects["toolhead"]["homed_axes"] = ""
    with pytest.raises(ResumeRefusedError, match="motors were let go"):
        gone_on(moon_printer(moon), pose_confirmed=True)
    moon.files[name] = b"G28\n"
    moon.objects["toolhead"]["homed_axes"] = "xyz"
    moon.objects["heater_bed"]["target"] = 0.0
    gone_on(moon_printer(moon), pose_confirmed=True)
    assert "M190 S60" in moon.scripts  # somebody has looked: it is heated again


@pytest.mark.parametrize(
    "rows", [None, 3, "x", [None, 3], [{"path": None}], [{"path": "amrepair", "date": "now"}]]
)
def test_a_list_of_files_that_is_none_names_no_part(octo: FakeOctoPrint, rows: object) -> None:
    octo.refuse["GET", "/api/files/local"] = (200, {"files": rows})
    with printer_at(octo) as printer:
        assert printer._left("gcode-") is None
