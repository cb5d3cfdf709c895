"""The reader: layers, beads and states of text as different slicers write it."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest

from gcode.errors import ReadError
from gcode.reader import read_job
from gcode.reader.blocks import blocks_of

AREA_MM2 = np.pi / 4 * 1.75**2


def square(z: float, e_start: float, *, relative: bool) -> str:
    lines = [f"G1 X10 Y10 Z{z} F6000"]
    for k, (x, y) in enumerate([(20, 10), (20, 20), (10, 20), (10, 10)], start=1):
        lines.append(f"G1 X{x} Y{y} E{0.4 if relative else e_start + 0.4 * k:.5f} F1200")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("relative", [True, False])
@pytest.mark.parametrize("mark", [";LAYER_CHANGE\n", ";LAYER:{k}\n", "; CHANGE_LAYER\n", ""])
def test_layers_are_found_by_any_mark_and_by_none(newline: str, relative: bool, mark: str) -> None:
    text = "G28\nM109 S210\n" + ("M83\n" if relative else "M82\nG92 E0\n")
    for k in range(5):
        text += mark.format(k=k) + square(0.2 * (k + 1), 1.6 * k, relative=relative)
    text += "M104 S0\n"
    job = read_job(text.replace("\n", newline))
    assert [round(layer.z_mm, 3) for layer in job.layers] == [0.2, 0.4, 0.6, 0.8, 1.0]
    assert job.beads.section_mm2 == pytest.approx(np.full(20, 0.4 * AREA_MM2 / 10))
    assert job.layers[0].end_line == job.layers[1].first_line
    assert job.program.text.split("\n")[job.footer_start_line].startswith("M104")


def test_a_hop_is_no_layer() -> None:
    text = "M83\n" + square(0.2, 0, relative=True)
    text += "G1 Z5\nG1 X50 Y50\n" + square(0.2, 0, relative=True) + square(0.4, 0, relative=True)
    assert [layer.z_mm for layer in read_job(text).layers] == [0.2, 0.4]


def test_an_arc_is_as_long_as_its_circle() -> None:
    text = "G90\nM83\nG1 X20 Y10 Z0.2 F1200\nG2 X20 Y10 I-5 J0 E1\nG3 X10 Y10 I-5 J0 E0.5\n"
    beads = read_job(text).beads
    lengths = np.linalg.norm(beads.end_mm - beads.start_mm, axis=1)
    whole = beads.line == 3
    assert lengths[whole].sum() == pytest.approx(2 * np.pi * 5, rel=2e-3)
    assert lengths[~whole].sum() == pytest.approx(np.pi * 5, rel=2e-3)
    radius = np.hypot(beads.end_mm[whole, 0] - 15, beads.end_mm[whole, 1] - 10)
    assert radius == pytest.approx(np.full(whole.sum(), 5.0), abs=1e-6)


def test_what_is_ironed_is_as_high_as_its_layer() -> None:
    """regression: PrusaSlicer tells its plastic, spread thin; layers were held to be as thin."""
    text = "M83\n"
    for k in range(3):
        text += ";LAYER_CHANGE\n;HEIGHT:0.2\n;TYPE:Solid infill\n"
        text += square(0.2 * (k + 1), 0, relative=True)
        text += ";TYPE:Ironing\n;HEIGHT:0.0075\nG1 X20 Y10 E0.005\n;HEIGHT:0.2\n"
    beads = read_job(text).beads
    assert (beads.role == beads.roles.index("Ironing")).sum() == 3
    assert beads.height_mm == pytest.approx(np.full(len(beads), 0.2))


@pytest.mark.parametrize(
    "said", ["; use_volumetric_e = 1", ";FLAVOR:Marlin(Volumetric)", ";FLAVOR:UltiGCode"]
)
def test_a_job_that_tells_extrusion_as_a_volume_is_refused(said: str) -> None:
    """regression: beads were read 2.4 times too thick, and "the job prints another part"."""
    text = "M83\n" + square(0.2, 0, relative=True)
    for newline in ("\n", "\r\n"):
        whole = f"{text}{said}\n; end\n".replace("\n", newline)
        with pytest.raises(ReadError, match=r"Line 7 says .* as a volume"):
            read_job(whole)
    with pytest.raises(ReadError, match="Line 1 "):
        read_job(f"{said}\n{text}")
    read_job(f"{text}{said.replace('= 1', '= 0').replace('UltiG', 'G').replace('(V', '(v')}\n")


def test_states_follow_modes_units_and_shifts() -> None:
    text = "G20\nG90\nM82\nG1 X1 Y2 Z0.1 E0.1 F100\nG91\nG1 X1 E0.2\nG92 E0\nM106 S255\nG21\n"
    job = read_job(text + "G90\nM83\nG1 X10 E1\nG1 X20 E1\n", dialect="prusa")
    state = job.state_after(6)
    assert state.position_mm == pytest.approx((50.8, 50.8, 2.54))
    assert (state.absolute_xyz, state.absolute_e, state.units_mm) == (False, True, False)
    assert state.e_mm == pytest.approx(0.2 * 25.4)
    assert job.state_after(8).fan_ratio == 1.0
    assert job.state_after(8).e_mm == 0.0


def test_marlin_lets_g90_set_the_extruder_too() -> None:
    text = "G28\nM83\nG90\nG1 X1 Y1 Z0.2 E1\nG1 X2 E2\n"
    assert read_job(text, dialect="marlin").state_after(3).absolute_e
    assert not read_job(text, dialect="prusa").state_after(3).absolute_e


def test_a_program_without_plastic_is_no_job() -> None:
    with pytest.raises(ReadError, match="extrudes nothing"):
        read_job("G28\nG1 X10\n")


def test_an_unknown_place_is_said() -> None:
    job = read_job("M83\nG1 X1 Y1 Z0.2\nG1 X9 E1\n")
    with pytest.raises(ReadError, match="place is not known"):
        job.state_after(1)


@pytest.mark.skipif("AMREPAIR_DATA" not in os.environ, reason="AMREPAIR_DATA is not set")
@pytest.mark.parametrize(
    "name", ["cura_slicer", "orca_slicer", "plant-sign", "screw", "vase", "prusaslicer-cube"]
)
def test_real_files_use_the_filament_that_they_state(name: str) -> None:
    path = Path(os.environ["AMREPAIR_DATA"]) / "gcode" / f"{name}.gcode"
    text = path.read_text(errors="replace")
    job = read_job(text)
    stated = re.search(r"filament used \[mm\] = ([\d., ]+)|Filament used: ([\d.]+)m", text)
    if stated is None:
        pytest.skip("the file does not state its filament")
    if stated.group(2):
        expected = float(stated.group(2)) * 1000
    else:
        expected = sum(float(v) for v in stated.group(1).replace(" ", "").split(","))
    # purge lines of start scripts are in the file but not in the slicer's figure, or the other way
    assert job.filament_mm == pytest.approx(expected, rel=0.015)
    tops = np.array([layer.z_mm for layer in job.layers])
    assert (np.diff(tops) > 0).all()


def test_another_fan_than_the_parts_is_not_the_parts() -> None:
    # regression: M106 P2 S255 (a chamber's fan) was read as the part's fan at full speed
    text = "G28\nM106 S127.5\nM106 P2 S255\nG1 X1 Y1 Z1\nG1 X9 E1\nM107 P2\nG1 X1 E2\nM107\n"
    job = read_job(text)
    assert job.state_after(7).fan_ratio == 0.5
    assert job.state_after(8).fan_ratio == 0.0


@pytest.mark.parametrize("chars", [1, 40, 1000])
def test_blocks_are_what_the_whole_is(chars: int) -> None:
    text = "G28\nM82\nG92 E0\n;LAYER_CHANGE\n" + square(0.2, 0, relative=False)
    text += "G92 X5 E0\nG91\n;LAYER_CHANGE\nG1 X1 Y2 Z0.2 E0.1\nG2 X0 Y0 I-5 J0 E1\nG90\nG20\nG1 X1"
    whole = read_job(text)
    blocks = list(blocks_of(whole.program, chars))
    assert (len(blocks) > 1) == (chars < len(text))
    assert [block.first_line for block in blocks[1:]] == [block.end_line for block in blocks[:-1]]
    states = np.concatenate([blocks[0].states[:1], *(block.states[1:] for block in blocks)])
    np.testing.assert_array_equal(states, whole.block.states)
    for of in ("pushed_mm", "start_mm", "end_mm", "filament_mm", "line"):
        together = np.concatenate([getattr(block, of) for block in blocks])
        np.testing.assert_array_equal(together, getattr(whole.block, of))
    assert [each for block in blocks for each in block.comments] == whole.block.comments


@pytest.mark.parametrize(
    ("mark", "role"),
    [
        (";TYPE:External perimeter", "External perimeter"),
        ("; FEATURE: Outer wall", "Outer wall"),  # Bambu Studio
        (";TYPE:WALL-OUTER", "WALL-OUTER"),  # Cura, ideaMaker
        ("; feature outer perimeter", "outer perimeter"),  # Simplify3D
        ("; 'Perimeter Path', 12.3 [feed mm/s], 40.0 [head mm/s]", "Perimeter Path"),  # KISSlicer
        ("; 'Stacked Sparse Infill Path', 2.1 [feed mm/s]", "Stacked Sparse Infill Path"),
    ],
)
def test_roles_are_read_as_each_slicer_names_them(mark: str, role: str) -> None:
    text = f"M83\nG1 X0 Y0 Z0.2 F600\n{mark}\nG1 X20 E1\n"
    assert read_job(text).beads.roles[-1] == role


@pytest.mark.parametrize(
    ("tops_mm", "turns"),
    [
        ([0.2, 0.4, 0.6, 0.2, 0.4, 0.6], [(0, 3), (3, 6)]),
        ([0.2, 0.4, 0.2, 0.4], [(0, 2), (2, 4)]),  # of two layers each
        ([0.2, 0.2, 0.2], [(0, 3)]),  # of one: nothing is higher than anything
        ([0.3, 0.2, 0.4], [(0, 3)]),  # a line to prime with, above the first layer
        ([0.3, 0.45, 0.65, 1.15, 1.13, 1.33], [(0, 6)]),  # Cura's gap over a raft
    ],
)
def test_a_turn_begins_where_a_layer_is_laid_a_layer_lower(
    tops_mm: list[float], turns: list[tuple[int, int]]
) -> None:
    lines = ["G28", "G90", "M83"]
    for z_mm in tops_mm:
        lines += [";LAYER_CHANGE", f"G1 X20 Y20 Z{z_mm} F6000", "G1 X60 E2 F1200"]
    job = read_job("\n".join(lines) + "\n")
    assert [(turn.first_layer, turn.end_layer) for turn in job.turns] == turns
    for turn in job.turns:
        own = job.of_turn(turn).beads
        assert set(own.layer.tolist()) == set(range(turn.first_layer, turn.end_layer))
        assert job.end_of(turn) == own.line[-1] + 1
        assert job.turn_at(job.end_of(turn)) == turn
