"""Objects of a job, by whichever marks the slicer put in; beads between them belong to none."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from gcode.errors import InputError
from gcode.moves import Program
from gcode.profiles import load_setup
from gcode.reader import objects_of, read_job
from gcode.reader.objects import box_of_beads_mm
from gcode.resumption import Resumption, resume_at

HEAD = ["G28", "G90", "M83", "G1 X0 Y0 Z.2 F600"]
MARKS = {
    "klipper": (
        ["EXCLUDE_OBJECT_DEFINE NAME=lid CENTER=1,1", "EXCLUDE_OBJECT_DEFINE NAME=box_2"],
        "EXCLUDE_OBJECT_START NAME={}", "EXCLUDE_OBJECT_END NAME={}", ("lid", "box_2"),
    ),
    "m486": (["M486 T2"], "M486 S{n}\nM486 A{}", "M486 S-1", ("lid", "box_2")),
    "comments": ([], "; printing object {} id:0", "; stop printing object {}",
                 ("lid id:0", "box_2 id:0")),
}  # fmt: skip


def job(marks: str, end: str = "\n") -> str:
    """Two objects in two layers, and a skirt before them."""
    before, start, stop, _ = MARKS[marks]
    lines = [*HEAD, *before, "G1 X50 E2", "G1 X0 Y0"]
    for layer in range(2):
        lines += [f"G1 Z{0.2 * (layer + 1):.1f}"]
        for n, name in enumerate(("lid", "box_2")):
            lines += start.format(name, n=n).split("\n")
            lines += [f"G1 X{20 * n} Y20", f"G1 X{20 * n + 9} Y20 E1", f"G1 X{20 * n + 9} Y29 E1"]
            lines += [stop.format(name)]
    return end.join([*lines, "M104 S0", ""])


@pytest.mark.parametrize("marks", MARKS)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_each_bead_belongs_to_its_object(marks: str, end: str) -> None:
    read = read_job(job(marks, end))
    found = objects_of(read)
    assert found.names == MARKS[marks][3]
    assert found.of_bead.tolist() == [-1, 0, 0, 1, 1, 0, 0, 1, 1]
    assert box_of_beads_mm(read, found.of_bead == 1) == pytest.approx((20.0, 20.0, 29.0, 29.0))


def test_a_job_without_marks_has_no_objects() -> None:
    read = read_job("\n".join([*HEAD, "G1 X50 E2", ""]))
    found = objects_of(read)
    assert found.names == ()
    assert found.of_bead.tolist() == [-1]


REAL = Path(os.environ.get("AMREPAIR_DATA", "none")) / "gcode"


@pytest.mark.skipif(not REAL.is_dir(), reason="AMREPAIR_DATA has no folder 'gcode'")
def test_a_real_jobs_one_object_has_nearly_all_its_beads() -> None:
    read = read_job((REAL / "orca_slicer.gcode").read_text(), dialect="klipper")
    found = objects_of(read)
    assert found.names == ("AzulTileTray.stl_id_0_copy_0",)
    assert np.mean(found.of_bead == 0) > 0.95


PRINTERS = {"klipper": "generic_klipper", "m486": "ender_3", "comments": "ender_3"}
SIDE_MM = 8.0


def going_on(marks: str, absolute: bool, without: str | None) -> Resumption:
    """The two towers from layer 3 on."""
    setup = load_setup(PRINTERS[marks], "pla", "standard_0.20")
    program = Program(towers(marks, absolute), setup.printer.dialect)
    return resume_at(program, setup, layer=3, without=without)


def towers(marks: str, absolute: bool) -> str:
    """Two towers, layer by layer, with retraction and a hop between them."""
    before, start, stop, _ = MARKS[marks]
    mode = "M82" if absolute else "M83"
    lines = ["M140 S60", "M104 S210", "M190 S60", "M109 S210", "G28", "G90", mode, "G92 E0"]
    lines += before
    e_mm = 0.0

    def push(by_mm: float) -> str:
        nonlocal e_mm
        e_mm += by_mm
        return f"E{e_mm if absolute else by_mm:.5f}"

    for layer in range(6):
        z_mm = 0.2 * (layer + 1)
        lines += [";LAYER_CHANGE", f";Z:{z_mm:.1f}", ";HEIGHT:0.2"]
        for n, name in enumerate(("lid", "box_2")):
            x_mm = 60.0 + 60.0 * n
            lines += start.format(name, n=n).split("\n")
            lines += [f"G1 {push(-2.0)} F2400", f"G1 Z{z_mm + 0.4:.2f} F600"]
            lines += [f"G1 X{x_mm:.1f} Y80 F6000", f"G1 Z{z_mm:.2f} F600", f"G1 {push(2.0)} F2400"]
            lines += [f"M106 S{100 + 50 * n}"]
            for dx, dy in ((1, 0), (1, 1), (0, 1), (0, 0)):
                x, y = x_mm + SIDE_MM * dx, 80 + SIDE_MM * dy
                lines.append(f"G1 X{x:.1f} Y{y:.1f} {push(0.27)} F1200")
            lines += [stop.format(name)]
    lines += [f"G1 {push(-2.0)} F2400", "G1 Z20 F600", "M104 S0", "M140 S0", "M107", ""]
    return "\n".join(lines)


@pytest.mark.parametrize("marks", MARKS)
@pytest.mark.parametrize("absolute", [True, False])
def test_the_rest_goes_on_without_one_object(marks: str, absolute: bool) -> None:
    whole = going_on(marks, absolute, None)
    made = going_on(marks, absolute, MARKS[marks][3][0])
    every, left = (read_job(one.checked.program).beads for one in (whole, made))
    other = every.start_mm[:, 0] > 110.0
    own = left.start_mm[:, 0] > 110.0
    assert left.end_mm[own] == pytest.approx(every.end_mm[other], abs=1e-4)
    assert left.section_mm2[own] == pytest.approx(every.section_mm2[other], rel=1e-3)
    tower = (left.start_mm[:, 0] > 55.0) & (left.start_mm[:, 0] < 70.0)
    laid = tower & (left.start_mm[:, 1] > 79.0) & (left.start_mm[:, 1] < 89.0)
    assert not laid.any(), "nothing more is laid of it"
    # filament: as much is pushed out as the other tower takes, and what primes
    text = made.checked.program.text
    assert "M106 S150" in text
    assert made.standing.sample(np.array([[64.0, 80.0]]))[0] > 0.5, "it stands there still"


def test_an_object_that_is_not_there_is_named() -> None:
    with pytest.raises(InputError, match="its objects are lid, box_2"):
        going_on("klipper", absolute=False, without="vase")
