"""A Klipper that prints: klippy and its micro-controller's program, which finds hardware of ours.

    AMREPAIR_KLIPPER=~/klipper AMREPAIR_KLIPPER_PYTHON=~/klippy-env/bin/python \\
        pytest -m peers tests/peers/test_klipper_live.py

`~/klipper/out` is built for the Linux process (`make menuconfig`, `make`). What the program asks
the kernel for, `klipper_pins.c` answers. Where the nozzle goes is asked of Klipper's own API.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import socket
import subprocess
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pytest
from klippy_batch import KLIPPER, PYTHON
from peer_harness import HERE, process, wait_for

from gcode.firmware import MotionBatch

# Coarse steps, for they are made in real time by a process that nobody gives priority.
AXIS = """\
[stepper_{axis}]
step_pin: gpio{step}
dir_pin: gpio{dir}
endstop_pin: gpio{stop}
microsteps: 1
rotation_distance: {turn}
position_endstop: 0
position_min: {low}
position_max: 250
homing_speed: {speed}
"""
AXES = (("x", 40, 0, 50), ("y", 40, 0, 50), ("z", 4, -2, 10))
CONFIG = """\
[mcu]
serial: {folder}/mcu
[printer]
kinematics: cartesian
max_velocity: 300
max_accel: 3000
[adc_temperature straight]
temperature1: 0
voltage1: 0
temperature2: 400
voltage2: 5
[extruder]
step_pin: gpio21
dir_pin: gpio22
microsteps: 1
rotation_distance: 8
nozzle_diameter: 0.4
filament_diameter: 1.75
heater_pin: gpio23
sensor_type: straight
sensor_pin: analog0
control: watermark
min_temp: 0
max_temp: 300
[heater_bed]
heater_pin: gpio24
sensor_type: straight
sensor_pin: analog1
control: watermark
min_temp: 0
max_temp: 130
[fan]
pin: gpio25
[virtual_sdcard]
path: {folder}/gcodes
[pause_resume]
[exclude_object]
[display_status]
[gcode_arcs]
[respond]
"""
# Steps are due to the millisecond, and a machine that is busy otherwise brings a shutdown.
FIRST = (("chrt", "-f", "10"), ("-r",)) if os.geteuid() == 0 else ((), ())
"""What comes before klippy, and after the micro-controller's program."""
ARMED = ("toolhead", "extruder")
ANSWER_S = 30.0  # a method's, while a macro is carried out
TOLD_S = 0.75  # bulk_sensor.BATCH_INTERVAL, and half as much again on a machine that is busy


def live_klipper() -> tuple[Path, Path]:
    """Klipper's source and its micro-controller's program; skips, visibly, where there is none."""
    program = Path(KLIPPER) / "out" / "klipper.elf"
    if not KLIPPER or not program.is_file() or shutil.which("cc") is None:
        pytest.skip("AMREPAIR_KLIPPER names no Klipper whose out/ is built for Linux, or no cc")
    return Path(KLIPPER), program


class LiveKlipper:
    """Runs it.

    Parameters
    ----------
    more
        Of printer.cfg, what comes after `CONFIG`.
    """

    def __init__(self, folder: Path, more: str = "") -> None:
        self.folder, self.port, self.socket = folder, str(folder / "tty"), folder / "klippy.sock"
        self._source, self._program = live_klipper()
        axes = [
            AXIS.format(axis=axis, step=4 * k + 1, dir=4 * k + 2, stop=4 * k + 3,
                        turn=turn, low=low, speed=speed)
            for k, (axis, turn, low, speed) in enumerate(AXES)
        ]  # fmt: skip
        (folder / "gcodes").mkdir(exist_ok=True)
        config = CONFIG.format(folder=folder) + "".join(axes) + more
        (folder / "printer.cfg").write_text(config)
        self._pins = folder / "pins.so"
        words = ["cc", "-shared", "-fPIC", "-O2", "-o", self._pins, HERE / "klipper_pins.c"]
        subprocess.run([str(word) for word in (*words, "-ldl", "-lm")], check=True)
        self._keep = ExitStack()

    def __enter__(self) -> LiveKlipper:
        self.start_board()
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._keep.close()

    def start_board(self) -> None:
        """The micro-controller."""
        command = ("env", f"LD_PRELOAD={self._pins}", self._program, "-I", self.folder / "mcu",
                   *FIRST[1])  # fmt: skip
        self.board = self._keep.enter_context(process(*command, log=self.folder / "mcu.log"))
        wait_for("the board", (self.folder / "mcu").exists, self.folder / "mcu.log")

    def start(self) -> None:
        """Klippy; it is ready when this returns."""
        self.socket.unlink(missing_ok=True)
        self.log = self.folder / "klippy.log"
        klippy, config = self._source / "klippy" / "klippy.py", self.folder / "printer.cfg"
        command = (*FIRST[0], PYTHON, klippy, config, "-I", self.port, "-a", self.socket,
                   "-l", self.log)  # fmt: skip
        log = self.folder / "klippy.out"
        self.klippy = self._keep.enter_context(process(*command, log=log))
        wait_for("Klipper is ready", self.is_ready, log)
        self.moves = self._keep.enter_context(Moves(self.socket))

    def is_ready(self) -> bool:
        """Whether it says so."""
        try:
            with Api(self.socket) as api:
                return bool(api.call("info")["state"] == "ready")
        except OSError:
            return False


class Api:
    """Klipper's API socket (docs/API_Server.md), asked one thing after another."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._rest = b""
        self.unasked: list[dict[str, Any]] = []
        try:
            self._socket.connect(str(path))
        except OSError:
            self._socket.close()
            raise

    def __enter__(self) -> Api:
        return self

    def __exit__(self, *error: object) -> None:
        with suppress(OSError):  # Klipper may have gone first
            self._socket.shutdown(socket.SHUT_RDWR)  # who listens hears of it
        self._socket.close()

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """The result of a method."""
        request = {"id": 1, "method": method, "params": params}
        self._socket.sendall(json.dumps(request).encode() + b"\x03")
        while "id" not in (answer := self.hear()):
            self.unasked.append(answer)
        assert "result" in answer, answer
        return dict(answer["result"])

    def hear(self, *, asked: bool = True) -> dict[str, Any]:
        """The next message; one that nobody asked for may take hours."""
        self._socket.settimeout(ANSWER_S if asked else None)
        while b"\x03" not in self._rest:
            data = self._socket.recv(65536)
            if not data:
                raise ConnectionError("Klipper has closed its API socket")
            self._rest += data
        message, _, self._rest = self._rest.partition(b"\x03")
        return dict(json.loads(message))

    def query(self, **objects: Any) -> dict[str, Any]:
        """The state of objects."""
        return dict(self.call("objects/query", objects=objects)["status"])


class Moves:
    """What Klipper has its tool head and its extruder do, by its own `motion_report`.

    Each of the two is told by itself, every half a second: what one was told of may be the other's
    next message.
    """

    def __init__(self, path: Path) -> None:
        self._api = Api(path)
        self._lock = threading.Lock()
        self._at = [0.0, 0.0, 0.0]
        self._told: dict[str, list[list[Any]]] = {name: [] for name in ARMED}
        self._heard: list[tuple[float, float]] = []
        self._lost: Exception | None = None
        for name in ARMED:
            self._api.call("motion_report/dump_trapq", name=name, response_template={"armed": name})
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def __enter__(self) -> Moves:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._api.__exit__()
        self._thread.join()

    def _listen(self) -> None:
        try:
            while True:
                message = self._api.hear(asked=False)
                told = message["params"]["data"]
                with self._lock:
                    self._told[message["armed"]] += told
                    self._heard.append((time.monotonic(), told[-1][0]))
        except OSError as lost:
            self._lost = lost

    def take(self, *, settle_s: float = 2 * TOLD_S) -> MotionBatch:
        """Everything since the last call, but for what the other of the two may yet be told of.

        What was moved `2 * TOLD_S` ago has been told by both.
        """
        time.sleep(settle_s)
        if self._lost is not None:
            raise ConnectionError("Klipper tells its moves no more") from self._lost
        with self._lock:
            sure_s = time.monotonic() - TOLD_S
            until = max((last for at_s, last in self._heard if at_s <= sure_s), default=-math.inf)
            self._heard = [heard for heard in self._heard if heard[0] > sure_s]
            told = {name: [row for row in self._told[name] if row[0] <= until] for name in ARMED}
            for name in ARMED:
                self._told[name] = [row for row in self._told[name] if row[0] > until]
        rows: dict[float, list[float]] = {}
        for row in told["toolhead"]:
            start, end, speed = _ends(row)
            rows[row[0]] = [*start, *end, 0.0, speed, row[0] + row[1]]
        for row in told["extruder"]:
            start, end, speed = _ends(row)
            alone = [math.nan] * 6 + [0.0, abs(speed), row[0] + row[1]]
            rows.setdefault(row[0], alone)[6] = end[0] - start[0]
        for _, numbers in sorted(rows.items()):
            if math.isnan(numbers[0]):
                numbers[:6] = self._at * 2
            self._at = numbers[3:6]
        moved = [numbers for _, numbers in sorted(rows.items())]
        return MotionBatch.from_bytes(np.array(moved, dtype=np.float64).tobytes())


def _ends(row: list[Any]) -> tuple[np.ndarray, np.ndarray, float]:
    """Start, end and mean speed of a piece of constant acceleration."""
    _, took_s, speed, acceleration, start, way = row
    length = (speed + 0.5 * acceleration * took_s) * took_s
    return np.array(start), np.array(start) + length * np.array(way), length / max(took_s, 1e-9)
