"""The macro AMREPAIR_TOUCH in Klipper itself (`klippy_batch`), held against arithmetic."""

from __future__ import annotations

import re
from pathlib import Path

import klippy_batch
import pytest

from gcode.hosts.serial import _TOUCHED
from gcode.resumption.klipper import TOUCH_MACRO

Z_OFFSET_MM, LOWEST_MM = -0.35, -3.0
STEPS_A_MM = 200 * 16 / 8
pytestmark = klippy_batch.MARKS
CONFIG = f"""\
[include klipper_touch.cfg]
[probe]
pin: ^gpio13
z_offset: {Z_OFFSET_MM}
[force_move]
enable_force_move: True
"""


def klippy(folder: Path, lines: list[str], *, share: float, config: str = CONFIG) -> str:
    """What Klipper says to a program; its touches trigger at this share of their way, 0: never."""
    (folder / "klipper_touch.cfg").write_text(TOUCH_MACRO)
    rows = klippy_batch.klippy(
        folder, config, ["G28", "G90", *lines], lowest_mm=LOWEST_MM, share=share
    )
    return "\n".join(klippy_batch.said(rows)) + "\n"


def z_told(said: str) -> list[float]:
    """Every answer to M114."""
    return [float(z) for z in re.findall(r"^X:\S+ Y:\S+ Z:(\S+) ", said, re.MULTILINE)]


@pytest.mark.parametrize("share", [1.0, 0.5, 0.2])
@pytest.mark.parametrize("shift_mm", [0.0, 0.2])
def test_a_touch_is_told_in_the_coordinates_of_the_program(
    share: float, shift_mm: float, tmp_path: Path
) -> None:
    said = klippy(
        tmp_path,
        [
            f"SET_GCODE_OFFSET Z={shift_mm}", "G1 X100 Y100 Z12 F3000", "M400",
            "AMREPAIR_TOUCH DEPTH=2.5 SPEED=2", "M114", "G1 Z12 F600", "M400", "M114",
            "AMREPAIR_TOUCH DEPTH=1.5 SPEED=2", "G1 Z12 F600", "M114",
        ],
        share=share,
    )  # fmt: skip
    told = [m for line in said.splitlines() if (m := _TOUCHED.fullmatch(line.strip()))]
    met = [float(m.group(1)) for m in told]
    wanted = [12.0 - share * deep - Z_OFFSET_MM for deep in (2.5, 1.5)]
    assert met == pytest.approx(wanted, abs=0.02)  # steps of 2.5 µm, and the ramps of speed
    down, up, again = z_told(said)
    assert 12.0 - 2.5 - 1e-3 <= down <= 12.0 - share * 2.5 + 0.02  # no deeper than planned
    assert (up, again) == (12.0, 12.0)


def test_what_it_steps_down_it_steps_up_again(tmp_path: Path) -> None:
    """The belief is moved, not the nozzle: two touches of one place end at the same step."""
    touch = ["G1 Z12 F600", "AMREPAIR_TOUCH DEPTH=2.5 SPEED=2", "GET_POSITION"]
    said = klippy(tmp_path, ["G1 X100 Y100 Z12 F3000", *touch, *touch, *touch], share=1.0)
    ends = [int(count) for count in re.findall(r"mcu: .*stepper_z:(-?\d+)$", said, re.MULTILINE)]
    assert len(ends) == 3
    assert max(ends) - min(ends) <= 1


def test_klipper_itself_would_go_on_down(tmp_path: Path) -> None:
    """Why the macro: PROBE alone goes to position_min, fifteen millimetres here."""
    said = klippy(tmp_path, ["G1 X100 Y100 Z12 F3000", "PROBE", "M114"], share=1.0)
    assert z_told(said)[-1] == pytest.approx(LOWEST_MM)


def test_a_touch_that_meets_nothing_leaves_z_true(tmp_path: Path) -> None:
    """regression: Z was forgotten, and a run could not be gone on with: "Must home axis first"."""
    miss = ["AMREPAIR_TOUCH DEPTH=2.5 SPEED=2", "M400", "M114"]
    lines = ["SET_GCODE_OFFSET Z=0.2", "G1 X100 Y100 Z12 F3000", "M400"]
    for _ in range(3):
        lines += [*miss, "G1 Z12 F600", "M400", "M114"]
    said = klippy(tmp_path, lines, share=0.0)
    assert "!! No trigger on" in said
    assert said.count("// amrepair: nothing was touched\n") == 3
    assert "Must home" not in said
    assert "amrepair: touched" not in said
    assert z_told(said) == pytest.approx([12.0 - 2.5, 12.0] * 3, abs=1e-3)


@pytest.mark.parametrize(
    ("config", "lines"),
    [
        (CONFIG.replace("enable_force_move: True", ""), []),
        (CONFIG, ["SET_KINEMATIC_POSITION CLEAR_HOMED=Z"]),
    ],
)
def test_nothing_moves_where_its_depth_cannot_be_bounded(
    config: str, lines: list[str], tmp_path: Path
) -> None:
    """regression: Klipper passes over commands that it does not know; PROBE went to the end."""
    before = ["GET_POSITION", "G1 X100 Y100 Z12 F3000", *lines]
    after = ["AMREPAIR_TOUCH DEPTH=2.5 SPEED=2", "G4 P1000", "M84", "GET_POSITION"]
    said = klippy(tmp_path, [*before, *after], share=1.0, config=config)
    assert re.search("^!! .*amrepair: .*; nothing was touched$", said, re.MULTILINE)
    home, end = (int(n) for n in re.findall(r"mcu: .*stepper_z:(-?\d+)$", said, re.MULTILINE))
    assert abs(end - home - 12 * STEPS_A_MM) <= 1
