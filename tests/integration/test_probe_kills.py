"""The loop killed while the printer's own probe touches: gone on with, nothing printed twice."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_forks import Forks, until
from loop_children import beads_of
from probe_children import MENDED
from probe_job import plate, standing

from amrepair.frames import Transform
from amrepair.loop import plan_stops
from amrepair.loop.run_folder import Setting, keep
from amrepair.loop.tape import TAPE, read_events
from amrepair.scans import PROBE
from gcode.reader import read_job

SIZE_MM = (16.0, 12.0, 0.8)
DENT = (0.0, 0.0, 3.0, 0.12)
"""Off, and so touched around; too shallow to be a defect."""
KILLED = -9
TOUCHES = ("G38.2", "AMREPAIR_TOUCH")


MARLIN = "generic_marlin"
KLIPPER = pytest.param("generic_klipper", marks=pytest.mark.slow)


@pytest.fixture(scope="module", params=[MARLIN, KLIPPER])
def prepared(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small plate's run, looked at once it is finished, and what then stands there."""
    here = tmp_path_factory.mktemp(request.param)
    run = plate(SIZE_MM, printer=request.param)
    program = run.checked.program
    stops = plan_stops(read_job(program, dialect=program.dialect), [])
    setting = Setting.of(
        run.setup, (request.param, "pla", "repair_0.20"), stops=stops,
        build_from_template=run.build_from_template,
        build_from_scanner=Transform.identity("build", PROBE),
        by_beads=False, seed=0, scanner=PROBE,
    )  # fmt: skip
    keep(here / "run", setting, program.text, run.template)
    standing(run, stops[-1], DENT, rough_mm=0.0, seed=0).write(here / "standing.npz")
    (here / "printer").write_text(request.param)
    return here


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    with Forks("probe_children") as forks:
        yield forks


class Bench:
    """A printer with a probe, and one loop after another."""

    def __init__(self, forks: Forks, prepared: Path, folder: Path, *, dead: bool = False) -> None:
        shutil.copytree(prepared, folder)
        self.forks, self.folder = forks, folder
        self.port, self.record = folder / "port", folder / "executed"
        self.printer = forks.printer(
            self.port, self.record, printer=(folder / "printer").read_text(),
            standing=str(folder / "standing.npz"), dead=dead,
        )  # fmt: skip

    def start(self, *, go_on: bool, die_after: int = 0) -> int:
        return self.forks.start(
            "loop", folder=str(self.folder), port=str(self.port), go_on=go_on, die_after=die_after
        )

    def told(self) -> str:
        return (self.folder / "told").read_text()

    def executed(self) -> list[str]:
        return self.record.read_text().splitlines() if self.record.exists() else []

    def touched(self) -> int:
        return sum(line.startswith(TOUCHES) for line in self.executed())

    def kill_after_touches(self, child: int, count: int) -> None:
        """Kill once so many more touches are carried out."""
        enough = self.touched() + count
        over = self.folder / "told"
        until(lambda: self.touched() >= enough or over.exists())
        assert not over.exists(), self.told()
        assert self.forks.kill(child) == KILLED

    def finish(self) -> list[list[float]]:
        """Go on to the end; where the touches met something, by tour."""
        assert self.forks.wait(self.start(go_on=True)) == 0, self.told()
        events = read_events(self.folder / "run")
        assert events[-1]["event"] == "end"
        assert "within: True" in self.told()
        job = (self.folder / "run" / "job.gcode").read_text().split("\n")
        assert beads_of(self.executed()) == beads_of(job)
        return [e["met_mm"] for e in events if "met_mm" in e]

    def hot_touches(self) -> list[int]:
        """Touches that were made while the hotend was to be hot."""
        found, target = [], 0.0
        for k, line in enumerate(self.executed()):
            if line.startswith(("M104 S", "M109 S")):
                target = float(line.split("S")[1])
            elif line.startswith(TOUCHES) and target > 0:
                found.append(k)
        return found


def test_killed_while_it_touches_it_goes_on(forks: Forks, prepared: Path, tmp_path: Path) -> None:
    """regression: 'somebody has printed on this port since', where nobody had."""
    bench = Bench(forks, prepared, tmp_path / "run")
    bench.kill_after_touches(bench.start(go_on=False), 5)
    tours = bench.finish()
    assert len(tours) > 1  # around the dent
    planned = sum(len(tour) for tour in tours)
    # what the kill cost: the tour that was cut short
    assert planned < bench.touched() <= planned + len(tours[0])
    assert not bench.hot_touches()
    assert f"touches: {planned}" in bench.told()


@pytest.mark.slow
def test_a_touch_that_met_nothing_is_gone_on_with(
    forks: Forks, prepared: Path, tmp_path: Path
) -> None:
    """regression: Klipper's Z was forgotten after it: "Must home axis first"."""
    bench = Bench(forks, prepared, tmp_path / "run", dead=True)
    assert forks.wait(bench.start(go_on=False)) == 4
    assert "Nothing was felt " in bench.told()
    assert bench.touched() == 1
    after = [k for k, line in enumerate(bench.executed()) if line.startswith(TOUCHES)][-1]
    assert {"M104 S0", "M140 S0"} <= set(bench.executed()[after:])
    os.kill(bench.printer, MENDED)
    tours = bench.finish()
    assert bench.touched() == 1 + sum(len(tour) for tour in tours)
    assert not bench.hot_touches()


@pytest.mark.slow
@pytest.mark.parametrize(
    "after",
    [
        pytest.param(7, id="a tour on the tape, not on the wire"),
        pytest.param(8, id="a tour's heights on the tape"),
        pytest.param(12, id="hot again, not yet judged"),
    ],
)
def test_killed_beside_a_touch_it_goes_on(
    forks: Forks, prepared: Path, tmp_path: Path, after: int
) -> None:
    """The tape at the kill: job, park, cold (two events each), then a tour, a tour, hot."""
    bench = Bench(forks, prepared, tmp_path / "run")
    child = bench.start(go_on=False, die_after=after)
    assert forks.wait(child) == KILLED
    lines = (bench.folder / "run" / TAPE).read_text().splitlines()
    assert len(lines) == after
    kinds = [e.get("kind") for e in read_events(bench.folder / "run") if e["event"] == "send"]
    assert kinds == ["job", "park", "cool", "touch", "touch", "heat"][: (after + 1) // 2]
    touched = bench.touched()
    tours = bench.finish()
    # nothing that the tape has was touched again
    assert bench.touched() == sum(len(tour) for tour in tours)
    assert touched == sum(len(tour) for tour in tours[: (after - 6) // 2])
