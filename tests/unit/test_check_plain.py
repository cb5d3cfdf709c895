"""Plain moves in machine code are judged as line by line: same refusals, same moves."""

from __future__ import annotations

import os
from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gcode.check.findings import Text
from gcode.check.rules import Judge
from gcode.moves import ModalState, Program
from gcode.profiles import load_setup

SETUP = load_setup()
MID = ModalState((60.0, 60.0, 5.0), 0.0, True, False, 50.0, 1.0, (210.0,), 60.0)
NUMBERS = st.one_of(
    st.floats(-30.0, 260.0).map(lambda v: f"{v:.3f}"),
    st.floats(-1.0, 4.0).map(lambda v: f"{v:.5f}"),
    st.integers(-3, 300).map(str),
    st.sampled_from(["", ".5", "5.", "+7", "-.25", "1e3", "0x1", "1.2.3", "--1", "9" * 18, "60"]),
)
WORDS = st.tuples(st.sampled_from("XYZEFXYEFIJSxe*"), NUMBERS).map("".join)
MOVES = st.tuples(
    st.sampled_from(["G1 ", "G0 ", "G1", "G01 ", "g1 ", " G1\t", "N3 G1 ", "G10 ", "G1  "]),
    st.lists(WORDS, max_size=5),
    st.sampled_from([" ", "  ", "", "\t"]),
    st.sampled_from(["", " ; so", ";", "\r", " ;ü", "ü", " \r"]),
).map(lambda parts: parts[0] + parts[2].join(parts[1]) + parts[3])
TRAVELS = st.tuples(st.floats(55, 65), st.floats(55, 65), st.floats(-0.01, 0.4)).map(
    lambda v: f"G1 X{v[0]:.3f} Y{v[1]:.3f} E{v[2]:.5f}"
)
OTHERS = st.sampled_from(
    ["", ";", "G90", "G91", "M82", "M83", "G92 E0", "G20", "G21", "G28 X Y", "M104 S0", "M109 S210",
     "G3 X60 Y70 I0 J5 E0.5", "G92 X1", "M117 hello", "WHAT", "M221 S140", "M220 S180", "M84"]
)  # fmt: skip
PROGRAMS = st.lists(st.one_of(TRAVELS, TRAVELS, MOVES, OTHERS), max_size=20).map("\n".join)


def judged(text: str, initial: ModalState | None, *, plain: bool) -> Judge:
    program = Program(text, SETUP.printer.dialect)
    judge = Judge(program, SETUP, None, initial)
    lines, number, laid_out = text.split("\n"), 1, Text.of(text)
    while number <= len(lines):
        if plain:
            number = judge.follow(laid_out, number, len(lines) + 1)
        if number <= len(lines):
            judge.read(number, lines[number - 1])
            number += 1
    judge.end(laid_out)
    return judge


def assert_same(text: str, initial: ModalState | None) -> Judge:
    fast, slow = (judged(text, initial, plain=plain) for plain in (True, False))
    assert fast.refusals == slow.refusals
    assert fast.commands == slow.commands
    np.testing.assert_array_equal(fast.moves.line, slow.moves.line)
    np.testing.assert_allclose(fast.moves.start_mm, slow.moves.start_mm, atol=1e-12)
    np.testing.assert_allclose(fast.moves.end_mm, slow.moves.end_mm, atol=1e-12)
    np.testing.assert_allclose(fast.moves.pushed_mm3, slow.moves.pushed_mm3, atol=1e-12)
    sums, others = astuple(fast.moves.sums), astuple(slow.moves.sums)
    np.testing.assert_allclose(sums, others, rtol=1e-12)
    return fast


@given(PROGRAMS, st.booleans())
@settings(max_examples=80)
@example("G1 X60 Y60 F1200\nG1 X70 E9\nG1 X80 E.4 F99999\nG1 E-30\nG1 X999\nG1 E9\nG1 E9", False)
def test_any_program(text: str, cold: bool) -> None:
    assert_same(text, None if cold else MID)


@pytest.mark.skipif("AMREPAIR_DATA" not in os.environ, reason="AMREPAIR_DATA is not set")
def test_real_files() -> None:
    files = sorted((Path(os.environ["AMREPAIR_DATA"]) / "gcode").rglob("*.gcode"))
    moves = 0
    for path in files:
        text = "\n".join(path.read_text(errors="replace").split("\n")[:2500])
        moves += assert_same(text, MID).moves.count
    assert moves > 5_000
