"""The checker: a good program passes, and every planted fault is refused by name."""

from __future__ import annotations

import copy
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gcode.check import CheckedProgram, CheckReport, check, checker, find_refusals, judge
from gcode.errors import CheckRefusedError, LocalProtocolError
from gcode.moves import ModalState, Program
from gcode.profiles import load_setup
from gcode.reader import read_job
from gcode.surfaces import HeightField

SETUP = load_setup()
GOOD = """; a good program
G21
G90
M83
M104 S215
M140 S60
M190 S60
M109 S215
G28 W
G92 E0
G1 Z0.3 F720
G1 X50 Y50 F6000
G1 X90 E3 F1000
G1 E-0.8 F2100
G1 Z1 F720
G1 X60 Y60 F6000
G1 Z0.5
G1 E0.8 F2100
G1 X80 E0.7 F1200
G3 X80 Y70 I0 J5 E0.5
G1 E-0.8 F2100
G1 Z10 F720
M104 S0
M140 S0
M107
M84
"""
MID = ModalState((60.0, 60.0, 5.0), 0.0, True, False, 50.0, 1.0, (210.0,), 60.0)


def program(text: str) -> Program:
    return Program(text, SETUP.printer.dialect)


def test_a_good_program_passes() -> None:
    checked = check(program(GOOD), SETUP)
    assert isinstance(checked, CheckedProgram)
    assert checked.lines(0, 2) == ("; a good program", "G21")
    assert not checked.report.swept


def test_a_repair_without_what_stands_there_is_told_what_it_lacks() -> None:
    # regression: "move before homing: Z, limit home first" sent people to home onto their part
    text = GOOD.replace("G28 W", "G1 Z2 F600\nG28 X Y")
    (refused, *_) = find_refusals(program(text), SETUP)
    assert "--as-built" in str(refused)


FAULTS = {
    "x out of reach": ("G1 X90 E3 F1000", "G1 X290 E3 F1000", "X out of reach"),
    "y out of reach": ("Y50 F6000", "Y-20 F6000", "Y out of reach"),
    "too high": ("G1 Z10 F720", "G1 Z400 F720", "Z out of reach"),
    "below the bed": ("G1 Z0.5", "G1 Z-0.5", "Z out of reach"),
    "hotend too hot": ("M109 S215", "M109 S350", "hotend temperature"),
    "bed too hot": ("M190 S60", "M190 S150", "bed temperature"),
    "negative temperature": ("M140 S60", "M140 S-5", "bed temperature"),
    "temperature without a number": ("M109 S215", "M109", "temperature missing"),
    "not waited for": ("M109 S215\n", "", "cold extrusion"),
    "never heated": ("M104 S215\n", "M104 S0\n", None),
    "turned down before printing": ("G1 E0.8 F2100", "M104 S100\nG1 E0.8 F2100", "cold extrusion"),
    "bead too thick": ("X80 E0.7", "X80 E17", "bead too thick"),
    "melts too much": ("X80 E0.7 F1200", "X80 E3.5 F12000", "melts more"),
    "absolute values in relative mode": ("X80 E0.7", "X80 E210.7", "bead too thick"),
    "relative mode lost": ("M83\n", "M82\n", None),
    "blob while standing": ("G1 E0.8 F2100", "G1 E80 F2100", "standing still"),
    "pulls the filament out": ("G1 E-0.8 F2100\nG1 Z1", "G1 E-90 F2100\nG1 Z1", "pulls filament"),
    "moves before homing": ("G28 W\n", "", "before homing"),
    "heater left on": ("M104 S0\n", "", "M104 S0 is lacking"),
    "bed left on": ("M140 S0\n", "", "M140 S0 is lacking"),
    "unknown command": ("M107\n", "M9999\n", "unknown"),
    "cold extrusion allowed": ("M83\n", "M83\nM302 S0\n", "cold extrusion allowed"),
    "steps changed": ("M83\n", "M83\nM92 E500\n", "not allowed"),
    "settings stored": ("M83\n", "M83\nM500\n", "not allowed"),
    "home offset": ("M83\n", "M83\nM206 Z5\n", "not allowed"),
    "frame shifted": ("G1 Z0.5", "G92 Z0\nG1 Z0.5", "coordinate system"),
    "feed of zero": ("X80 E0.7 F1200", "X80 E0.7 F0", "feed"),
    "feed in another unit": ("X80 E0.7 F1200", "X80 E0.7 F1200000", "feed"),
    "two numbers in one word": ("X80 E0.7", "X8.0.1 E0.7", "no number"),
    "not a number": ("X80 E0.7", "Xnan E0.7", None),
    "axis without a number": ("X80 E0.7", "X E0.7", "without a number"),
    "a word twice": ("X80 E0.7", "X80 X85 E0.7", "twice"),
    "named command": ("M107\n", "DROP_EVERYTHING\n", "unknown"),
    "a line cut by the firmware": ("G1 X80 E0.7", "G1 X80" + " " * 100 + "E0.7", "line too long"),
    "not ascii": ("G1 X80 E0.7", "G1 X80 É0.7", "character"),
    "arc off its circle": ("I0 J5 E0.5", "I0 J9 E0.5", "two circles"),
    "arc by radius": ("I0 J5 E0.5", "R5 E0.5", "radius"),
    "arc beyond the bed": (
        "G3 X80 Y70 I0 J5 E0.5",
        "G1 X245 E0 F6000\nG3 X245 Y80 I0 J10 E1",
        "out of reach",
    ),
    "firmware retraction": ("G1 E-0.8 F2100\nG1 Z1", "G10\nG1 Z1", "firmware retraction"),
    "extrusion told as a volume": ("M107\n", "; use_volumetric_e = 1\nM107\n", "as a volume"),
    "flow factor": ("M83\n", "M83\nM221 S900\n", "flow factor"),
    "speed factor": ("M83\n", "M83\nM220 S900\n", "speed factor"),
    "machine limit": ("M83\n", "M83\nM203 Z9000\n", "machine limit"),
    "inches": ("G21\n", "G20\n", "inches"),
    "feed beyond the machine's": ("X60 Y60 F6000", "X60 Y60 F30000", "feed of X"),
    "acceleration": ("M83\n", "M83\nM204 S20000\n", "acceleration"),
    "acceleration of an axis": ("M83\n", "M83\nM201 Z5000\n", "limit of Z's acceleration"),
    "jerk": ("M83\n", "M83\nM205 X90\n", "jerk"),
    "no flow at all": ("M83\n", "M83\nM221 S0\n", "flow factor"),
    "melts too much by a flow factor": (
        "G1 X80 E0.7 F1200",
        "M221 S150\nG1 X80 E2.2 F2700",
        "melts more",
    ),
    "melts too much by a speed factor": (
        "G1 X80 E0.7 F1200",
        "M220 S200\nG1 X80 E1.5 F2700",
        "melts more",
    ),
    "homes Z onto what it printed": ("M104 S0\n", "G28\nM104 S0\n", "homing Z onto"),
    "probes over what it printed": ("M104 S0\n", "G29\nM104 S0\n", "probing over"),
    "motors off between moves": ("G1 Z1 F720\n", "G1 Z1 F720\nM84\n", "before homing"),
    "all axes set to nothing": ("G92 E0", "G92", "coordinate system"),
    "a curve that nothing follows": ("G1 X90 E3 F1000", "G5 X90 Y50 I1 J1 P1 Q1 E3", "unknown"),
    "relative moves": ("G1 X80 E0.7", "G91\nG1 X200 E0.7", "out of reach"),
    "hot wait on the part": ("G1 Z1 F720\n", "G4 S3600\nG1 Z1 F720\n", "hot wait"),
    "hot wait in milliseconds": ("G1 Z1 F720\n", "G4 P3600000\nG1 Z1 F720\n", "hot wait"),
    "wait of no time": ("M83\n", "M83\nG4 S-5\n", "wait"),
    "homes X below what it printed": (
        "G1 Z10 F720", "G1 Z0.1 F720\nG28 X\nG1 Z10 F720", "homing X or Y below"
    ),
    "chamber too hot": ("M83\n", "M83\nM141 S500\n", "chamber temperature"),
    "chamber left on": ("M83\n", "M83\nM191 S45\n", "M141 S0 is lacking"),
    "an axis that is not there": ("G1 X60 Y60 F6000", "G1 X60 Y60 A9 F6000", "axis that"),
    "a carriage that is not there": ("G1 X60 Y60 F6000", "G1 X60 Y60 U9 F6000", "axis that"),
    "line number": ("G1 X80 E0.7", "N5 G1 X80 E0.7", "line number"),
    "checksum": ("G1 X80 E0.7 F1200", "G1 X80 E0.7 F1200*99", "checksum"),
    "line numbers begun anew": ("G1 X80 E0.7", "M110 N0\nG1 X80 E0.7", "not allowed"),
    "pressure advance": ("M83\n", "M83\nM572 S9\n", "pressure advance"),
    "bead in the bed": ("G1 Z0.5\n", "G1 Z0.005\n", "bead in the bed"),
    "goes down into the bed": ("G1 X80 E0.7", "G1 X80 Z0 E0.7", "bead in the bed"),
    "a move of hours": ("G1 X80 E0.7 F1200", "G1 X80 E0.7 F0.1", "takes too long"),
    "a push of hours": ("G1 E0.8 F2100", "G1 E0.8 F0.01", "takes too long"),
    "a nozzle of another size": ("M83\n", "M83\nM862.1 P0.8\n", "nozzle that it was made for"),
    "a temperature by flow": ("M109 S215", "M109 S180 B450 F1", "firmware chooses"),
    "a temperature by preset": ("M140 S60", "M140 S60 I1", "firmware chooses"),
    "another tool's hotend": ("M109 S215", "M109 T1 S215", "another tool"),
    "fan beyond full": ("M107\n", "M106 S9999\n", "fan"),
    "fan below nothing": ("M107\n", "M106 S-5\n", "fan"),
    "no acceleration at all": ("M83\n", "M83\nM204 P0\n", "acceleration by M204 P"),
    "an axis that never arrives": ("M83\n", "M83\nM203 X0\n", "X's speed"),
    "probe calibrated over what it printed": ("M104 S0\n", "G76\nM104 S0\n", "probing over"),
    "a bed that never gets as cold": ("M140 S0\n", "M140 S0\nM190 R10\n", "waits for ever"),
    "a nozzle that never gets as cold": ("M104 S0\n", "M109 R20\nM104 S0\n", "waits for ever"),
    "a chamber that never gets as cold": ("M140 S0\n", "M140 S0\nM191 R0\n", "waits for ever"),
    "a cold wait of days": ("M83\n", "M83\nG4 S90000\n", "more than a day"),
    "a hot wait in pieces": ("G1 Z1 F720\n", "G4 S400\nG4 S400\nG1 Z1 F720\n", "hot wait"),
    "pushed faster than it melts": ("G1 E0.8 F2100", "G1 E40 F9000", "melts more"),
    "pushed fast bit by bit": ("G1 E0.8 F2100", "G1 E5 F9000\n" * 3, "melts more"),
    "pushed fast on the spot": ("G1 E0.8 F2100", "G1 X60.02 E40 F900", "melts more"),
    "arc of several turns": ("I0 J5 E0.5", "I0 J5 P30 E0.5", "several turns"),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_refused(name: str) -> None:
    old, new, said = FAULTS[name]
    assert old in GOOD
    text = GOOD.replace(old, new, 1)
    if name == "never heated":
        text = text.replace("M109 S215", "M109 S20")
    if name == "relative mode lost":  # E falls back, then pushes what it seems to owe
        text = text.replace("X80 E0.7", "X80 E40")
    refusals = find_refusals(program(text), SETUP)
    assert refusals, name
    if said is not None:
        assert any(said in refusal.what for refusal in refusals), [str(r) for r in refusals]


ORDINARY = {
    "prusa": ["M862.1 P0.4", "M862.1 T0 P0.4 A0", "M486 Acube.stl id:0 copy 0", "M900 K30",
              "M907 E538", "M104 S215 T0", "M204 P1250 R1250 T1250", "M205 S0 T0", "M141 S0"],
    "marlin": ["M862.1 P0.4", "M106 P2 S255", "M205 J0.02", "M900 K0.05", "M413 S0", "M191 S0",
               "M204 S500", "M141 S45\nM141 S0", "M117 N5 *"],
    "klipper": ["SET_PRESSURE_ADVANCE ADVANCE=0.04 SMOOTH_TIME=0.02", "M106 P3 S127.5",
                "G3 Z10.4 I0.1 J1.2 P1 F6000",
                "SET_HEATER_TEMPERATURE HEATER=chamber TARGET=45\nTURN_OFF_HEATERS",
                "SET_VELOCITY_LIMIT ACCEL=3000 SQUARE_CORNER_VELOCITY=0", "M141 S0",
                "EXCLUDE_OBJECT_DEFINE NAME=a*2 CENTER=50,60", "M104 T1 S0"],
    "reprap": ["M572 D0 S0.05", "M106 P0 S0.5", "M141 P0 S0", "M568 P0 S0 R0", "G1 H0 Z10 F720"],
}  # fmt: skip
PRINTERS = {"prusa": "prusa_mk3s", "marlin": "ender_3", "klipper": "generic_klipper",
            "reprap": "generic_reprap"}  # fmt: skip


# What never ends, or melts too much, in each dialect; the second word tells whether it is refused.
WAITS = {
    "M190 R10": {"prusa", "marlin", "reprap", "klipper"},
    "M109 R0": {"prusa", "marlin", "reprap", "klipper"},
    "M190 R40": {"klipper"},  # which knows no R, and would switch the bed off
    "M109 S20": {"klipper"},
    "M190 S20": {"klipper"},
    "M190 S0": set(),
    "M190 S55": set(),
    "G1 E50 F9000": {"prusa", "marlin", "reprap", "klipper"},
    "G1 E45 F150": set(),
    "G1 E-5 F9000\nG1 E5 F9000": set(),
    "G1 E-5 F9000\nG1 E5.3 F9000": set(),
    "G1 E4.8 F1500": set(),
}  # fmt: skip


@pytest.mark.parametrize("dialect", PRINTERS)
def test_what_never_ends_or_melts_too_much_is_refused_in_every_dialect(dialect: str) -> None:
    """regression: `M190 R10` passed, and on a K1 150 mm/s into the hotend."""
    good = GOOD.replace("G28 W", "G28")
    for printer in {PRINTERS[dialect], "creality_k1" if dialect == "klipper" else "ender_3"}:
        setup = load_setup(printer).melting_all()
        for line, dialects in WAITS.items():
            text = good.replace("G1 Z10 F720\n", f"G1 X60 Y60 Z10 F720\n{line}\n")
            found = find_refusals(Program(text, dialect), setup)
            assert bool(found) == (dialect in dialects), (printer, line, [str(r) for r in found])


KLIPPER_WAITS = {
    "SENSOR=extruder MINIMUM=205": True,
    "SENSOR=extruder MINIMUM=211": False,
    "SENSOR=extruder MAXIMUM=205": False,
    "SENSOR=extruder MINIMUM=205 MAXIMUM=212": True,
    "SENSOR=extruder MINIMUM=205 MAXIMUM=200": False,
    "SENSOR=heater_bed MINIMUM=60": True,
    "SENSOR=heater_bed MINIMUM=61": False,
    "SENSOR=heater_bed MAXIMUM=10": False,
    "SENSOR=chamber MINIMUM=40": True,
    "SENSOR=chamber MINIMUM=400": False,
    "SENSOR=chamber MAXIMUM=10": False,
    "SENSOR=chamber": False,
}


@pytest.mark.parametrize("wait", KLIPPER_WAITS)
def test_klipper_waits_for_sensors_only_for_what_comes(wait: str) -> None:
    text = KLIPPER.replace("G90\n", f"TEMPERATURE_WAIT {wait}\nG90\n", 1)
    found = find_refusals(Program(text, "klipper"), K1)
    assert (not found) == KLIPPER_WAITS[wait], [str(r) for r in found]


def test_what_a_macro_has_heated_may_be_waited_for() -> None:
    lines = "PRINT_START\nTEMPERATURE_WAIT SENSOR=heater_bed MINIMUM=60\n"
    assert not find_refusals(Program(lines, "klipper"), load_setup("voron_2_4"))


@pytest.mark.parametrize("dialect", ORDINARY)
def test_what_slicers_ordinarily_write_passes(dialect: str) -> None:
    """G4 and M106 everywhere; after the last bead, where most faults above would be."""
    setup = load_setup(PRINTERS[dialect])
    good = GOOD.replace("G28 W", "G28")
    for line in ["G4 S0", "G4 P100", "M106 S0", "M106 S255", "G28 X0 Y0", *ORDINARY[dialect]]:
        text = good.replace("G1 Z10 F720\n", f"G1 Z10 F720\n{line}\n")
        assert not find_refusals(Program(text, dialect), setup), line


def test_a_cold_machine_may_wait_and_a_hot_one_soak_before_the_first_bead() -> None:
    for before in ("G28 W\n", "M104 S215\n"):
        assert not find_refusals(program(GOOD.replace(before, f"G4 S3600\n{before}")), SETUP)


@pytest.mark.parametrize(("z_mm", "said"), [(4.0, "homing X or Y below"), (5.0, None)])
def test_x_and_y_are_homed_above_all_that_stands(z_mm: float, said: str | None) -> None:
    start = ModalState((60.0, 60.0, z_mm), 0.0, True, False, 50.0, 1.0, (210.0,), 60.0)
    found = find_refusals(
        program("G28 X Y\n"), SETUP, as_built=standing(5.0, 80.0, 84.0), initial=start
    )
    assert (said is None) == (not found)
    assert all(said in r.what and "4 mm, limit 5 mm" in str(r) for r in found)


def test_one_after_another_x_is_homed_above_the_first() -> None:
    """At the top of the second, which is lower: the head would cross the first."""
    tower = "G1 Z5 F720\nG1 X70 E1 F1200\nG1 Z0.5 F720\nG1 X80 Y80\nG1 X90 E1 F1200\nG28 X\n"
    (only,) = find_refusals(program(tower), SETUP, initial=MID)
    assert str(only).startswith("line 6 ('G28 X'): homing X or Y below")
    assert str(only).endswith("Z 0.5 mm, limit 5 mm")


RELATIVE = GOOD.replace(
    "G1 X80 E0.7 F1200\n",
    "".join(f"G1 X{80 - 10 * (k % 2)} E{0.3 + 0.1 * (k % 3):.1f} F1200\n" for k in range(41)),
)


def test_relative_values_read_as_absolute_are_refused_by_their_going_back_and_forth() -> None:
    # regression: no bead was too thick and nothing was pulled far, so it passed
    assert not find_refusals(program(RELATIVE), SETUP)
    (first, *_) = find_refusals(program(RELATIVE.replace("M83", "M82")), SETUP)
    assert "relative values of E" in first.what
    assert str(first).startswith("line 19 ('G1 X80 E0.3 F1200')")


def test_of_moves_that_are_forgotten_the_sums_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A checker of a whole job need not hold every move: what is asked of all stays the same."""
    over = f"{RELATIVE.replace('M83', 'M82')}G28\n"
    texts = (GOOD, RELATIVE, over)
    at_once = [judge(program(text), SETUP) for text in texts]
    monkeypatch.setattr(checker, "SAY_EVERY_LINES", 3)
    assert [judge(program(text), SETUP) for text in texts] == at_once
    assert at_once[0].report.moves > 8
    kinds = [refusal.what for refusal in at_once[2].refusals]
    assert any("relative values of E" in kind for kind in kinds)
    assert any("homing" in kind for kind in kinds)


def test_factors_that_change_little_are_let_pass() -> None:
    text = GOOD.replace("M83\n", "M83\nM221 S95\nM220 S100\nM204 P1000 R1500 T1250\nM84 E\n")
    assert not find_refusals(program(text.replace("M84 E\n", "M84 S600\n")), SETUP)
    assert not find_refusals(program(text), SETUP)


def test_a_reprap_machine_heats_by_g10_and_waits_by_m116() -> None:
    # what PrusaSlicer writes for it: refused as a firmware retraction, and as cold
    setup = load_setup("generic_reprap")
    text = GOOD.replace("M104 S215\n", "G10 P0 S215 R150\n").replace("M109 S215", "M116")
    assert not find_refusals(Program(text, "reprap"), setup)
    told = {"M203 X18000 Y18000 Z300": None, "M203 X180000": "X's speed", "M566 Z600": "Z's jerk"}
    told |= {"G10 P0 R900": "standby", "M558 P0": "probe that homes", "M572 D0 S9": "pressure"}
    told |= {"G1 H1": "end stops", "G1 H2": "one motor", "G1 S1": "end stops"}
    told |= {"M290 Z-0.5": "coordinate", "G10 L2 P1 X5": "coordinate", "G10 P0 S900": "hotend"}
    for line, said in told.items():
        found = find_refusals(Program(text.replace("M83", f"M83\n{line}"), "reprap"), setup)
        assert (said is None) == (not found)
        assert all(said in refusal.what for refusal in found)


@pytest.mark.parametrize(("dialect", "taken"), [("marlin", True), ("reprap", True),
                                                ("klipper", False), ("prusa", False)])  # fmt: skip
def test_inches_are_taken_where_the_firmware_does(dialect: str, taken: bool) -> None:
    setup = load_setup({"marlin": "ender_3", "reprap": "generic_reprap"}.get(dialect, "prusa_mk3s"))
    begin, moves = GOOD.split("G92 E0\n")
    moves = moves.replace("X50 Y50 F6000", "X2 Y2 F236").replace("X90 E3 F1000", "X3.5 E.12 F39")
    moves = (
        moves.partition("G1 E-0.8")[0] + "G2 X3.5 Y2 I.1 J0 E.01\nG1 Z.4 F28\nM104 S0\nM140 S0\n"
    )
    text = begin.replace("G28 W", "G28") + "G20\nG1 Z0.012 F28\n" + moves.partition("F720\n")[2]
    found = find_refusals(Program(text, dialect), setup)
    assert any("inches" in refusal.what for refusal in found) != taken
    assert not taken or not found, [str(r) for r in found]


def test_a_refusal_names_line_move_value_and_limit() -> None:
    with pytest.raises(CheckRefusedError, match=r"line 13 .*'G1 X290.*290 mm, limit 0 to 250") as e:
        check(program(GOOD.replace("G1 X90 E3 F1000", "G1 X290 E3 F1000")), SETUP)
    assert {refusal.what for refusal in e.value.refusals} == {"X out of reach"}


@pytest.mark.parametrize("text", ["G28\n", "G28 Z\n", "G28 X Z\n", "G29\n", "G80\n"])
def test_nothing_homes_or_probes_onto_a_standing_part(text: str) -> None:
    refusals = find_refusals(program(text), SETUP, initial=MID)
    assert any("standing part" in refusal.what for refusal in refusals)
    assert not find_refusals(program("G28 X Y\n"), SETUP, initial=MID)


def test_only_the_checker_makes_the_proof() -> None:
    with pytest.raises(LocalProtocolError):
        CheckedProgram(program(GOOD), "prusa_mk3s", CheckReport(0, 0, False, None))
    checked = check(program(GOOD), SETUP)
    for steal in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(LocalProtocolError):
            steal(checked)


def standing(height_mm: float, x0: float, x1: float) -> HeightField:
    """A wall from x0 to x1 along y, on a bare bed."""
    z = np.zeros((600, 600))
    z[:, round(x0 / 0.25) : round(x1 / 0.25)] = height_mm
    return HeightField(np.zeros(2), 0.25, z, np.ones((600, 600), bool))


def travel(x0: float, x1: float, z: float) -> str:
    return f"G1 X{x0} Y60 Z{z} F3000\nG1 X{x1} Y60\n"


def test_a_travel_into_the_part_is_refused_and_one_above_it_passes() -> None:
    wall = standing(10.0, 80.0, 84.0)
    start = ModalState((60.0, 60.0, 20.0), 0.0, True, False, 50.0, 1.0, (210.0,), 60.0)
    low, high = travel(60, 100, 9.0), travel(60, 100, 10.5)
    refusals = find_refusals(program(low), SETUP, as_built=wall, initial=start)
    assert any("hits what stands there" in r.what for r in refusals)
    assert not find_refusals(program(high), SETUP, as_built=wall, initial=start)


@pytest.mark.parametrize(("beside_mm", "hits"), [(0.6, True), (1.4, False)])
def test_the_nozzle_is_a_cone(beside_mm: float, hits: bool) -> None:
    # regression: beside a wall 0.6 mm higher than the tip it counted as no wider than its flat
    wall = standing(10.0, 80.0, 84.0)
    start = ModalState((60.0, 60.0, 20.0), 0.0, True, False, 50.0, 1.0, (210.0,), 60.0)
    x = 80.0 - beside_mm
    along = f"G1 X{x} Y60 Z9.4 F3000\nG1 X{x} Y70\n"
    refusals = find_refusals(program(along), SETUP, as_built=wall, initial=start)
    assert any("the nozzle (0.1 mm above the tip) hits" in r.what for r in refusals) == hits


@pytest.mark.parametrize(("gap", "hits"), [(6.0, True), (40.0, False)])
def test_the_heater_block_is_a_body_too(gap: float, hits: bool) -> None:
    # the tip stays beside a wall 7 mm higher: the block, 4.5 mm above the tip, must not meet it
    wall = standing(8.0, 80.0, 84.0)
    start = ModalState((10.0, 60.0, 30.0), 0.0, True, False, 50.0, 1.0, (210.0,), 60.0)
    x = 80.0 - gap
    text = f"G1 X{x} Y60 F3000\nG1 Z1 F600\n"
    refusals = find_refusals(program(text), SETUP, as_built=wall, initial=start)
    assert bool(refusals) == hits
    if hits:
        assert any("block" in r.what for r in refusals)


def test_what_is_laid_stands_in_the_way_of_what_follows() -> None:
    bare = HeightField.flat((150.0, 150.0), 0.25)
    start = ModalState((60.0, 60.0, 20.0), 0.0, True, False, 50.0, 1.0, (210.0,), 60.0)
    tower = "".join(f"G1 Z{0.2 * k:.1f} F600\nG1 X{70 - 10 * (k % 2)} E0.4 F1200\n"
                    for k in range(1, 12))  # fmt: skip
    through = tower + "G1 X65 Y70 F6000\nG1 Z0.4 F600\nG1 Y50 F6000\n"
    assert not find_refusals(program(tower), SETUP, as_built=bare, initial=start)
    assert find_refusals(program(through), SETUP, as_built=bare, initial=start)


@pytest.mark.skipif("AMREPAIR_DATA" not in os.environ, reason="AMREPAIR_DATA is not set")
@pytest.mark.parametrize(
    "name",
    [
        "plant-sign",
        "prusaslicer-cube",
        pytest.param("screw", marks=pytest.mark.slow),
        "vase",
    ],
)
def test_real_files_for_this_printer_pass(name: str) -> None:
    path = Path(os.environ["AMREPAIR_DATA"]) / "gcode" / f"{name}.gcode"
    text = path.read_text(errors="replace")
    assert not find_refusals(program(text), SETUP)


@pytest.mark.parametrize("spaced", ["G1 X90 E3 F1000", "G1 X90 E30 F1000", "G1 X290 E3 F1000"])
def test_words_need_no_spaces_between(spaced: str) -> None:
    """regression: 'G1X90E3F1000', which every firmware reads, was an unknown command."""
    plain = GOOD.replace("G1 X90 E3 F1000", spaced)
    compact = "\n".join(
        line.replace(" ", "") if line[:1] in "GM" else line for line in plain.split("\n")
    )
    assert compact.count(" ") == 3  # of the comment
    found, expected = (find_refusals(program(text), SETUP) for text in (compact, plain))
    assert [(one.what, one.value) for one in found] == [(one.what, one.value) for one in expected]


def test_a_line_for_klipper_may_be_of_any_length() -> None:
    """regression: jobs of OrcaSlicer for round parts, whose outlines fill 9,000 characters."""
    outline = "".join(f"[{100 + k / 8},100]," for k in range(800))
    line = f"EXCLUDE_OBJECT_DEFINE NAME=benchy CENTER=110,110 POLYGON=[{outline[:-1]}]"
    job = GOOD.replace("G28 W", "G28").replace("G90", f"{line}\nG90")
    assert len(line) > 8000
    assert not find_refusals(Program(job, "klipper"), load_setup("generic_klipper"))


@pytest.mark.skipif("AMREPAIR_DATA" not in os.environ, reason="AMREPAIR_DATA is not set")
@pytest.mark.parametrize("name", ["cura_slicer", "orca_slicer"])
def test_real_files_for_a_k1_max_pass_there_and_nowhere_smaller(name: str) -> None:
    """They are begun by the machine's own macro, which homes and heats."""
    path = Path(os.environ["AMREPAIR_DATA"]) / "gcode" / f"{name}.gcode"
    text = path.read_text(errors="replace")
    assert not find_refusals(Program(text, "klipper"), load_setup("creality_k1_max").melting_all())
    begun = "\n".join(text.split("\n")[:2000])
    klipper = load_setup("generic_klipper")
    bed = {"bed_size_mm": (120.0, 120.0)}
    small = replace(klipper, printer=klipper.printer.model_copy(update=bed))
    elsewhere = find_refusals(Program(begun, "klipper"), small)
    assert any("out of reach" in r.what for r in elsewhere)


K1 = load_setup("creality_k1_max")
KLIPPER = """START_PRINT EXTRUDER_TEMP=210 BED_TEMP=60
G90
M83
G1 X50 Y50 Z0.3 F3000
G1 X110 E3 F1200
END_PRINT
"""
KLIPPER_FAULTS = {
    "start too hot": ("EXTRUDER_TEMP=210", "EXTRUDER_TEMP=400", "hotend temperature"),
    "start too cold": ("EXTRUDER_TEMP=210", "EXTRUDER_TEMP=100", "cold extrusion"),
    "bed too hot": ("BED_TEMP=60", "BED_TEMP=160", "bed temperature"),
    "start without a temperature": ("EXTRUDER_TEMP=210 ", "", "temperature missing"),
    "no start": ("START_PRINT EXTRUDER_TEMP=210 BED_TEMP=60\n", "", "before homing"),
    "no end": ("END_PRINT\n", "", "is lacking"),
    "heater by its name": (
        "G90\n", "G90\nSET_HEATER_TEMPERATURE HEATER=extruder TARGET=400\n", "hotend temperature"
    ),
    "left on by its name": (
        "END_PRINT", "END_PRINT\nSET_HEATER_TEMPERATURE HEATER=heater_bed TARGET=60", "is lacking"
    ),
    "chamber by its name": (
        "G90\n", "G90\nSET_HEATER_TEMPERATURE HEATER=chamber TARGET=400\n", "chamber temperature"
    ),
    "chamber left on by its name": (
        "END_PRINT", "END_PRINT\nSET_HEATER_TEMPERATURE HEATER=chamber TARGET=45", "is lacking"
    ),
    "pressure advance": ("G90\n", "SET_PRESSURE_ADVANCE ADVANCE=9\nG90\n", "pressure advance"),
    "no acceleration at all": ("G90\n", "SET_VELOCITY_LIMIT ACCEL=0\nG90\n", "acceleration"),
    "offset": ("G90\n", "SET_GCODE_OFFSET Z=-0.5\nG90\n", "coordinate system"),
    "offset step by step": ("G90\n", "SET_GCODE_OFFSET Z_ADJUST=-0.5\nG90\n", "coordinate"),
    "another tool": ("G1 X110 E3 F1200", "G1 X110 E3 F1200\nT1\nG1 X50 E3", "change of tool"),
    "tools in turn": ("G90\n", "T1\nT0\nG90\n", "change of tool"),
}  # fmt: skip


@pytest.mark.parametrize("name", KLIPPER_FAULTS)
def test_faults_in_what_a_klipper_machine_adds_are_refused(name: str) -> None:
    assert not find_refusals(Program(KLIPPER, "klipper"), K1)
    old, new, said = KLIPPER_FAULTS[name]
    assert old in KLIPPER
    refusals = find_refusals(Program(KLIPPER.replace(old, new, 1), "klipper"), K1)
    assert any(said in refusal.what for refusal in refusals)


@pytest.mark.parametrize(("printer", "taken"), [("voron_2_4", False), ("creality_k1", True)])
def test_a_bead_that_klipper_would_stop_at_is_refused(printer: str, taken: bool) -> None:
    """regression: 0.7 mm² passed for all; Klipper's default limit is 4 × 0.4² = 0.64 mm²."""
    lines = ["M104 S210", "M109 S210", "G28", "M83", "G1 X50 Y50 Z0.6 F3000"]
    lines += ["G1 X90 E11.65 F600", "M104 S0"]  # 28 mm³ along 40 mm
    found = find_refusals(Program("\n".join(lines), "klipper"), load_setup(printer).melting_all())
    assert [r.what for r in found] == ([] if taken else ["bead too thick"])


def test_the_only_tool_may_have_any_number_and_heaters_may_go_off_at_once() -> None:
    text = KLIPPER.replace("G90\n", "T3\nSET_GCODE_OFFSET Z=0\nG90\n")
    assert not find_refusals(Program(text, "klipper"), K1)
    text = KLIPPER.replace("END_PRINT", "TURN_OFF_HEATERS")
    assert not find_refusals(Program(text, "klipper"), K1)
    cold = KLIPPER.replace("G1 X110", "TURN_OFF_HEATERS\nG1 X110")
    assert find_refusals(Program(cold, "klipper"), K1)


@pytest.mark.parametrize("printer", ["creality_k1_max", "voron_2_4", "generic_klipper"])
@pytest.mark.parametrize("macro", ["START_PRINT", "PRINT_START", "START_PRINT EXTRUDER_TEMP=210"])
def test_a_macro_that_begins_a_job_is_refused_over_a_standing_part(
    printer: str, macro: str
) -> None:
    """It homes Z, whatever else it does; it passed."""
    setup = load_setup(printer)
    stands = HeightField.flat((50.0, 50.0), 1.0, z_mm=5.0)
    refusals = find_refusals(Program(f"{macro}\n", "klipper"), setup, as_built=stands)
    assert any("homing Z onto" in refusal.what for refusal in refusals)


@pytest.mark.parametrize("dialect", ["klipper", "marlin"])
def test_the_end_of_a_cura_job_pulls_back_two_millimetres(dialect: str) -> None:
    """M82, then G91: relative in Klipper and in Marlin; it was read as 1.5 m pulled back."""
    setup = load_setup("voron_2_4")
    lines = ["G28", "M104 S210", "M109 S210", "M82", "G92 E0", "G90", "G1 X50 Y50 Z0.3 F3000"]
    lines += [f"G1 X{50 + 60 * (k % 2)} E{1.5 * (k + 1):.1f} F1200" for k in range(100)]
    lines += ["G91", "G1 E-2 F2700", "G1 E-1 Z5 F600", "G90", "G1 X10 Y10 F6000", "M104 S0"]
    job = Program("\n".join(lines) + "\n", dialect)
    assert find_refusals(job, setup) == ()
    pushed = read_job(job).moves()[1]
    assert pushed[-7:].tolist() == pytest.approx([0, -2, -1, 0, 0, 0, 0])


def test_elsewhere_g91_leaves_an_absolute_extruder_alone() -> None:
    lines = ["G28", "M104 S210", "M109 S210", "M82", "G92 E0", "G90", "G1 X50 Y50 Z0.3 F3000"]
    lines += ["G1 X110 E1.5 F1200", "G91", "G1 E1 F2700", "G90", "M104 S0"]
    job = Program("\n".join(lines) + "\n", "prusa")
    assert read_job(job).moves()[1][9] == pytest.approx(-0.5)


def test_send_judges_flow_by_the_hotend_unless_the_filament_is_named(tmp_path: Path) -> None:
    """A job that `gcode check` passed was refused by `gcode send`, for PLA's flow."""
    from typer.testing import CliRunner

    from gcode.cli.app import app

    job, sent = tmp_path / "job.gcode", tmp_path / "sent.gcode"
    lines = ["G21", "G90", "M83", "M140 S60", "M104 S215", "M190 S60", "M109 S215", "G28"]
    # 0.8 mm² along 30 mm in 1.2 s: 20 mm³/s; the machine melts 23, PLA 15
    lines += ["G1 Z0.4 F600", "G1 X50 Y50 F6000", "G1 X80 E9.97 F1500", "M104 S0", "M140 S0"]
    job.write_text("\n".join(lines) + "\n")
    words = ["send", str(job), "--port", f"file:{sent}", "--printer", "creality_k1"]
    named = CliRunner().invoke(app, [*words, "--material", "pla"])
    assert named.exit_code == 0
    assert "20.0 mm³/s, limit 15 mm³/s" in named.stderr
    unnamed = CliRunner().invoke(app, words)
    assert unnamed.exit_code == 0, unnamed.output
    assert "limit" not in unnamed.stderr
    assert sent.read_text().split() == job.read_text().split()
