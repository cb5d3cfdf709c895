"""What the writer writes is what the toolpath says: volume, path and modes, read back by others."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcode.dialects import number
from gcode.errors import SliceError
from gcode.moves import Extrude, ModalState, Move, Program, Retract, Role, Toolpath, Travel
from gcode.profiles import load_setup
from gcode.reader import read_job
from gcode.writer import write

SETUP = load_setup()
AREA_MM2 = np.pi / 4 * 1.75**2


def toolpath_of(seed: int) -> Toolpath:
    """Random chains, from crumbs far below a printed digit to long strokes."""
    rng = np.random.default_rng(seed)
    moves: list[Move] = []
    for _ in range(int(rng.integers(1, 5))):
        n = int(rng.integers(2, 40))
        step = float(rng.choice([0.003, 0.1, 3.0]))
        start = rng.uniform([10, 10, 0.2], [200, 200, 50])
        walk = np.cumsum(rng.normal(size=(n - 1, 3)) * [step, step, 0.0], axis=0)
        points = np.concatenate([[start], start + walk])
        moves.append(Travel(points[:1], 100.0))
        section = rng.uniform(0.01, 0.3, n - 1)
        moves.append(Extrude(points, section, 20.0, Role.PERIMETER, 0.45, 0.2))
        moves += [Retract(0.8, 35.0), Retract(-0.8, 35.0)]
    return Toolpath(tuple(moves))


def pushed_mm(text: str) -> float:
    """Sum of all E words, by a parser of the test's own."""
    return sum(float(e) for e in re.findall(r"^G1[^;\n]*\bE(-?[\d.]+)", text, re.MULTILINE))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_text_pushes_the_volume_of_the_toolpath(seed: int) -> None:
    toolpath = toolpath_of(seed)
    program = write(toolpath, SETUP, title="test")
    expected = toolpath.volume_mm3 / AREA_MM2
    # rounding is carried on: at the end at most one last digit and one step too short to write
    assert pushed_mm(program.text) == pytest.approx(expected, abs=3e-3 * 0.3 / AREA_MM2 + 2e-5)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_reader_gets_the_beads_back(seed: int) -> None:
    toolpath = toolpath_of(seed)
    job = read_job(write(toolpath, SETUP, title="test"))
    ends = np.concatenate([chain.points_mm for chain in toolpath.extrusions])
    for axis in range(3):
        assert job.beads.end_mm[:, axis].max() <= ends[:, axis].max() + 6e-4
        assert job.beads.end_mm[:, axis].min() >= ends[:, axis].min() - 6e-4
    assert job.beads.volume_mm3 == pytest.approx(toolpath.volume_mm3, rel=2e-3, abs=1e-3)


def test_a_bead_without_a_travel_to_it_is_refused() -> None:
    points = np.array([[10.0, 10.0, 0.2], [20.0, 10.0, 0.2]])
    bead = Extrude(points, np.array([0.1]), 20.0, Role.PERIMETER, 0.45, 0.2)
    with pytest.raises(SliceError, match="travel"):
        write(Toolpath((bead,)), SETUP, title="test")


@pytest.mark.parametrize("absolute_e", [True, False])
@pytest.mark.parametrize("absolute_xyz", [True, False])
@pytest.mark.parametrize("units_mm", [True, False])
def test_an_interruption_leaves_the_machine_as_it_was(
    absolute_e: bool, absolute_xyz: bool, units_mm: bool
) -> None:
    modes = "G21\nG90\nM82\nG92 E0\nM104 S210\nM140 S60\nM106 S128\nM204 P900\n"
    job = modes + "G1 X40 Y60 Z1.2 F1800\nG1 X50 E3.5\n"
    job += "" if units_mm else "G20\n"
    job += "" if absolute_xyz else "G91\n"
    job += "M82\n" if absolute_e else "M83\n"
    before = read_job(Program(job, "prusa")).state_after(job.count("\n"))
    away = np.array([[before.position_mm[0], before.position_mm[1], 20.0], [5.0, 200.0, 20.0]])
    park = write(Toolpath((Travel(away, 100.0),)), SETUP, title="t", resume=before, restore=True)
    text = job + park.text
    after = read_job(Program(text, "prusa")).state_after(text.count("\n"))
    assert np.allclose(after.position_mm, before.position_mm, atol=1e-3)
    assert after.e_mm == pytest.approx(before.e_mm)
    for name in ("absolute_xyz", "absolute_e", "units_mm", "hotend_c", "bed_c"):
        assert getattr(after, name) == getattr(before, name), name
    assert after.fan_ratio == pytest.approx(before.fan_ratio, abs=1 / 255)
    assert after.feed_mm_s == pytest.approx(before.feed_mm_s)
    assert after.acceleration_mm_s2 == before.acceleration_mm_s2


def test_the_nozzle_goes_across_high_before_it_comes_down() -> None:
    state = ModalState((50.0, 60.0, 1.2), 0.0, True, False, 30.0, 0.5, (210.0,), 60.0)
    away = np.array([[5.0, 200.0, 20.0]])
    text = write(Toolpath((Travel(away, 100.0),)), SETUP, title="t", resume=state).text
    moves = [line for line in text.splitlines() if line.startswith("G1 ")]
    across = next(i for i, line in enumerate(moves) if "X50" in line)
    down = next(i for i, line in enumerate(moves) if "Z1.2" in line)
    assert across < down


@given(st.floats(-1e6, 1e6, allow_nan=False), st.integers(0, 6))
def test_numbers_have_no_exponent_and_no_minus_zero(value: float, digits: int) -> None:
    text = number(value, digits)
    assert "e" not in text.lower()
    assert text != "-0"
    assert float(text) == pytest.approx(value, abs=0.5 * 10**-digits + 1e-9 * abs(value))
