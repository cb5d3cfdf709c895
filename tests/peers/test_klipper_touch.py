"""The macro AMREPAIR_TOUCH in Klipper itself, from its source, in batch mode.

    AMREPAIR_KLIPPER=~/klipper AMREPAIR_KLIPPER_PYTHON=~/klippy-env/bin/python \\
        pytest -m peers tests/peers/test_klipper_touch.py

`~/klipper` needs `out/klipper.dict` of its own (`make` for the Linux process). In batch mode no pin
triggers: Klipper takes a probing move to have triggered at its end. So each touch is told to have
triggered at a share of its way, and what Klipper makes of that is held against arithmetic.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from gcode.hosts.touching import _TOUCHED
from gcode.resumption.klipper import TOUCH_MACRO

KLIPPER = os.environ.get("AMREPAIR_KLIPPER", "")
PYTHON = os.environ.get("AMREPAIR_KLIPPER_PYTHON", sys.executable)
Z_OFFSET_MM, LOWEST_MM = -0.35, -3.0
pytestmark = [
    pytest.mark.peers,
    pytest.mark.skipif(not KLIPPER, reason="AMREPAIR_KLIPPER names no Klipper source"),
]

RUN = f"""
import runpy, sys
root = {KLIPPER!r} + "/klippy"
sys.path.insert(0, root)
import gcode, mcu
share, folder = float(sys.argv[1]), sys.argv[2]
respond = gcode.GCodeDispatch.respond_raw
def say(self, text):
    print(text, flush=True)
    respond(self, text)
gcode.GCodeDispatch.respond_raw = say
begin, wait = mcu.MCU_endstop.home_start, mcu.MCU_endstop.home_wait
def home_start(self, print_time, *given, **named):
    self.begun = print_time
    return begin(self, print_time, *given, **named)
def home_wait(self, end):
    wait(self, end)
    # 13 is the probe's pin; the axes' own end stops answer as they do
    return self.begun + (end - self.begun) * share if "13" in str(self._pin) else end
mcu.MCU_endstop.home_start, mcu.MCU_endstop.home_wait = home_start, home_wait
sys.argv = [root + "/klippy.py", folder + "/printer.cfg", "-i", folder + "/touch.gcode",
            "-o", folder + "/out", "-d", {KLIPPER!r} + "/out/klipper.dict", "-l", folder + "/log"]
runpy.run_path(root + "/klippy.py", run_name="__main__")
"""

AXIS = """
[stepper_{axis}]
step_pin: gpio{pin}
dir_pin: gpio{dir}
microsteps: 16
rotation_distance: {turn}
endstop_pin: ^gpio{stop}
position_endstop: 0
position_max: 250
position_min: {low}
"""
CONFIG = f"""
[include klipper_touch.cfg]
[mcu]
serial: /tmp/none
[printer]
kinematics: cartesian
max_velocity: 300
max_accel: 3000
[probe]
pin: ^gpio13
z_offset: {Z_OFFSET_MM}
[force_move]
enable_force_move: True
"""


def klippy(folder: Path, lines: list[str], *, share: float) -> str:
    """What Klipper says to a program; its touches trigger at this share of their way."""
    axes = [
        AXIS.format(axis=axis, pin=4 * k + 1, dir=4 * k + 2, stop=4 * k + 3, turn=turn, low=low)
        for k, (axis, turn, low) in enumerate([("x", 40, 0), ("y", 40, 0), ("z", 8, LOWEST_MM)])
    ]
    (folder / "printer.cfg").write_text(CONFIG + "".join(axes))
    (folder / "klipper_touch.cfg").write_text(TOUCH_MACRO)
    (folder / "touch.gcode").write_text("\n".join(["G28", "G90", *lines]) + "\n")
    done = subprocess.run(
        [PYTHON, "-c", RUN, str(share), str(folder)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert "Unable to" not in done.stdout, done.stdout + done.stderr
    return done.stdout


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
