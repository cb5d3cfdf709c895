"""A layer with its flow changed: volume follows the gap, the machine ends where it would have."""

from __future__ import annotations

from dataclasses import replace

import manifold3d as m3
import numpy as np
import pytest

from gcode.check import check
from gcode.errors import InputError
from gcode.moves import Program
from gcode.profiles import load_setup
from gcode.reader import Job, read_job
from gcode.resumption.flow import change_flow, gap_field
from gcode.surfaces import HeightField

SETUP = load_setup("ender_3", "pla", "repair_0.20")
AREA_MM2 = np.pi / 4 * 1.75**2
SECTION_MM2 = 0.45 * 0.2


def job(*, absolute_e: bool, layers: int = 3) -> Job:
    """Layers of long parallel beads, 40 × 20 mm, then a retraction."""
    lines = ["M140 S60", "M104 S205", "M190 S60", "M109 S205", "G28", "G90",
             "M82" if absolute_e else "M83", "G92 E0"]  # fmt: skip
    e_mm, push_mm = 0.0, 40.0 * SECTION_MM2 / AREA_MM2
    for layer in range(layers):
        lines += [";LAYER_CHANGE", f"G1 Z{0.2 * (layer + 1):.1f} F600", "G1 X80 Y100 F6000"]
        for row in range(44):
            y = 100 + 0.45 * row
            x = 120 if row % 2 == 0 else 80
            e_mm += push_mm
            lines.append(f"G1 X{x} Y{y:.2f} F3000")
            lines[-1] = f"G1 Y{y:.2f}" if row else "G1 F2400"
            lines.append(f"G1 X{x} E{e_mm if absolute_e else push_mm:.5f} F2400")
        e_mm -= 0.8
        lines.append(f"G1 E{e_mm if absolute_e else -0.8:.5f} F2100")
        e_mm += 0.8
        lines.append(f"G1 E{e_mm if absolute_e else 0.8:.5f} F2100")
    text = "\n".join([*lines, "M104 S0", "M140 S0"]) + "\n"
    return read_job(Program(text, "marlin"), dialect="marlin")


def box(depth_mm: float, sign: float) -> HeightField:
    solid = m3.Manifold.cube((10.0, 9.0, depth_mm)).translate((95.0, 105.0, 0.2 - depth_mm))
    return gap_field([(solid, sign)], 0.2)


@pytest.mark.parametrize("absolute_e", [False, True])
@pytest.mark.parametrize(("depth_mm", "sign"), [(0.1, 1.0), (0.06, -1.0)])
def test_the_plastic_follows_the_gap(absolute_e: bool, depth_mm: float, sign: float) -> None:
    made = job(absolute_e=absolute_e)
    changed = change_flow(made, SETUP, 1, box(depth_mm, sign))
    assert changed is not None
    # beads are 0.5 mm steps long and 0.45 mm apart: what a box's rim makes of that
    assert changed.added_mm3 == pytest.approx(sign * depth_mm * 90.0, rel=0.08)
    lines = made.program.text.split("\n")
    before = lines[: made.layers[1].first_line]
    after = lines[made.layers[1].end_line :]
    whole = "\n".join([*before, *changed.checked.program.text.splitlines(), *after])
    again = read_job(Program(whole, "marlin"), dialect="marlin")
    assert again.beads.volume_mm3 - made.beads.volume_mm3 == pytest.approx(
        changed.added_mm3, abs=0.02
    )
    # the other layers are untouched, and the machine ends where the job's own layer leaves it
    for layer in (0, 2):
        pick = [job_.beads.section_mm2[job_.beads.layer == layer] for job_ in (made, again)]
        np.testing.assert_allclose(pick[0], pick[1], rtol=1e-3)
    ends = [job_.state_after(job_.layers[2].first_line) for job_ in (made, again)]
    assert ends[1].e_mm == pytest.approx(ends[0].e_mm, abs=2e-5)
    assert replace(ends[1], e_mm=ends[0].e_mm) == ends[0]


def test_only_beads_over_the_place_change_and_they_keep_their_way() -> None:
    made = job(absolute_e=False)
    changed = change_flow(made, SETUP, 1, box(0.1, 1.0))
    assert changed is not None
    text = changed.checked.program.text.splitlines()
    start = made.layers[1].first_line
    own = made.program.text.split("\n")[start : made.layers[1].end_line]
    assert set(own) - set(text) == {
        line for line in own if line.startswith("G1 X") and " E" in line
    } - set(text)
    assert 18 <= changed.beads <= 22  # 9 mm of rows 0.45 mm apart
    state = made.state_after(start)
    read = check(Program("\n".join(text) + "\n", "marlin"), SETUP, initial=state)
    assert read.report.moves > 88


def test_flow_stays_within_what_the_printer_can() -> None:
    made = job(absolute_e=False)
    changed = change_flow(made, SETUP, 1, box(2.0, 1.0))  # ten layers deep: more than a bead
    assert changed is not None
    whole_mm3 = 40.0 * 44 * SECTION_MM2
    assert changed.added_mm3 <= 0.8 * whole_mm3 * 90.0 / (40.0 * 20.0) * 1.15


def test_a_place_beside_the_layer_changes_nothing() -> None:
    made = job(absolute_e=False)
    far = m3.Manifold.cube((5.0, 5.0, 0.1)).translate((10.0, 10.0, 0.1))
    assert change_flow(made, SETUP, 1, gap_field([(far, 1.0)], 0.2)) is None


def test_relative_coordinates_are_refused() -> None:
    own, other = ";LAYER_CHANGE\nG1 Z0.4 F600", "G91\n;LAYER_CHANGE\nG1 Z0.2 F600\nG90"
    made = read_job(Program(job(absolute_e=True).program.text.replace(own, other), "marlin"))
    assert not made.state_after(made.layers[1].first_line).absolute_xyz
    with pytest.raises(InputError, match="relative"):
        change_flow(made, SETUP, 1, box(0.1, 1.0))
