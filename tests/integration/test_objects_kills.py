"""One failed object of three, given up by a loop that is killed around it: the same is laid."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_forks import Forks
from loop_bench import LAYER, PLACE_MM, solid_mesh
from loop_children import PRINTER
from objects_job import Block, labelled, plate, with_bed

from amrepair.frames import Transform
from amrepair.loop import plan_stops
from amrepair.loop.run_folder import Setting, keep
from amrepair.scans import write_ply
from amrepair.template import MeshSdf
from gcode.profiles import load_setup
from gcode.reader import read_job
from tests.integration.test_loop_kills import KILLED, Bench

pytestmark = pytest.mark.slow

BLOCKS = [Block(14.0 * k, 0.0, (8.0, 8.0, 1.2)) for k in range(3)]
STUMP = Block(14.0, 0.0, (8.0, 8.0, 0.3))


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run's folder, and what a scanner sees at its two stops: one object is a stump."""
    here = tmp_path_factory.mktemp("three")
    setup = load_setup(PRINTER, "pla", "repair_0.20")
    program = labelled(BLOCKS, setup)
    job = read_job(program, dialect=program.dialect)
    placed = Transform.from_rotation_translation(
        "build", "template", rotation=np.eye(3), translation_mm=np.array(PLACE_MM)
    )
    setting = Setting.of(
        setup, (PRINTER, "pla", "repair_0.20"), stops=plan_stops(job, [LAYER]),
        build_from_template=placed, build_from_scanner=Transform.identity("build", "scanner"),
        by_beads=False, seed=0,
    )  # fmt: skip
    keep(here / "run", setting, program.text, MeshSdf.from_mesh(solid_mesh(plate(BLOCKS))))
    for label, top_mm in ((f"layer-{LAYER:03d}", job.layers[LAYER].z_mm), ("final", 1.2)):
        stands = plate([BLOCKS[0], STUMP, BLOCKS[2]])
        stands = stands.trim_by_plane((0.0, 0.0, -1.0), -top_mm).translate(PLACE_MM)
        write_ply(with_bed(stands), here / f"broken-{label}.ply")
    return here


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    with Forks("loop_children") as forks:
        yield forks


@pytest.fixture(scope="module")
def calm(forks: Forks, prepared: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What is executed where nobody kills."""
    bench = Bench(forks, prepared, tmp_path_factory.mktemp("calm") / "run")
    ended(bench, go_on=False)
    assert bench.executed()
    return bench.executed()


def ended(bench: Bench, *, go_on: bool) -> None:
    assert bench.forks.wait(bench.start(go_on=go_on)) == 0, bench.told()
    assert bench.events()[-1] == {**bench.events()[-1], "event": "end", "stopped": ""}
    assert rows(bench)[:2] == ["S3", "S2a"]
    kinds = [event["kind"] for event in bench.events() if event["event"] == "send"]
    assert kinds.count("rest") == 2, "up to the last look, and to the end"


def rows(bench: Bench) -> list[str]:
    return [str(e["decision"]["row"]) for e in bench.events() if e["event"] == "look"]  # type: ignore[index]


def test_killed_in_what_is_left_it_lays_the_same(
    forks: Forks, prepared: Path, calm: list[str], tmp_path: Path
) -> None:
    bench = Bench(forks, prepared, tmp_path / "run")
    bench.kill_in(bench.start(go_on=False), "rest", 20)
    ended(bench, go_on=True)
    assert bench.executed() == calm


@pytest.mark.parametrize(
    "last", ["the look that gives it up", "the rest begun", "the look after it", "the rest done"]
)
def test_killed_around_giving_up_it_lays_the_same(
    last: str, forks: Forks, prepared: Path, calm: list[str], tmp_path: Path
) -> None:
    """Tape: job, park (two events each), two looks, a third, what is left (two), and so on."""
    after = {
        "the look that gives it up": 6, "the look after it": 7, "the rest begun": 8,
        "the rest done": 9,
    }[last]  # fmt: skip
    bench = Bench(forks, prepared, tmp_path / "run")
    assert forks.wait(bench.start(go_on=False, die_after=after)) == KILLED
    assert rows(bench)[:2] == ["S3", "S2a"]
    events = [str(event["event"]) for event in bench.events()]
    assert events[5:after] == ["look", "look", "send", "sent"][: after - 5]
    ended(bench, go_on=True)
    assert bench.executed() == calm
