"""The loop killed while it prints, scans and repairs: nothing twice, nothing left out."""

from __future__ import annotations

import random
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_forks import Forks, until
from loop_bench import LAYER, PLACE_MM, SIZE_MM, scan_of, solid_mesh
from loop_children import PRINTER, beads_of

from amrepair.frames import Transform
from amrepair.loop import plan_stops
from amrepair.loop.replay import replay
from amrepair.loop.run_folder import JOB, Setting, keep, open_run
from amrepair.loop.tape import read_events
from amrepair.scans import write_ply
from amrepair.simulate.columns import IntervalMap
from amrepair.simulate.world import World
from amrepair.template import MeshSdf
from gcode.check import check
from gcode.firmware import EmulatedPrinterProcess
from gcode.firmware.motion import MotionBatch
from gcode.profiles import load_printer, load_setup
from gcode.reader import job_for, read_job
from gcode.slicing.job import plan_part
from gcode.units import filament_area_mm2
from gcode.writer import write

SLOW = "always slow_reader s=0.001"
KILLED = -9


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small job, its template, and scans of the part with a pocket, and without."""
    return make_ready(tmp_path_factory.mktemp("prepared"), [LAYER])


def make_ready(here: Path, layers: list[int]) -> Path:
    """The same, looked at after some layers and at the end."""
    setup = load_setup(PRINTER, "pla", "repair_0.20")
    part = m3.Manifold.cube(SIZE_MM)
    program = write(plan_part(part.translate(PLACE_MM), setup).toolpath, setup, title="small")
    check(program, setup)
    job = read_job(program, dialect=program.dialect)
    placed = Transform.from_rotation_translation(
        "build", "template", rotation=np.eye(3), translation_mm=np.array(PLACE_MM)
    )
    setting = Setting.of(
        setup, (PRINTER, "pla", "repair_0.20"), stops=plan_stops(job, layers),
        build_from_template=placed, build_from_scanner=Transform.identity("build", "scanner"),
        by_beads=False, seed=0,
    )  # fmt: skip
    keep(here / "run", setting, program.text, MeshSdf.from_mesh(solid_mesh(part)))
    tops = [(f"layer-{layer:03d}", job.layers[layer].z_mm) for layer in layers]
    for label, top_mm in (*tops, ("final", SIZE_MM[2])):
        stands = part.trim_by_plane((0.0, 0.0, -1.0), -top_mm).translate(PLACE_MM)
        pocket = m3.Manifold.cube((5.0, 5.0, 2.0)).translate((105.0, 93.0, top_mm - 0.6))
        for name, solid in (("whole", stands), ("broken", stands - pocket)):
            write_ply(scan_of(solid), here / f"{name}-{label}.ply")
    return here


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    with Forks("loop_children") as forks:
        yield forks


class Bench:
    """A printer and one loop after another."""

    def __init__(
        self, forks: Forks, prepared: Path, folder: Path, *, faults: str = "", rough: bool = False
    ) -> None:
        shutil.copytree(prepared, folder)
        self.forks, self.folder, self.rough = forks, folder, rough
        self.port, self.record = folder / "port", folder / "executed"
        self.printer = forks.printer(self.port, self.record, faults=f"{SLOW}\n{faults}")

    def start(self, *, go_on: bool, die_after: int = 0) -> int:
        return self.forks.start(
            "loop", folder=str(self.folder), port=str(self.port), go_on=go_on, die_after=die_after,
            rough=self.rough,
        )  # fmt: skip

    def executed(self) -> list[str]:
        return beads_of(self.record.read_text().splitlines()) if self.record.exists() else []

    def events(self) -> list[dict[str, object]]:
        return read_events(self.folder / "run")

    def told(self) -> str:
        return (self.folder / "told").read_text()

    def kill_in(self, child: int, kind: str, beads: int) -> None:
        """Kill once so many beads of what was sent as `kind` are executed."""

        def under_way() -> bool:
            assert not (self.folder / "told").exists(), self.told()
            events = self.events()
            return bool(events) and events[-1].get("kind") == kind

        until(under_way)
        done = len(self.executed())
        until(lambda: len(self.executed()) >= done + beads or not under_way())
        assert self.forks.kill(child) == KILLED

    def planned(self) -> list[str]:
        """Every bead that the record says was sent, once each, in order."""
        run = self.folder / "run"
        job = (run / JOB).read_text().split("\n")
        lines: list[str] = []
        look = 0
        for event in self.events():
            if event["event"] == "look":
                look = int(str(event["look"]))
            elif event["event"] == "send" and event["kind"] == "job":
                lines += job[int(str(event["first"])) : int(str(event["end"]))]
            elif event["event"] == "send" and event["kind"] == "repair":
                lines += (run / f"repair-{look}.gcode").read_text().split("\n")
        return beads_of(lines)

    def finish(self, *, going_on: bool = True) -> None:
        child = self.start(go_on=going_on)
        assert self.forks.wait(child) == 0, self.told()
        assert self.events()[-1]["event"] == "end"
        assert self.executed() == self.planned()
        assert f"within: {not self.rough}" in self.told()  # a rough run has passed a stop by

    def built(self) -> IntervalMap:
        """What stands on the bed: the commands that were executed, laid into a world."""
        setup = load_setup(PRINTER, "pla", "repair_0.20")
        beads = job_for(self.record.read_text(), setup.printer).beads
        away = beads.end_mm[-1:] + np.array([0.0, 0.0, 20.0])
        filament = np.linalg.norm(beads.end_mm - beads.start_mm, axis=1) * beads.section_mm2
        n = len(filament) + 1
        world = World(setup.printer.bed_size_mm)
        world.deposit(
            MotionBatch(
                np.concatenate([beads.start_mm, away]),
                np.concatenate([beads.end_mm, away]),
                np.append(filament / filament_area_mm2(1.75), 0.0),
                np.full(n, 50.0),
                np.arange(n) * 1.0,
            )
        )
        return world.snapshot()


def test_killed_thrice_it_prints_everything_once(
    forks: Forks, prepared: Path, tmp_path: Path
) -> None:
    bench = Bench(forks, prepared, tmp_path / "run")
    bench.kill_in(bench.start(go_on=False), "job", 40)
    after_look = 5  # job's end, park twice, look, and the repair's beginning
    child = bench.start(go_on=True, die_after=after_look)
    assert forks.wait(child) == KILLED
    assert [e["event"] for e in bench.events()][-2:] == ["look", "send"]
    kept = bench.events()
    bench.kill_in(bench.start(go_on=True), "repair", 5)
    assert bench.events()[: len(kept)] == kept
    bench.finish()
    sent = [e for e in bench.events() if e["event"] == "send"]
    assert [e["kind"] for e in sent].count("repair") == 2
    # what the killed and resumed run decided is what its scans say
    assert not any(look.differences for look in replay(bench.folder / "run"))


FAULTS = """
every 97 corrupt_in
every 131 lose_ok
every 173 garble_ok
every 211 drop_in
every 307 noise_out
every 401 resend_without_ok
line 150 silence s=0.4
line 400 busy s=5
"""


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_faults_on_both_sides_and_two_kills_end_with_the_same_part(
    forks: Forks, tmp_path: Path
) -> None:
    """On the wire a fault every twenty lines; a scanner with gaps, strays and a silent stop."""
    ready = make_ready(tmp_path / "ready", [2, LAYER])
    calm = Bench(forks, ready, tmp_path / "calm")
    calm.finish(going_on=False)
    rough = Bench(forks, ready, tmp_path / "rough", faults=FAULTS, rough=True)
    rough.kill_in(rough.start(go_on=False), "job", 40)
    rough.kill_in(rough.start(go_on=True), "repair", 5)
    rough.finish()
    assert "passed by: 1" in rough.told()
    one, other = calm.built(), rough.built()
    apart_mm3 = one.minus(other).volume_mm3 + other.minus(one).volume_mm3
    print(f"volume {one.volume_mm3:.2f} and {other.volume_mm3:.2f} mm³, apart {apart_mm3:.3f} mm³")
    assert apart_mm3 < 0.01 * one.volume_mm3
    log = [e for e in rough.events() if e["event"] == "sent"]
    assert sum(e["report"]["resends"] for e in log) > 10  # type: ignore[index]


def test_a_printer_that_was_reset_is_not_gone_on_with(
    forks: Forks, prepared: Path, tmp_path: Path
) -> None:
    bench = Bench(forks, prepared, tmp_path / "run")
    bench.kill_in(bench.start(go_on=False), "job", 30)
    forks.kill(bench.printer)
    again = bench.folder / "again"
    forks.printer(again, bench.record, faults=SLOW)
    again.replace(bench.port)
    done = len(bench.executed())
    assert forks.wait(bench.start(go_on=True)) == 4
    assert "was reset" in bench.told()
    assert "are executed, none after" in bench.told()
    assert len(bench.executed()) == done


def test_a_changed_profile_or_job_is_not_gone_on_with(prepared: Path, tmp_path: Path) -> None:
    shutil.copytree(prepared / "run", tmp_path / "run")
    path = tmp_path / "run" / "run.json"
    path.write_text(
        path.read_text().replace('"printers/prusa_mk3s": "', '"printers/prusa_mk3s": "0')
    )
    with pytest.raises(Exception, match="has changed since"):
        open_run(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_forty_kills_at_any_moment(forks: Forks, prepared: Path, tmp_path: Path) -> None:
    rng = random.Random(3)
    kills = 0
    for round_ in range(8):
        bench = Bench(forks, prepared, tmp_path / f"run-{round_}")
        begun = False
        for _ in range(5):
            by_itself = rng.random() < 0.5
            child = bench.start(go_on=begun, die_after=rng.randrange(1, 9) if by_itself else 0)
            if not by_itself:
                done, more = len(bench.executed()), rng.randrange(1, 120)
                over = bench.folder / "told"
                over.unlink(missing_ok=True)
                until(lambda: len(bench.executed()) >= done + more or over.exists())  # noqa: B023
                status = forks.kill(child)
            else:
                status = forks.wait(child)
            kills += status == KILLED
            if status == 0:
                break
            begun = begun or bool(bench.executed())
            assert status == KILLED or "start script" in bench.told(), bench.told()
            if status != KILLED or not begun:  # killed before anything was printed
                break
        if begun and bench.events()[-1]["event"] != "end":
            bench.finish()
        elif begun:
            assert bench.executed() == bench.planned()
        forks.kill(bench.printer)
    assert kills >= 10


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_the_command_goes_on_after_a_kill(prepared: Path, tmp_path: Path) -> None:
    """`amrepair loop` killed while it waits for a scan; `--resume` takes one and ends the job."""
    job, drop, out = tmp_path / "job.gcode", tmp_path / "scans", tmp_path / "run"
    shutil.copy(prepared / "run" / JOB, job)
    drop.mkdir()
    part = solid_mesh(m3.Manifold.cube(SIZE_MM))
    part.export(tmp_path / "part.stl")
    whole = (prepared / f"whole-layer-{LAYER:03d}.ply").read_bytes()
    final = (prepared / "whole-final.ply").read_bytes()
    program = [
        sys.executable,
        "-W",
        "ignore",
        "-c",
        "from amrepair.cli import main; main()",
        "loop",
    ]
    with (
        (tmp_path / "told").open("w") as told,
        EmulatedPrinterProcess("prusa", printer=load_printer(PRINTER)) as machine,
    ):
        words = [str(job), "--template", str(tmp_path / "part.stl"), "--port", machine.port]
        words += ["--scanner", f"watch:{drop}", "--approve", "auto", "--out", str(out)]
        words += ["--at-layer", str(LAYER)]
        first = subprocess.Popen([*program, *words], stdout=told, stderr=told)
        parked = 4  # events: the job's beginning and end, the park's
        while len(read_events(out)) < parked and first.poll() is None:
            time.sleep(0.1)  # it fits a template first
        assert first.poll() is None, (tmp_path / "told").read_text()
        first.kill()
        first.wait()
        again = subprocess.Popen(
            [*program, "--resume", str(out), "--json"], stdout=told, stderr=told
        )
        # the sensor looks whenever it likes; its files name the layer
        for n in range(3000):
            done = [e for e in read_events(out) if e["event"] == "look"]
            if again.poll() is not None:
                break
            name = f"layer-{LAYER:03d}-{n}.ply" if not done else f"end-{n}.ply"
            aside = tmp_path / "aside.ply"
            aside.write_bytes((whole if not done else final) + bytes(n % 250 + 1))
            aside.rename(drop / name)
            time.sleep(0.5)
        assert again.wait() == 0, (tmp_path / "told").read_text()
    kinds = [e["kind"] for e in read_events(out) if e["event"] == "send"]
    assert kinds == ["job", "park", "back", "back", "job", "park", "back", "back", "job"]
    assert (out / "report.html").is_file()
