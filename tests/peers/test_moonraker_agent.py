"""The agent beside a real Moonraker, the emulated firmware behind it: a slicer's job, mended."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from peer_harness import HERE, MOONRAKER, Web, end, free_port, peer, process, wait_for

from gcode.firmware.motion import MotionFile

pytestmark = pytest.mark.peers

AUTHORIZATION = """\
[authorization]
trusted_clients:
  127.0.0.1
"""
SLICER = """\
gcode_flavor = klipper
bed_shape = 0x0,220x0,220x220,0x220
use_relative_e_distances = 1
layer_gcode = ;AFTER_LAYER\\nG92 E0
layer_height = 0.2
first_layer_height = 0.2
fill_density = 100%
fill_pattern = rectilinear
skirts = 0
temperature = 210
first_layer_temperature = 210
bed_temperature = 60
first_layer_bed_temperature = 60
retract_length = 0.8
start_gcode = G28\\nM190 S[first_layer_bed_temperature]\\nM109 S[first_layer_temperature]
end_gcode = G91\\nG1 Z10 F600\\nG90\\nG1 X10 Y200 F6000\\nM104 S0\\nM140 S0\\nM107
"""
CLOG_MM = (106.0, 107.0, 2.2, 114.0, 114.0, 3.05)
PRUSA_SLICER = shutil.which("prusa-slicer")
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
AMREPAIR = (sys.executable, "-m", "amrepair")


class Stack:
    """An emulated printer, Klipper's stand-in with our macros, Moonraker."""

    def __init__(self, folder: Path, keep: ExitStack) -> None:
        self.folder, self.keep = folder, keep
        self.motion, self.port = folder / "motion.bin", free_port()
        self.klippy, self.own = folder / "klippy.sock", folder / "moonraker.sock"
        for name in ("config", "gcodes", "logs", "database"):
            (folder / name).mkdir()
        text = MOONRAKER.format(port=self.port, klippy=self.klippy) + AUTHORIZATION
        (folder / "config" / "moonraker.conf").write_text(text)
        self.url = f"http://127.0.0.1:{self.port}"
        self.web = Web(self.url, "")

    def start(self, macros: Path) -> None:
        link = self.folder / "printer"
        self._keep("emulator", sys.executable, "-m", "gcode", "emulate", "--accelerated",
                   "--firmware", "klipper", "--printer", "generic_klipper", "--link", link,
                   "--motion", self.motion)  # fmt: skip
        wait_for("the emulated printer", link.exists, self.folder / "emulator.log")
        self._keep("klippy", sys.executable, HERE / "klippy_macros.py", self.klippy,
                   self.folder / "gcodes", macros, link, *CLOG_MM)  # fmt: skip
        self.start_moonraker()

    def start_moonraker(self) -> None:
        self.moonraker = self._keep("moonraker", peer("moonraker"), "-m", "moonraker", "-d",
                                    self.folder, "-u", self.own)  # fmt: skip

        def ready() -> bool:
            info = self.web.get("/server/info").get("result", {})
            return bool(info.get("klippy_state") == "ready")

        wait_for("Moonraker is ready", ready, self.folder / "moonraker.log")

    def _keep(self, name: str, *command: Any) -> subprocess.Popen[bytes]:
        words = [str(word) for word in command]
        return self.keep.enter_context(process(*words, log=self.folder / f"{name}.log"))

    def agent(self, *more: str) -> subprocess.Popen[bytes]:
        return self._keep(
            "agent", *AMREPAIR, "agent", "--moonraker", self.url, "--template",
            self.folder / "block.stl", "--scanner", f"simulated:{self.motion}", "--printer",
            "generic_klipper", "--material", "pla", "--out", self.folder / "runs", "--once", *more,
        )  # fmt: skip

    def upload(self, job: Path) -> None:
        """As a slicer does that sends a job and has it printed."""
        with job.open("rb") as file:
            answer = self.web.http.post(
                "/server/files/upload", files={"file": (job.name, file)}, data={"print": "true"}
            )
        assert answer.status_code == 201, answer.text

    def said(self) -> str:
        return (self.folder / "agent.log").read_text()

    def console(self) -> str:
        """What Mainsail, Fluidd and KlipperScreen show of the printer's console."""
        store = self.web.get("/server/gcode_store?count=1000")["result"]["gcode_store"]
        return "\n".join(str(row["message"]) for row in store)

    def state(self) -> str:
        found = self.web.get("/printer/objects/query?print_stats")
        return str(found.get("result", {}).get("status", {}).get("print_stats", {}).get("state"))


@pytest.fixture
def stack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stack]:
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    with ExitStack() as keep:
        found = Stack(tmp_path, keep)
        yield found
        found.web.http.close()


def command(*words: str | Path) -> None:
    """One of the user's commands."""
    done = subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, check=False, timeout=300,
        env=ENVIRONMENT,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def sliced(folder: Path) -> Path:
    """The first two of the user's commands: slice, and put looks in."""
    part, job, settings = folder / "block.stl", folder / "block.gcode", folder / "slicer.ini"
    trimesh.creation.box((24.0, 20.0, 4.0)).export(part)
    settings.write_text(SLICER)
    command(str(PRUSA_SLICER), "--export-gcode", "--load", settings, "--center", "110,110",
            "--output", job, part)  # fmt: skip
    command(*AMREPAIR, "postprocess", "--for", "klipper", "--every", "0", "--at-z", "3",
            "--no-final", job)  # fmt: skip
    return job


def filament_of(lines: list[str]) -> float:
    """What lines push, mm; all of them are relative."""
    pushed = (re.search(r"^G1 .*E([-\d.]+)", line) for line in lines)
    return sum(float(found.group(1)) for found in pushed if found is not None)


def judge(stack: Stack, job: Path) -> None:
    """What the firmware executed: the void is filled, and no line of the job came twice."""
    batch = MotionFile(stack.motion).take()
    area_mm2 = np.pi / 4 * 1.75**2
    middle = 0.5 * (batch.start_mm + batch.end_mm)
    low, high = np.array(CLOG_MM[:3]), np.array(CLOG_MM[3:])
    level = np.hypot(*(batch.end_mm - batch.start_mm)[:, :2].T) > 0  # beads, not retractions
    inside = ((middle > low) & (middle < high)).all(axis=1) & level
    clogged_mm3 = float(np.prod(high[:2] - low[:2])) * 0.8  # layers at 2.4 to 3.0 mm
    filled_mm3 = float(batch.filament_mm[inside].sum()) * area_mm2
    assert filled_mm3 == pytest.approx(clogged_mm3, rel=0.3)  # what straddles its edges
    lines = job.read_text().split("\n")
    look = next(k for k, line in enumerate(lines) if line.startswith("AMREPAIR_SCAN"))
    above = batch.end_mm[:, 2] > 3.15
    planned = [line for line in lines[look:] if re.match(r"G1 (X|Y).*E", line)]
    assert float(batch.filament_mm[above & level].sum()) == pytest.approx(
        filament_of(planned), rel=1e-4
    )
    assert stack.state() == "complete"


def events(stack: Stack) -> list[dict[str, Any]]:
    runs = list((stack.folder / "runs").glob("*/run.jsonl"))
    return [json.loads(line) for line in runs[0].read_text().splitlines()] if runs else []


def begin(stack: Stack, *more: str) -> tuple[Path, subprocess.Popen[bytes]]:
    """The user's four commands: slice, mark, macros, agent; and the job is sent to be printed."""
    job = sliced(stack.folder)
    macros = stack.folder / "amrepair.cfg"
    command(*AMREPAIR, "agent", "--macros", macros)
    stack.start(macros)
    agent = stack.agent(*more)
    log = stack.folder / "agent.log"
    wait_for("the agent", lambda: log.exists() and "the agent is here" in stack.said(), log)
    stack.upload(job)
    return job, agent


@pytest.mark.skipif(PRUSA_SLICER is None, reason="PrusaSlicer is not installed here")
def test_from_the_slicer_to_a_mended_print_in_four_commands(stack: Stack) -> None:
    job, agent = begin(stack, "--approve", "auto")
    assert agent.wait(timeout=400) == 0, stack.said()
    assert "missing (a void). Printed" in stack.said()
    assert "Nothing is missing any more" in stack.console()
    judge(stack, job)


@pytest.mark.skipif(PRUSA_SLICER is None, reason="PrusaSlicer is not installed here")
def test_asked_and_killed_and_the_server_killed_and_nothing_is_printed_twice(stack: Stack) -> None:
    job, agent = begin(stack)
    log = stack.folder / "agent.log"
    question = "action:prompt_text Print this repair?"
    wait_for("the question", lambda: question in stack.console(), log, 100.0)
    second = subprocess.run(
        [*AMREPAIR, "agent", "--moonraker", stack.url.replace("127.0.0.1", "localhost"),
         "--template", str(stack.folder / "block.stl"), "--scanner", "watch:none"],
        capture_output=True, text=True, check=False, timeout=100, env=ENVIRONMENT,
    )  # fmt: skip
    assert second.returncode == 4
    assert "another agent named 'amrepair' serves the printer" in second.stderr
    end(agent)
    end(stack.moonraker)
    stack.start_moonraker()
    agent = stack.agent()
    wait_for("the question again", lambda: question in stack.console(), log, 100.0)
    (yes,) = set(re.findall(r"Yes\|(.*?)\|primary", stack.console()))
    stack.web.http.post("/printer/gcode/script", json={"script": yes}, timeout=60.0)
    wait_for("the repair", lambda: any(e.get("kind") == "repair" for e in events(stack)), log)
    end(agent)
    agent = stack.agent()
    assert agent.wait(timeout=400) == 0, stack.said()
    assert "gone on with" in stack.said()
    judge(stack, job)
