"""A fleet of emulated printers, two of which crash, one is unplugged, one's question is stuck."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import manifold3d as m3
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from loop_bench import LAYER, SIZE_MM, solid_mesh
from loop_children import PRINTER, beads_of
from test_loop_kills import make_ready

from amrepair.fleet.desk import STATUS, read_note
from amrepair.loop.setting import JOB
from amrepair.loop.tape import read_events
from amrepair.template import fit_template
from gcode.firmware import EmulatedPrinterProcess
from gcode.profiles import load_printer

NAMES = ("calm", "mended", "crash-1", "crash-2", "unplugged", "stuck")
BROKEN = ("mended", "stuck")
SLOW = "always slow_reader s=0.004"
ROOT = Path(__file__).parents[2]


class Farm:
    """Printers, what their scanners see, and the fleet's command."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.out = folder, folder / "out"
        self.ready = make_ready(folder / "ready", [LAYER])
        shutil.copy(self.ready / "run" / JOB, folder / "job.gcode")
        mesh = folder / "part.stl"
        solid_mesh(m3.Manifold.cube(SIZE_MM)).export(mesh)
        fit_template(mesh).save(folder / "part.safetensors")
        self.printers = {
            name: EmulatedPrinterProcess(
                "prusa", printer=load_printer(PRINTER), faults=SLOW, record=folder / f"{name}.txt"
            )
            for name in NAMES
        }
        self.dropped: set[str] = set()
        self._over = threading.Event()
        self._eyes = threading.Thread(target=self._look, daemon=True)
        self.write_config(answer_within_s=20.0)

    def write_config(self, *, answer_within_s: float) -> None:
        lines = ['out = "out"', f"answer_within_s = {answer_within_s}"]
        for name, machine in self.printers.items():
            (self.folder / "scans" / name).mkdir(parents=True, exist_ok=True)
            lines += [
                "[[printer]]", f'name = "{name}"', f'port = "{machine.port}"',
                f'scanner = "watch:scans/{name}"', 'job = "job.gcode"',
                'template = "part.safetensors"', f"at_layer = [{LAYER}]",
                f'approve = "{"ask" if name in BROKEN else "auto"}"',
            ]  # fmt: skip
        (self.folder / "fleet.toml").write_text("\n".join(lines) + "\n")

    def start(self) -> None:
        self._eyes.start()
        self.log = (self.folder / "fleet.log").open("w")
        self.process = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-m", "amrepair", "fleet",
             str(self.folder / "fleet.toml"), "--view-port", "0", "--until-done"],
            stdout=self.log, stderr=self.log, cwd=ROOT,
        )  # fmt: skip
        self.until(lambda: "Open http" in self.told())
        found = re.search(r"Open (http://\S+)", self.told())
        assert found is not None
        self.url = found.group(1)

    def told(self) -> str:
        return (self.folder / "fleet.log").read_text()

    def until(self, true: Callable[[], object], *, limit_s: float = 600.0) -> None:
        end_s = time.monotonic() + limit_s
        while not true():
            assert time.monotonic() < end_s, self.told()
            time.sleep(0.1)

    def events(self, name: str) -> list[dict[str, Any]]:
        return read_events(self.out / name)

    def executed(self, name: str) -> list[str]:
        record = self.folder / f"{name}.txt"
        return beads_of(record.read_text().splitlines()) if record.exists() else []

    def rows(self) -> dict[str, dict[str, Any]]:
        with urllib.request.urlopen(self.url + "state.json", timeout=10) as reply:
            return {row["name"]: row for row in json.loads(reply.read())["printers"]}

    def press(self, name: str, word: str, number: int) -> None:
        body = json.dumps({"number": number}).encode()
        with urllib.request.urlopen(self.url + f"printers/{name}/{word}", body, timeout=10) as ok:
            assert json.loads(ok.read()) == {"done": True}

    def kill_in_job(self, name: str, beads: int) -> None:
        """SIGKILL a printer's process while it prints."""
        done = len(self.executed(name))
        self.until(lambda: len(self.executed(name)) >= done + beads)
        pid = (read_note(self.out / name / "desk" / STATUS) or {})["pid"]
        os.kill(pid, signal.SIGKILL)

    def planned(self, name: str) -> list[str]:
        """Every bead that the record says was sent, once each, in order."""
        run, lines, look = self.out / name, [], 0
        job = (run / JOB).read_text().split("\n")
        for event in self.events(name):
            if event["event"] == "look":
                look = int(event["look"])
            elif event["event"] == "send" and event["kind"] == "job":
                lines += job[int(event["first"]) : int(event["end"])]
            elif event["event"] == "send" and event["kind"] == "repair":
                lines += (run / f"repair-{look}.gcode").read_text().split("\n")
        return beads_of(lines)

    def _look(self) -> None:
        """A sensor that looks whenever it likes: what came before it was asked for is not taken."""
        number = 0
        while not self._over.wait(0.5):
            number += 1
            for name in NAMES:
                looks = [e for e in self.events(name) if e["event"] == "look"]
                stopped = [e for e in looks if e["stop"] != "final"]
                broken = name in BROKEN and not any(e["printed"] for e in looks)
                label = f"layer-{LAYER:03d}" if not stopped or not self._moved_on(name) else "final"
                data = (self.ready / f"{'broken' if broken else 'whole'}-{label}.ply").read_bytes()
                aside = self.folder / f".{name}.ply"
                aside.write_bytes(data + bytes(number % 250 + 1))
                aside.rename(self.folder / "scans" / name / f"seen-{number}.ply")

    def _moved_on(self, name: str) -> bool:
        """Whether the job goes on after its first stop."""
        events = self.events(name)
        stops = [k for k, e in enumerate(events) if e["event"] == "look"]
        return any(e["event"] == "send" and e["kind"] == "job" for e in events[stops[0] :])

    def close(self) -> None:
        self._over.set()
        if self._eyes.is_alive():
            self._eyes.join()
        if hasattr(self, "process"):
            if self.process.poll() is None:
                self.process.terminate()
                self.process.wait(120)
            self.log.close()
        for machine in self.printers.values():
            machine.stop()


@pytest.fixture
def farm(tmp_path: Path) -> Iterator[Farm]:
    found = Farm(tmp_path)
    yield found
    found.close()


def heaters_off(record: Path) -> bool:
    """The last word to each heater was 0."""
    last: dict[str, str] = {}
    for line in record.read_text().splitlines():
        if match := re.match(r"(M104|M109|M140|M190) S(\d+)", line):
            last["nozzle" if match[1] in ("M104", "M109") else "bed"] = match[2]
    return last == {"nozzle": "0", "bed": "0"}


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_two_crashes_an_unplugged_port_and_a_stuck_question(farm: Farm) -> None:
    farm.start()
    farm.until(lambda: all(len(farm.executed(name)) > 5 for name in NAMES))
    farm.kill_in_job("crash-1", 10)
    farm.kill_in_job("crash-2", 25)
    farm.printers["unplugged"].stop()
    farm.until(lambda: farm.rows()["mended"]["question"])
    question = farm.rows()["mended"]["question"]
    assert any("missing" in line for line in question["lines"]), question
    farm.press("mended", "approve", question["number"])
    pages: list[dict[str, dict[str, Any]]] = []

    def ended() -> bool:
        if farm.process.poll() is None:
            try:
                pages.append(farm.rows())
            except OSError:
                return farm.process.wait(60) is not None
        return farm.process.poll() is not None

    farm.until(ended)
    last = pages[-1]
    print(farm.told())
    assert farm.process.returncode == 4  # one needs somebody
    assert {name: row["state"] for name, row in last.items()} == {
        "calm": "done",
        "mended": "done",
        "crash-1": "done",
        "crash-2": "done",
        "unplugged": "needs somebody",
        "stuck": "stopped",
    }
    assert "nobody answered" in last["stuck"]["sentence"]
    assert last["unplugged"]["sentence"]
    assert [last[name]["restarts"] for name in NAMES] == [0, 0, 1, 1, 0, 0]
    for name in ("calm", "mended", "crash-1", "crash-2"):
        assert farm.executed(name) == farm.planned(name), name  # nothing twice, nothing left out
        assert farm.events(name)[-1]["event"] == "end"
    assert any(e["event"] == "send" and e["kind"] == "repair" for e in farm.events("mended"))
    for name in NAMES:
        assert name == "unplugged" or heaters_off(farm.folder / f"{name}.txt"), name
