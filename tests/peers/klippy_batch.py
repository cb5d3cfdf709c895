"""Klipper itself, from its source, in batch mode: what it makes of a program.

    AMREPAIR_KLIPPER=~/klipper AMREPAIR_KLIPPER_PYTHON=~/klippy-env/bin/python \\
        pytest -m peers tests/peers/test_klipper_touch.py tests/peers/test_klipper_objects.py

`~/klipper` needs `out/klipper.dict` of its own (`make` for the Linux process).
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from peer_harness import HERE

KLIPPER = os.environ.get("AMREPAIR_KLIPPER", "")
PYTHON = os.environ.get("AMREPAIR_KLIPPER_PYTHON", sys.executable)
MARKS = [
    pytest.mark.peers,
    pytest.mark.skipif(not KLIPPER, reason="AMREPAIR_KLIPPER names no Klipper source"),
]
HEAD = """\
[mcu]
serial: /tmp/none
[printer]
kinematics: cartesian
max_velocity: 300
max_accel: 3000
"""
AXIS = """\
[stepper_{axis}]
step_pin: gpio{step}
dir_pin: gpio{dir}
microsteps: 16
rotation_distance: {turn}
endstop_pin: ^gpio{stop}
position_endstop: 0
position_max: 250
position_min: {low}
"""
AXES = [("x", 40), ("y", 40), ("z", 8)]


def klippy(
    folder: Path, config: str, lines: list[str], *, lowest_mm: float, share: float = 1.0
) -> list[str]:
    """The rows that `klippy_child` prints of a program: SAID and MOVE.

    Parameters
    ----------
    config
        Of printer.cfg, what is not common.
    lowest_mm
        Down to where Z may go.
    share
        Of its way at which a probe triggers; 0: never.
    """
    folder.mkdir(exist_ok=True)
    axes = [
        AXIS.format(axis=axis, step=4 * k + 1, dir=4 * k + 2, stop=4 * k + 3, turn=turn,
                    low=lowest_mm if axis == "z" else 0)
        for k, (axis, turn) in enumerate(AXES)
    ]  # fmt: skip
    (folder / "printer.cfg").write_text(HEAD + config + "".join(axes))
    (folder / "job.gcode").write_text("\n".join(lines) + "\n")
    words = [PYTHON, HERE / "klippy_child.py", KLIPPER, folder, share]
    done = subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, timeout=250, check=False
    )
    assert "Unable to" not in done.stdout, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout.splitlines()


def said(rows: list[str]) -> list[str]:
    """What Klipper said."""
    return [row[5:] for row in rows if row.startswith("SAID ")]
