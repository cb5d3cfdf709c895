"""What the emulated firmwares answer, and where the dialects part."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))
from link_helpers import profile

from gcode.errors import InputError
from gcode.firmware import FirmwareCore, parse_faults
from gcode.firmware.serve import PtyServer
from gcode.hosts.modes import Modes, follow
from gcode.protocol import checksum

DIALECTS = ("marlin", "prusa", "klipper", "reprap")


class Talk:
    """Commands in, answers out, the printer's clock as told."""

    def __init__(self, firmware: str = "marlin") -> None:
        self.core = FirmwareCore(profile(), firmware)
        self.machine = self.core.machine
        self.core.power_up()
        self.core.take_output()

    def say(self, *lines: str, limit_s: float = float("inf")) -> list[str]:
        for line in lines:
            self.core.feed(line.encode() + b"\n")
            self.core.run(limit_s)
        return self.core.take_output().decode("latin-1").splitlines()

    def later(self, seconds: float) -> list[str]:
        until_s = self.machine.clock_s + seconds
        self.core.run(until_s)
        self.core.pass_time(until_s)
        return self.core.take_output().decode("latin-1").splitlines()


def test_a_line_that_waits_for_room_is_busy_with_it() -> None:
    """As a native Marlin is: a full queue of slow moves is no silence."""
    talk = Talk()
    talk.say("G28")
    said = talk.say("G1 F60", *(f"G1 X{5 + i % 2 * 5}" for i in range(40)))
    assert "echo:busy: processing" not in said  # who is accelerated waits for nothing
    now_s = talk.machine.clock_s - 20.0
    talk.say("G1 X1", limit_s=now_s)
    for tenth in range(45):
        talk.core.run(now_s + 0.1 * tenth)
    assert talk.core.take_output().decode().splitlines() == ["echo:busy: processing"] * 2


def numbered(number: int, command: str, *, off: int = 0) -> str:
    body = f"N{number} {command}"
    return f"{body}*{checksum(body.encode()) ^ off}"


@pytest.mark.parametrize("firmware", DIALECTS)
@pytest.mark.parametrize(("heat", "heater"), [("M109 S60", "hotend"), ("M190 S60", "bed")])
def test_heating_is_told_every_second_and_busy_every_two(
    firmware: str, heat: str, heater: str
) -> None:
    talk = Talk(firmware)
    said = talk.say(heat, limit_s=10.0)
    reports = [line for line in said if line.startswith(("T:", "B:"))]
    busy = [line for line in said if "busy: processing" in line]
    assert len(reports) == 10
    assert len(busy) == (5 if firmware in ("marlin", "prusa") else 0)
    assert not any(line.startswith("ok") for line in said)
    end = talk.say(limit_s=1e6) or talk.later(1e5)
    assert end[-1] == "ok"
    assert getattr(talk.machine, heater).temperature_c(talk.machine.clock_s) == pytest.approx(60.0)
    assert talk.machine.clock_s > 10.0


def test_a_heater_follows_its_curve() -> None:
    """First order: a third of the way takes less than half of the time, and cooling is slower."""
    talk = Talk()
    talk.say("M104 S200")
    talk.later(30.0)
    early_c = talk.machine.hotend.temperature_c(talk.machine.clock_s)
    talk.later(30.0)
    later_c = talk.machine.hotend.temperature_c(talk.machine.clock_s)
    assert 22.0 < early_c < later_c < 200.0
    assert later_c - early_c < early_c - 22.0
    assert talk.say("M105") == [f"ok T:{later_c:.2f} /200.00 B:22.00 /0.00 @:0 B@:0"]


def test_reports_come_by_themselves() -> None:
    talk = Talk()
    assert talk.say("M155 S2", "M154 S3") == ["ok", "ok"]
    said = [line for _ in range(6) for line in talk.later(1.0)]
    assert sum(line.startswith(" T:") for line in said) == 3
    assert sum(line.startswith("X:0.00 Y:0.00 Z:0.00 E:0.00 ") for line in said) == 2
    talk.say("M155 S0", "M154 S0")
    assert talk.later(20.0) == []


@pytest.mark.parametrize("firmware", DIALECTS)
def test_m400_is_answered_when_the_planner_is_empty(firmware: str) -> None:
    talk = Talk(firmware)
    talk.say("G28", "G1 X100 F600")
    began_s = talk.machine.clock_s
    assert talk.machine.planner.blocks
    assert "ok" not in talk.say("M400", limit_s=began_s + 5.0)
    assert talk.later(20.0)[-1] == "ok"
    assert not talk.machine.planner.blocks


def test_the_planners_queue_holds_up_the_answer() -> None:
    """Sixteen moves of a second each: the first are taken at once, then one as one ends."""
    talk = Talk()
    talk.say("G28", "M400")
    began_s = talk.machine.clock_s
    for index in range(40):
        talk.say(f"G1 X{10 * (index % 2) + 5} F600")
    waited_s = talk.machine.clock_s - began_s
    assert 20.0 < waited_s < 40.0


@pytest.mark.parametrize(("firmware", "ends"), [("marlin", True), ("prusa", False)])
def test_m108_ends_a_wait_where_it_passes_the_queue(firmware: str, ends: bool) -> None:
    talk = Talk(firmware)
    talk.say("M109 S200", limit_s=5.0)
    said = talk.say("M108", limit_s=6.0)
    assert ("ok" in said) == ends
    assert (talk.machine.wait is None) == ends


@pytest.mark.parametrize("firmware", ["marlin", "prusa", "reprap"])
def test_m112_stops_for_good(firmware: str) -> None:
    talk = Talk(firmware)
    talk.say("M104 S200", "M140 S60")
    said = talk.say("M112")
    assert any("M112" in line or "halted" in line for line in said)
    assert (talk.machine.hotend.target_c, talk.machine.bed.target_c) == (0.0, 0.0)
    assert talk.say("G28", "M105") == []


def test_a_klipper_that_has_shut_down_answers_on() -> None:
    """As a live one did (tests/peers/test_klipper_live.py): it passes the queue, too."""
    talk = Talk("klipper")
    talk.say("M104 S200", "M140 S60", "G28", limit_s=200.0)
    said = talk.say("M109 S220", "M112", limit_s=201.0)
    warm_c = talk.machine.hotend.temperature_c(talk.machine.clock_s)
    assert said.count("// Klipper state: Shutdown") == 1
    assert talk.say("") == talk.say("M104 S0") != []
    assert talk.say("G1 X5")[-2:] == ["!! Shutdown due to M112 command", "ok"]
    (report,) = talk.say("M105")
    assert "/220.0" in report, "it goes on telling its targets"
    talk.machine.let_pass(talk.machine.clock_s + 300.0)
    assert talk.machine.hotend.temperature_c(talk.machine.clock_s) < warm_c


def test_klipper_takes_no_inches() -> None:
    assert Talk("klipper").say("G20")[0].startswith("!! ")


def test_m410_drops_what_is_queued() -> None:
    talk = Talk()
    talk.say("G28", "M400", "G1 X100 F600", "G1 X0", "G1 X100")
    talk.later(3.0)
    assert talk.say("M410")[-1] == "ok"
    assert not talk.machine.planner.blocks
    x_mm = talk.machine.x
    assert 0.0 < x_mm < 100.0
    assert talk.say("M114")[0].startswith(f"X:{x_mm:.2f} ")


def test_g29_takes_its_time_and_tells_a_grid() -> None:
    talk = Talk()
    talk.say("G28")
    began_s = talk.machine.clock_s
    said = talk.say("G29")
    assert said.index("Bilinear Leveling Grid:") < said.index("ok")
    assert talk.machine.clock_s - began_s > 30.0


@pytest.mark.parametrize(
    ("firmware", "name", "capabilities"),
    [("marlin", "Marlin", 9), ("prusa", "Prusa-Firmware", 3), ("klipper", "Klipper", 0),
     ("reprap", "RepRapFirmware", 0)],
)  # fmt: skip
def test_who_is_there(firmware: str, name: str, capabilities: int) -> None:
    said = Talk(firmware).say("M115")
    assert any("FIRMWARE_NAME:" in line and name in line for line in said)
    assert sum(line.startswith("Cap:") for line in said) == capabilities


@pytest.mark.parametrize("firmware", DIALECTS)
def test_a_bad_line_is_refused_dropped_or_taken(firmware: str) -> None:
    """Checksum, then number: Marlin verifies both, RepRapFirmware one, Klipper none."""
    talk, first = Talk(firmware), "M117 one"
    assert talk.say(numbered(1, first))[-1] == "ok"
    wrong_sum = talk.say(numbered(2, "M117 two", off=1))
    wrong_number = talk.say(numbered(7, "M117 seven"))
    if firmware in ("marlin", "prusa"):
        for said in (wrong_sum, wrong_number):
            assert said[0].startswith("Error:")
            assert said[1:] == ["Resend: 2", "ok"]
        assert talk.machine.message == "one"
    else:
        assert wrong_sum == ([] if firmware == "reprap" else ["ok"])
        assert wrong_number == ["ok"]
        assert talk.machine.message == "seven"


@pytest.mark.parametrize("firmware", DIALECTS)
def test_an_unknown_command_is_told_and_acknowledged(firmware: str) -> None:
    said = Talk(firmware).say("M9999 X1")
    assert said[-1] == "ok"
    assert len(said) == 2
    assert "M9999" in said[0]


COLD = "!! Extrude below minimum temp"


def test_a_klipper_makes_no_move_that_it_refuses() -> None:
    """As a live one: place and extruder stay, the feed is the refused move's, modes are kept."""
    talk = Talk("klipper")
    talk.machine.min_extrude_c = 170.0
    assert talk.say("G1 X5") == ["!! Must home axis first: 5.000 0.000 0.000 [0.000]", "ok"]
    talk.say("G28", "G1 X50 Y50 Z5 F6000", "M400")
    here = ["X:50.000 Y:50.000 Z:5.000 E:0.000", "ok"]
    for line, said in (
        ("G1 X500 F900", "!! Move out of range: 500.000 50.000 5.000 [0.000]"),
        ("G1 Z-5 F900", "!! Move out of range: 50.000 50.000 -5.000 [0.000]"),
        ("G1 X60 E2 F900", COLD),
        ("G1 E-1 F900", COLD),
    ):
        assert talk.say(line)[-2:] == [said, "ok"]
        assert talk.say("M114") == here
        assert talk.machine.feed_mm_s == 15.0
    talk.say("M82", "G92 E3", "G91")
    assert talk.say("G1 X-500")[-2].startswith("!! Move out of range: -450.000")
    assert talk.say("M114") == ["X:50.000 Y:50.000 Z:5.000 E:3.000", "ok"]
    talk.say("G90", "G1 X100 Y100")
    before = len(talk.machine.planner.executed)
    said = talk.say("G2 X100 Y99.9 I100 J0")
    assert [line[:20] for line in said] == ["!! Move out of range", "ok"], (
        "once, not chord by chord"
    )
    assert len(talk.machine.planner.executed) > before, "and it stays where the arc left the bed"
    assert talk.machine.y > 101.0


def test_a_marlin_does_as_much_of_a_move_as_it_can() -> None:
    talk = Talk("marlin")
    talk.machine.min_extrude_c = 170.0
    talk.say("G28", "G1 X50 Y50 Z5 F6000")
    assert talk.say("G1 X500 E2") == ["echo: cold extrusion prevented", "ok"]
    talk.say("M400")
    assert talk.machine.x == 210.0
    assert talk.say("M114")[0].startswith("X:210.00 Y:50.00 Z:5.00 E:2.00 Count X:16800 Y:4000 Z:")


@pytest.mark.parametrize(
    ("firmware", "heads", "line", "said"),
    [
        ("marlin", 1, "T0", []),
        ("marlin", 1, "T1", ["echo:T1 Invalid extruder"]),
        ("marlin", 2, "T1", []),
        ("marlin", 2, "P0 S1", []),
        ("prusa", 5, "T5", ["echo:T5 Invalid extruder"]),
        ("klipper", 1, "T1", ['// Unknown command:"T1"']),
        ("klipper", 2, "T1", []),
        ("klipper", 1, "P0", ['// Unknown command:"P0"']),
        ("klipper", 1, "foo BAR=1", ['// Unknown command:"FOO"']),
    ],
)
def test_tools_that_are_there_and_that_are_not(
    firmware: str, heads: int, line: str, said: list[str]
) -> None:
    core = FirmwareCore(profile().model_copy(update={"heads": heads}), firmware)
    core.feed(line.encode() + b"\n")
    core.run()
    assert core.take_output().decode().splitlines() == [*said, "ok"]


@pytest.mark.parametrize("there", ["file", "folder", "nowhere"])
def test_a_port_takes_the_place_of_nothing(there: str, tmp_path: Path) -> None:
    """Regression: 'gcode emulate --link FILE' put its port in the place of that file."""
    link = tmp_path / "port"
    if there == "file":
        link.write_text("precious")
    elif there == "folder":
        link.mkdir()
    else:
        link = tmp_path / "nowhere" / "port"
    with pytest.raises(InputError, match=r"there already|cannot be made \(No such"):
        PtyServer(FirmwareCore(profile()), link)
    assert there != "file" or link.read_text() == "precious"


@pytest.mark.parametrize("value", ["s=abc", "s=-5", "s=nan", "s=inf", "s="])
def test_a_fault_takes_a_number(value: str) -> None:
    with pytest.raises(InputError, match=f"has '{value[2:]}' for {value[0]}, a number from 0 on"):
        parse_faults(f"line 3 silence {value}")


def test_a_clogged_nozzle_keeps_back_no_more_than_what_was_to_come_out() -> None:
    # regression: what a retraction had pulled back was kept back, too, so that a clog never ended
    talk = Talk()
    talk.say("G28", "M109 S210", "M83", "G1 X5 F3000", "M400")
    before = len(talk.machine.planner.executed)
    talk.machine.clogged_moves = 2
    talk.say("G1 E-5 F1500", "G1 E5", "G1 X10 E1", "G1 E-5", "G1 E6", "G1 X20 E1", "M400")
    pushed_mm = list(talk.machine.planner.executed[before:])[6::9]
    assert pushed_mm == pytest.approx([-5.0, 5.0, 0.0, -5.0, 5.0, 1.0])


E_MODES = ("M82", "M83", "G90", "G91", "G92 E0", "G1 E2 F300", "G1 X1 E3", "G20", "G21")


@settings(max_examples=60)
@given(st.lists(st.sampled_from(E_MODES), min_size=1, max_size=12), st.sampled_from(DIALECTS))
def test_the_host_knows_where_the_extruder_is(lines: list[str], firmware: str) -> None:
    """By `hosts.modes`, as the emulated firmware does: G90 and G91 mean four different things."""
    talk, modes = Talk(firmware), Modes()
    for line in ("G28", "G92 E0", *lines):
        if (line, firmware) == ("G20", "klipper"):
            continue  # it refuses inches, and the job is over
        talk.say(line)
        modes = follow(modes, line, firmware)
    assert modes.position_mm.get("E", 0.0) == pytest.approx(talk.machine.e)


@pytest.mark.parametrize(
    ("firmware", "e_mm"), [("marlin", 12.0), ("prusa", 2.0), ("klipper", 12.0), ("reprap", 2.0)]
)
def test_what_g91_does_to_the_extruder(firmware: str, e_mm: float) -> None:
    """Marlin: relative until M82; Klipper: relative while it lasts; the others: nothing."""
    talk = Talk(firmware)
    talk.say("G28", "M82", "G92 E10", "G91", "G1 E2 F300")
    assert talk.machine.e == pytest.approx(e_mm)
    talk.say("G90", "G1 E20 F300")
    assert talk.machine.e == pytest.approx(20.0)


def test_m118_says_it_as_an_action() -> None:
    talk = Talk()
    assert talk.say("M118 A1 action:pause") == ["//action:pause", "ok"]
    assert talk.say("M118 E1 hello") == ["echo:hello", "ok"]
    assert talk.say("M118 hello") == ["hello", "ok"]
