"""The way to the park and back: whatever modes the job was in, it finds them again."""

from __future__ import annotations

from dataclasses import asdict, replace
from itertools import product

import pytest

from amrepair.loop import travel
from gcode.check import check
from gcode.errors import CheckRefusedError
from gcode.moves import Program
from gcode.profiles import load_setup
from gcode.reader import read_job
from gcode.resumption.head import pulled_back_mm, state_at_rest

SETUP = load_setup()
HEAD = """\
M140 S60
M190 S60
M104 S215
M109 S215
G28
G90
M83
G92 E0
G1 Z0.2 F600
G1 X100 Y100 F6000
G1 X120 Y100 E1 F1200
G3 X120 Y110 I0 J5 E0.8
G1 X100 Y110 E1
"""


@pytest.mark.parametrize(
    ("relative", "absolute_e", "inches", "tool"), list(product((False, True), repeat=4))
)
def test_every_mode_comes_back(relative: bool, absolute_e: bool, inches: bool, tool: bool) -> None:
    lines = [HEAD.rstrip(), "M204 P1500", "M106 S128", "M104 S207.5"]
    lines += ["T1"] * tool + ["M82", "G92 E42.5"] * absolute_e
    lines += ["G1 F1800", *["G91"] * relative]
    lines += ["M82" if absolute_e else "M83", *["G20"] * inches]
    head = "\n".join(lines) + "\n"
    setup = load_setup(printer="generic_marlin") if inches else SETUP  # a Prusa knows none
    dialect = setup.printer.dialect
    job = read_job(Program(head, dialect))
    state = job.state_after(head.count("\n"))
    assert (state.absolute_xyz, state.absolute_e) == (not relative, absolute_e)
    assert (state.units_mm, state.tool) == (not inches, int(tool))
    program, parked = travel.park(setup, state)
    sent = [one.program.text for one in (program, *travel.way_back(setup, state, parked))]
    text = "".join([head, *sent])
    after = read_job(Program(text, dialect)).state_after(text.count("\n"))
    wanted, found = asdict(state), asdict(after)
    for name in ("position_mm", "e_mm", "feed_mm_s", "fan_ratio", "acceleration_mm_s2"):
        assert found.pop(name) == pytest.approx(wanted.pop(name), abs=2e-3), name
    assert found == wanted
    assert "M400" in sent[0]  # the scan waits for the last move


@pytest.mark.parametrize("pulled_mm", [0.0, 0.5, 0.8, 6.5])
def test_whatever_a_job_has_pulled_a_repair_finds_the_nozzle_as_it_leaves_it(
    pulled_mm: float,
) -> None:
    """A job of Cura's rests with 1 mm pulled: patches lacked 2.4 mm³, and its next line got them.

    Marks for looks stand where filament is pulled back, whoever sliced the job.
    """
    head = HEAD + (f"G1 E-{pulled_mm} F2100\n" if pulled_mm else "")
    job = read_job(Program(head, SETUP.printer.dialect))
    state = state_at_rest(job, head.count("\n"))
    assert state.pulled_mm == pytest.approx(pulled_mm)
    program, parked = travel.park(SETUP, state)
    assert parked.pulled_mm == SETUP.printer.retraction_mm  # what a patch pushes before it lays

    def back_mm(text: str) -> float:
        return pulled_back_mm(read_job(Program(text, SETUP.printer.dialect)), text.count("\n"))

    there = head + program.program.text
    assert back_mm(there) == pytest.approx(SETUP.printer.retraction_mm, abs=1e-4)
    ways = travel.way_back(SETUP, state, parked)
    assert back_mm(there + "".join(way.program.text for way in ways)) == pytest.approx(
        pulled_mm, abs=1e-4
    )


def test_what_one_filament_was_pulled_is_not_another_s() -> None:
    """regression: unloaded by 85 mm in the job and loaded by the machine, 85 mm were still back."""
    head = HEAD + "G1 E-15 F6000\nG1 E-70 F1200\n"
    assert pulled_back_mm(read_job(Program(head, "prusa")), head.count("\n")) == 85.0
    for after, back_mm in (("T1\n", 0.0), ("T1\nG1 E20 F600\nG1 E-0.8 F2100\n", 0.8)):
        job = read_job(Program(head + after, "prusa"))
        assert pulled_back_mm(job, (head + after).count("\n")) == pytest.approx(back_mm)


def test_filament_that_was_pulled_back_is_pushed_without_melting() -> None:
    """regression: 6 mm of a Bowden's retraction at 40 mm/s were 96 mm³/s to the checker.

    A printer with more than 5 mm could not go on after its first look.
    """
    setup = load_setup("anycubic_kobra")
    assert setup.printer.retraction_mm == 6.0
    job = read_job(Program(HEAD, setup.printer.dialect))
    state = job.state_after(HEAD.count("\n"))
    _, parked = travel.park(setup, state)
    back, _ = travel.way_back(setup, state, parked)
    assert "G1 E6 F2400" in back.program.text
    with pytest.raises(CheckRefusedError, match="melts more than the hotend can"):
        check(back.program, setup, initial=replace(parked, pulled_mm=0.0))
