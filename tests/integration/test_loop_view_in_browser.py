"""`amrepair loop --view` as it is typed: its own process, an emulated printer, scans in a folder.

Chromium presses the buttons; what became of it is read from what the printer carried out.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_forks import until
from loop_bench import LAYER, PLACE_MM, SIZE_MM, scan_of, solid_mesh
from loop_children import PRINTER, beads_of

from amrepair.loop.tape import read_events
from amrepair.scans import write_ply
from gcode.check import check
from gcode.firmware import EmulatedPrinterProcess
from gcode.profiles import load_printer, load_setup
from gcode.reader import read_job
from gcode.slicing.job import plan_part
from gcode.writer import write
from tests.integration.browser import Watched, launched, why_not

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(bool(why_not()), reason=why_not()),
]
SLOW = "always slow_reader s=0.004"  # long enough to press a button while it prints
PROGRAM = "from amrepair.cli import main; main()"
STOP = f"layer-{LAYER:03d}"
QUIET_S = 1.5  # a thousand times what a line takes


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as found:
        yield found


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job, its part, and what a sensor sees of it with a pocket and without."""
    import manifold3d as m3

    here = tmp_path_factory.mktemp("prepared")
    setup = load_setup(PRINTER, "pla", "repair_0.20")
    part = m3.Manifold.cube(SIZE_MM)
    program = write(plan_part(part.translate(PLACE_MM), setup).toolpath, setup, title="small")
    check(program, setup)
    (here / "job.gcode").write_text(program.text)
    solid_mesh(part).export(here / "part.stl")
    job = read_job(program, dialect=program.dialect)
    for label, top_mm in ((STOP, job.layers[LAYER].z_mm), ("final", SIZE_MM[2])):
        stands = part.trim_by_plane((0.0, 0.0, -1.0), -top_mm).translate(PLACE_MM)
        pocket = m3.Manifold.cube((5.0, 5.0, 2.0)).translate((105.0, 93.0, top_mm - 0.6))
        for name, solid in (("whole", stands), ("broken", stands - pocket)):
            write_ply(scan_of(solid), here / f"{name}-{label}.ply")
    return here


class Command:
    """The command in its process, its printer, and a sensor that sees what stands there."""

    def __init__(self, prepared: Path, folder: Path) -> None:
        self.prepared, self.out, self.drop = prepared, folder / "run", folder / "scans"
        self.drop.mkdir()
        self.record = folder / "executed"
        self.printer = EmulatedPrinterProcess(
            "prusa", printer=load_printer(PRINTER), faults=SLOW, record=self.record
        )
        self._stdout, self._stderr = folder / "stdout", folder / "stderr"
        words = [prepared / "job.gcode", "--template", prepared / "part.stl"]
        words += ["--port", self.printer.port, "--scanner", f"watch:{self.drop}"]
        words += ["--at-layer", LAYER, "--out", self.out, "--view", "--view-port", "0", "--json"]
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
        for due in range(100):
            looks: list[dict[str, Any]] = []
            while not (self._at_rest() and len(looks) == due):
                if self._over.wait(0.1):
                    return
                looks = [e for e in read_events(self.out) if e["event"] == "look"]
            last = looks[-1] if looks else {"stop": STOP, "printed": False, "declined": False}
            label = STOP if not looks or (last["stop"] == STOP and last["printed"]) else "final"
            which = "broken" if not looks or last["declined"] else "whole"
            aside = self.drop.parent / "aside.ply"
            seen = (self.prepared / f"{which}-{label}.ply").read_bytes()
            aside.write_bytes(seen + bytes(due + 1))  # no scan is like another
            aside.rename(self.drop / f"{'end' if label == 'final' else label}-{due}.ply")

    def _at_rest(self) -> bool:
        """Whether the last thing that was printed is a stop's parking, or its repair."""
        events = read_events(self.out)
        kinds = [event["kind"] for event in events if event["event"] == "send"]
        return bool(kinds) and events[-1]["event"] == "sent" and kinds[-1] in ("park", "repair")

    def url(self) -> str:
        """The address that it says to open."""
        found: list[str] = []

        def said() -> bool:
            assert self.process.poll() is None, self._stderr.read_text()
            found.extend(re.findall(r"http://\S+?(?=:? )", self._stderr.read_text()))
            return bool(found)

        until(said)
        return found[0]

    def laid(self) -> int:
        """Beads that the printer laid so far."""
        return len(beads_of(self.record.read_text().splitlines())) if self.record.exists() else 0

    def ended(self) -> tuple[int, dict[str, Any], str]:
        """Exit code, the one object on standard output, what was said."""
        code = self.process.wait(300)
        return code, json.loads(self._stdout.read_text()), self._stderr.read_text()


@pytest.fixture
def command(prepared: Path, tmp_path: Path) -> Iterator[Command]:
    with Command(prepared, tmp_path) as made:
        yield made


def wait_for(page: Any, button: str) -> Any:
    """The button, once it can be pressed."""
    page.wait_for_function(
        "(name) => [...document.querySelectorAll('button')]"
        ".some((b) => b.innerText.trim() === name && !b.disabled)",
        arg=button,
    )
    return page.get_by_role("button", name=button)


def test_approve_prints_the_repair(browser: Any, command: Command, prepared: Path) -> None:
    watched = Watched(browser, command.url())
    wait_for(watched.page, "Approve").click()
    code, result, said = command.ended()
    assert code == 0, said
    assert [stop["printed"] for stop in result["stops"]] == [True, False, False]
    assert result["missing_mm3_before"] > 10 * result["missing_mm3_after"]
    job = beads_of((prepared / "job.gcode").read_text().splitlines())
    patch = beads_of(Path(result["gcode"]).read_text().splitlines())
    assert command.laid() == len(job) + len(patch)
    assert "leaked" not in said
    assert "Traceback" not in said


def test_skip_prints_the_job_alone(browser: Any, command: Command, prepared: Path) -> None:
    watched = Watched(browser, command.url())
    wait_for(watched.page, "Skip").click()  # on the way
    watched.page.get_by_text(f"{STOP}: skipped").wait_for()
    wait_for(watched.page, "Skip").click()  # and at the end, where it is still missing
    code, result, said = command.ended()
    assert code == 3, said
    assert [stop["declined"] for stop in result["stops"]] == [True, True]
    assert result["gcode"] is None
    job = beads_of((prepared / "job.gcode").read_text().splitlines())
    assert command.laid() == len(job)
    assert "leaked" not in said


def test_pause_holds_the_nozzle_until_it_is_told_to_go_on(
    browser: Any, command: Command, prepared: Path
) -> None:
    watched = Watched(browser, command.url())
    page = watched.page
    until(lambda: command.laid() > 10)
    wait_for(page, "Pause").click()
    wait_for(page, "Go on")
    before = -1
    while before != (before := command.laid()):
        time.sleep(QUIET_S)  # the line under way, and what the printer had buffered
    job = beads_of((prepared / "job.gcode").read_text().splitlines())
    assert before < len(job) * 0.6  # it rests in mid-job, before its first stop
    assert command.process.poll() is None
    wait_for(page, "Go on").click()
    until(lambda: command.laid() > before)
    wait_for(page, "Approve").click()
    code, result, said = command.ended()
    assert code == 0, said
    patch = beads_of(Path(result["gcode"]).read_text().splitlines())
    laid = np.array(beads_of(command.record.read_text().splitlines()))
    assert len(laid) == len(job) + len(patch)  # nothing twice, nothing left out
