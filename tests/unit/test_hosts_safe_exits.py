"""Printers behind a server are left cold whatever the server does, and another's print alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import pytest
from test_hosts_moonraker import FakeMoonraker
from test_hosts_moonraker import printer_at as moonraker_at
from test_hosts_octoprint import JOB, FakeOctoPrint
from test_hosts_octoprint import printer_at as octoprint_at
from web_harness import Answer, Asked

import gcode.hosts.server as server_host
from gcode.errors import LinkError, PortBusyError
from gcode.hosts.port import LinkLostError, Temperatures
from gcode.hosts.web import heaters_word

OFF = ["M104 S0", "M140 S0", "M107"]


@pytest.fixture(autouse=True)
def _no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_host, "require_checked", lambda checked: None)


@pytest.fixture
def octoprint() -> Iterator[FakeOctoPrint]:
    fake = FakeOctoPrint()
    fake.on_print = fake.push
    with fake.server:
        yield fake


@pytest.fixture
def moonraker() -> Iterator[FakeMoonraker]:
    fake = FakeMoonraker()
    fake.on_print = lambda: None
    with fake.server:
        yield fake


def interrupt(stage: str, done: float, total: float) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("status", [302, 400, 500])
def test_octoprint_that_does_not_cancel_is_cooled_all_the_same(
    octoprint: FakeOctoPrint, status: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Regression: after a 500 nobody switched anything off; after others all passed for well."""
    octoprint.refuse["POST", "/api/job"] = (status, {"error": "no"})
    with octoprint_at(octoprint) as printer, pytest.raises(KeyboardInterrupt):
        printer.print(JOB, progress=interrupt)
    assert octoprint.commands == OFF, "a print that goes on is not lifted from"
    assert "Heaters were told to switch off, BUT ITS PRINT GOES ON" in caplog.text
    assert "stop it there" in caplog.text


def test_octoprint_that_is_slow_to_cancel_is_cooled_all_the_same(
    octoprint: FakeOctoPrint, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(octoprint, "control", lambda command: (204, None))
    printer = octoprint_at(octoprint)
    printer._timing = server_host.WebTiming(answer_s=0.1, poll_s=0.02)
    with printer, pytest.raises(KeyboardInterrupt):
        printer.print(JOB, progress=interrupt)
    assert octoprint.commands[:3] == OFF


def test_a_klipper_whose_cancel_macro_fails_is_cooled_all_the_same(
    moonraker: FakeMoonraker, caplog: pytest.LogCaptureFixture
) -> None:
    """Regression: its macro's error was the end of it, and the heaters stayed on."""
    plain = moonraker.called

    def called(message: dict[str, Any]) -> None:
        if message["method"] != "printer.print.cancel":
            plain(message)
        else:
            error = {"code": 400, "message": "Move out of range"}
            moonraker.server.push({"id": message["id"], "error": error})

    moonraker.server.on_message = called
    with moonraker_at(moonraker) as printer, pytest.raises(KeyboardInterrupt):
        printer.print(JOB, progress=interrupt)
    assert moonraker.scripts == ["TURN_OFF_HEATERS\nM107"]
    assert "BUT ITS PRINT GOES ON" in caplog.text
    assert "Move out of range" in caplog.text


@pytest.mark.parametrize("silent", ["printer.print.cancel", "printer.gcode.script"])
def test_a_klipper_that_heats_on_for_minutes_is_told_of(
    moonraker: FakeMoonraker, caplog: pytest.LogCaptureFixture, silent: str
) -> None:
    """Regression: who pressed Ctrl+C while it heated waited without a word until that was over."""
    plain = moonraker.called
    moonraker.server.on_message = lambda message: (
        None if message["method"] == silent else plain(message)
    )
    with moonraker_at(moonraker) as printer, pytest.raises(KeyboardInterrupt):
        printer.print(JOB, progress=interrupt)
    assert f"is silent for 0.4 s while {silent} was under way" in caplog.text
    loud = "BUT ITS PRINT GOES ON" if "cancel" in silent else "HEATERS COULD NOT BE REACHED"
    assert loud in caplog.text


def test_anothers_print_is_neither_cancelled_nor_cooled(
    octoprint: FakeOctoPrint, moonraker: FakeMoonraker
) -> None:
    """Regression: who began between our greeting and our print lost it as we gave way."""
    with octoprint_at(octoprint) as printer:
        octoprint.file, octoprint.flags = "benchy.gcode", {"operational": True, "printing": True}
        with pytest.raises(PortBusyError):
            printer.print(JOB)
        for end in (printer.abort, printer.heaters_off):
            with pytest.raises(PortBusyError, match=r"printing 'benchy.gcode'.*not ours"):
                end()
    assert octoprint.flags["printing"]
    assert octoprint.commands == []
    with moonraker_at(moonraker) as klipper:
        moonraker.stats(state="printing", filename="benchy.gcode")
        with pytest.raises(PortBusyError):
            klipper.print(JOB)
        for end in (klipper.abort, klipper.heaters_off):
            with pytest.raises(PortBusyError, match=r"printing 'benchy.gcode'.*not ours"):
                end()
    assert moonraker.scripts == []
    assert "printer.print.cancel" not in moonraker.calls


def asked(ask: Callable[[], object], why: str) -> None:
    """Either there is an answer, or one sentence says why there is none."""
    with suppress(LinkError):
        ask()
        return
    with pytest.raises(LinkError, match=why):
        ask()


@pytest.mark.parametrize("said", [{"tool0": {"actual": "hot", "target": [1]}}, [], "x", {"bed": 1}])
def test_temperatures_that_are_none_are_one_sentence(octoprint: FakeOctoPrint, said: Any) -> None:
    octoprint.heaters = said
    if isinstance(said, dict) and "bed" in said:
        octoprint.heaters = {"tool0": {"actual": 20.0, "target": 0.0}, "bed": {"actual": {}}}
    with octoprint_at(octoprint) as printer:
        printer.abort()
        asked(printer.temperatures, "temperature")


@pytest.mark.parametrize(
    "said",
    [
        {"extruder": {"temperature": None}},
        {"extruder": {"temperature": "hot", "target": {}}},
        {"heaters": {"available_heaters": 3}},
        {"toolhead": {"extruder": ["extruder"], "homed_axes": None}},
        {"gcode_move": {}},
        {"gcode_move": {"gcode_position": [1.0]}},
        {"gcode_move": {"gcode_position": "xyz"}},
    ],
)
def test_what_klipper_cannot_mean_is_one_sentence(
    moonraker: FakeMoonraker, said: dict[str, Any]
) -> None:
    moonraker.objects |= said
    with moonraker_at(moonraker) as printer:
        printer.abort()
        for ask in (printer.temperatures, printer.position_mm, printer.motors_held):
            asked(ask, "Moonraker at")
    assert "TURN_OFF_HEATERS\nM107" in moonraker.scripts


def test_one_hot_head_of_several_is_not_off() -> None:
    """Regression: the chosen one and the bed alone were asked."""
    cold = Temperatures(20.0, 0.0, 20.0, 0.0, (0.0, 0.0))
    hot = Temperatures(20.0, 0.0, 20.0, 0.0, (0.0, 180.0))
    assert heaters_word(lambda: cold) == "Heaters are off."
    assert heaters_word(lambda: hot) == "Heaters were told to switch off."


def test_a_print_whose_start_is_not_confirmed_is_cancelled(octoprint: FakeOctoPrint) -> None:
    """Regression: the server may have begun it; a loop told the heaters, and it printed on."""
    plain = octoprint.handle

    def starts(asked: Asked) -> Answer:
        answer = plain(asked)
        begins = asked.method == "POST" and asked.path.startswith("/api/files/local/")
        return (500, {"error": "Gateway"}) if begins else answer

    octoprint.server.handle = starts
    with octoprint_at(octoprint) as printer, pytest.raises(LinkLostError, match="whether it began"):
        printer.print(JOB)
    assert octoprint.text == "Operational"
    assert octoprint.commands[:3] == OFF


def test_a_print_that_nobody_names_is_cooled(
    octoprint: FakeOctoPrint, moonraker: FakeMoonraker
) -> None:
    """Where a server does not say what it prints, it is taken for ours: hot is the worse error."""
    with octoprint_at(octoprint) as printer:
        octoprint.file, octoprint.flags = "", {"operational": True, "cancelling": True}
        printer.heaters_off()
    assert octoprint.commands[:3] == OFF
    with moonraker_at(moonraker) as klipper:
        moonraker.stats(state="printing", filename="")
        klipper.heaters_off()
    assert moonraker.scripts == ["TURN_OFF_HEATERS\nM107"]
