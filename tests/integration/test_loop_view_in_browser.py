"""`amrepair loop --view` as it is typed: its own process, an emulated printer, scans in a folder.

Chromium presses the buttons; what became of it is read from what the printer carried out.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import manifold3d as m3
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_forks import until
from loop_bench import solid_mesh
from loop_children import PRINTER, beads_of

from amrepair.frames import Transform
from amrepair.loop import Look, Tape
from amrepair.loop.tape import read_events
from amrepair.scans import Scan, write_ply
from amrepair.simulate.defects import parse_defect
from amrepair.simulate.run import prepare_run, simulate_run
from amrepair.template import MeshSdf
from gcode.firmware import EmulatedPrinterProcess
from gcode.profiles import load_printer, load_setup
from tests.integration.browser import Watched, launched, why_not

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(bool(why_not()), reason=why_not()),
]
SLOW = "always slow_reader s=0.005"  # long enough to see it print
SMALL = {"width": 700, "height": 560}  # drawn without a GPU, every pixel counts
QUIET_S = 1.5  # a hundred times what a line takes
PROGRAM = "from amrepair.cli import main; main()"
AGAIN = "look again"
EVERY_NTH = 8  # of the points: some ninety thousand, three at every 0.2 mm, are enough for a void
START_S = 200.0  # a process that compiles its kernels first, on a busy machine
SENSOR_S = 1.0  # a scan takes its time; one from before it was asked for would be no answer


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as found:
        yield found


@dataclass(frozen=True)
class Prepared:
    """A job with its part, and what a sensor saw when it was printed with a void and mended."""

    folder: Path
    layer: int

    @property
    def stop(self) -> str:
        return f"layer-{self.layer:03d}"

    def job_beads(self) -> list[str]:
        return beads_of((self.folder / "job.gcode").read_text().splitlines())


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    here = tmp_path_factory.mktemp("prepared")
    solid = m3.Manifold.cube((22.0, 18.0, 3.0))
    solid += m3.Manifold.cube((12.0, 11.0, 1.5)).translate((3.0, 3.0, 2.9))
    mesh = solid_mesh(solid)
    mesh.export(here / "part.stl")
    defects = [parse_defect("void:diameter=7,layers=3")]
    run = prepare_run(MeshSdf.from_mesh(mesh), load_setup(PRINTER), defects, title="plate", seed=3)
    (here / "job.gcode").write_text(run.checked.program.text)
    looks: list[Look] = []
    poses: list[Transform] = []
    simulate_run(
        run, record=looks.append, begun=lambda pose, printer: [poses.append(pose), Tape()][1]
    )
    for look in looks:  # the first of a stop is kept as broken, the last as whole
        seen = thinned(look.scan.moved(poses[0]))
        for which in ("broken", "whole"):
            path = here / f"{which}-{look.stop.label}.ply"
            if which == "whole" or not path.exists():
                write_ply(seen, path)
    layer = run.stops[0].layer_index
    assert layer is not None
    return Prepared(here, layer)


def thinned(scan: Scan) -> Scan:
    """What a coarser sensor would have seen."""
    return scan.subset(np.arange(0, len(scan), EVERY_NTH))


class Command:
    """The command in its process, its printer, and a sensor that sees what stands there."""

    def __init__(self, prepared: Prepared, folder: Path, faults: str) -> None:
        self.prepared, self.out, self.drop = prepared, folder / "run", folder / "scans"
        self.drop.mkdir()
        self.record = folder / "executed"
        self.printer = EmulatedPrinterProcess(
            "prusa", printer=load_printer(PRINTER), faults=faults, record=self.record
        )
        self._stdout, self._stderr = folder / "stdout", folder / "stderr"
        words = [prepared.folder / "job.gcode", "--template", prepared.folder / "part.stl"]
        words += ["--port", self.printer.port, "--scanner", f"watch:{self.drop}"]
        words += [
            "--at-layer",
            prepared.layer,
            "--out",
            self.out,
            "--view",
            "--view-port",
            "0",
            "--json",
        ]
        with self._stdout.open("w") as stdout, self._stderr.open("w") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, "-c", PROGRAM, "loop", *map(str, words)],
                stdout=stdout, stderr=stderr,
            )  # fmt: skip
        self._over = threading.Event()
        self._sensor = threading.Thread(target=self._see)
        self._sensor.start()

    def __enter__(self) -> Command:
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._sensor.join()
        self.process.kill()
        self.process.wait()
        self.printer.stop()

    def _see(self) -> None:
        """One scan of what stands there for every look, once the nozzle is out of the way."""
        stop = self.prepared.stop
        for due in range(100):
            looks: list[dict[str, Any]] = []
            while not (self._at_rest(looks) and len(looks) == due):
                if self._over.wait(0.1):
                    return
                looks = [e for e in read_events(self.out) if e["event"] == "look"]
            if self._over.wait(SENSOR_S):
                return
            here = not looks or looks[-1]["stop"] == stop
            stays = not looks or looks[-1]["printed"] or looks[-1]["decision"]["action"] == AGAIN
            label = stop if here and stays else "final"
            which = "whole" if any(look["printed"] for look in looks) else "broken"
            aside = self.drop.parent / "aside.ply"
            seen = (self.prepared.folder / f"{which}-{label}.ply").read_bytes()
            aside.write_bytes(seen + bytes(due + 1))  # no scan is like another
            aside.rename(self.drop / f"{'end' if label == 'final' else label}-{due}.ply")

    def _at_rest(self, looks: list[dict[str, Any]]) -> bool:
        """Whether the last thing on the tape is a parking, a repair, or a look that asks again."""
        events = read_events(self.out)
        kinds = [event["kind"] for event in events if event["event"] == "send"]
        if looks and events[-1] == looks[-1]:
            return bool(looks[-1]["decision"]["action"] == AGAIN)
        return bool(kinds) and events[-1]["event"] == "sent" and kinds[-1] in ("park", "repair")

    def url(self) -> str:
        """The address that it says to open."""
        found: list[str] = []

        def said() -> bool:
            assert self.process.poll() is None, self._stderr.read_text()
            found.extend(re.findall(r"http://\S+?(?=:? )", self._stderr.read_text()))
            return bool(found)

        end_s = time.monotonic() + START_S
        while not said():
            assert time.monotonic() < end_s, self._stderr.read_text()
            time.sleep(0.1)
        return found[0]

    def laid(self) -> int:
        """Beads that the printer laid so far."""
        return len(beads_of(self.record.read_text().splitlines())) if self.record.exists() else 0

    def ended(self) -> tuple[int, dict[str, Any], str]:
        """Exit code, the one object on standard output, what was said."""
        code = self.process.wait(300)
        return code, json.loads(self._stdout.read_text()), self._stderr.read_text()


@pytest.fixture
def command(
    prepared: Prepared, tmp_path: Path, request: pytest.FixtureRequest
) -> Iterator[Command]:
    with Command(prepared, tmp_path, getattr(request, "param", "")) as made:
        yield made


@pytest.fixture
def opened(browser: Any, command: Command) -> Iterator[Watched]:
    watched = Watched(browser, command.url(), viewport=SMALL)
    yield watched
    watched.page.close()


def wait_for(page: Any, button: str) -> Any:
    """The button, once it can be pressed."""
    page.wait_for_function(
        "(name) => [...document.querySelectorAll('button')]"
        ".some((b) => b.innerText.trim() === name && !b.disabled)",
        arg=button,
    )
    return page.get_by_role("button", name=button)


def test_approve_prints_the_repair(opened: Watched, command: Command, prepared: Prepared) -> None:
    wait_for(opened.page, "Approve").click()
    code, result, said = command.ended()
    assert code == 0, said
    assert [stop["printed"] for stop in result["stops"]].count(True) == 1
    assert result["missing_mm3_before"] > 5 * result["missing_mm3_after"]
    job = prepared.job_beads()
    patch = beads_of(Path(result["gcode"]).read_text().splitlines())
    assert command.laid() == len(job) + len(patch)
    assert "leaked" not in said
    assert "Traceback" not in said


def test_skip_prints_the_job_alone(opened: Watched, command: Command, prepared: Prepared) -> None:
    wait_for(opened.page, "Skip").click()
    code, result, said = command.ended()
    assert code == 3, said
    assert [stop["declined"] for stop in result["stops"]].count(True) == 1
    assert result["gcode"] is None
    job = prepared.job_beads()
    assert command.laid() == len(job)
    assert "leaked" not in said


@pytest.mark.parametrize("command", [SLOW], indirect=True, ids=["slow printer"])
def test_pause_holds_the_nozzle_until_it_is_told_to_go_on(
    opened: Watched, command: Command, prepared: Prepared
) -> None:
    page = opened.page
    until(lambda: command.laid() > 10)
    os.kill(command.printer.pid, signal.SIGSTOP)  # it prints, and waits for our click
    wait_for(page, "Pause").click()
    go_on = wait_for(page, "Go on")
    os.kill(command.printer.pid, signal.SIGCONT)
    page.get_by_text("the nozzle is lifted after the line under way").wait_for()
    before = -1
    while before != (before := command.laid()):
        time.sleep(QUIET_S)  # the line under way, and what the printer had buffered
    job = prepared.job_beads()
    assert 10 < before < len(job) * 0.6  # it rests in mid-job, before its first stop
    assert command.process.poll() is None
    go_on.click()
    until(lambda: command.laid() > before)
    wait_for(page, "Approve").click()
    code, result, said = command.ended()
    assert code == 0, said
    patch = beads_of(Path(result["gcode"]).read_text().splitlines())
    assert command.laid() == len(job) + len(patch)  # nothing twice, nothing left out
    assert opened.complaints == []
