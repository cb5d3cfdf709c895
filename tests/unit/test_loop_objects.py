"""One failed object among three: it is given up, and the others are laid as they were."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import manifold3d as m3
import numpy as np
import pytest
from loop_bench import PLACE_MM, Small, Thermal, solid_mesh
from objects_job import Block, labelled, plate, with_bed

from amrepair.frames import Transform
from amrepair.loop import LoopReport, Stop
from amrepair.template import MeshSdf
from gcode.check import check
from gcode.hosts.port import PrintReport
from gcode.profiles import load_setup
from gcode.reader import read_job

BLOCKS = [Block(20.0 * k, 0.0, (12.0, 12.0, 1.6)) for k in range(3)]
STUMP_MM = 0.3
FAILED = 1


@dataclass(frozen=True)
class Plate(Small):
    """Three blocks; what stands of them after the stop's layer."""

    def seen(self, *failed: int) -> m3.Manifold:
        stand = [
            Block(b.x_mm, b.y_mm, (12.0, 12.0, STUMP_MM)) if k in failed else b
            for k, b in enumerate(BLOCKS)
        ]
        return plate(stand).trim_by_plane((0.0, 0.0, -1.0), -self.top_mm).translate(PLACE_MM)


@pytest.fixture(scope="module")
def three() -> Plate:
    setup = load_setup("prusa_mk3s", "pla", "repair_0.20")
    program = labelled(BLOCKS, setup)
    placed = Transform.from_rotation_translation(
        "build", "template", rotation=np.eye(3), translation_mm=np.array(PLACE_MM)
    )
    part = plate(BLOCKS)
    return Plate(
        setup, part, MeshSdf.from_mesh(solid_mesh(part)),
        read_job(program, dialect=program.dialect), check(program, setup), placed,
    )  # fmt: skip


def rows(report: LoopReport) -> list[str]:
    return [look.decision.row for look in report.looks]


def laid_above(three: Plate, lines: list[str]) -> list[tuple[float, ...]]:
    """Beads above the stop, as ends and section."""
    beads = read_job("\n".join(lines) + "\n", dialect=three.job.program.dialect).beads
    above = beads.end_mm[:, 2] > three.top_mm + 0.05
    found = np.column_stack([beads.start_mm, beads.end_mm, beads.section_mm2])[above]
    return [tuple(row) for row in found]


def test_it_is_given_up_after_two_looks_and_the_others_go_on(three: Plate, tmp_path: Path) -> None:
    report, lines = three.run(tmp_path / "run", lambda n: with_bed(three.seen(FAILED)))
    assert rows(report) == ["S3", "S2a", "S12"]
    assert report.given_up == ("1",)
    assert not report.stopped
    assert not report.within_tolerance, "an object is lost"
    wanted = [
        row for row in laid_above(three, three.job.program.text.split("\n"))
        if not BLOCKS[FAILED].holds(np.array(row[3:5]))
    ]  # fmt: skip
    found = laid_above(three, lines)
    assert len(found) == len(wanted)
    assert np.array(found) == pytest.approx(np.array(wanted), abs=2e-3)


@pytest.mark.slow
def test_where_somebody_can_be_asked_no_ends_the_run(three: Plate, tmp_path: Path) -> None:
    asked: list[str] = []
    report, _ = three.run(
        tmp_path / "run", lambda n: with_bed(three.seen(FAILED)),
        ask=lambda decision: bool(asked.append(decision.row)),
    )  # fmt: skip
    assert asked == ["S2a"]
    assert report.stopped.startswith("give the object up")
    assert report.given_up == ()


def test_with_no_object_left_the_run_ends(three: Plate, tmp_path: Path) -> None:
    report, lines = three.run(tmp_path / "run", lambda n: with_bed(three.seen(0, 1, 2)))
    assert report.stopped
    assert not laid_above(three, lines)


class ServersOwn(Thermal):
    """A printer whose server prints the job, and leaves objects out by itself."""

    def __init__(self, path: Path, told: list[str]) -> None:
        super().__init__(path)
        self.told = told

    def leave_out(self, name: str) -> None:
        self.told.append(name)

    def print(self, checked: Any, **named: Any) -> PrintReport:
        self.told.append(checked.program.sha256[:8])
        return super().print(checked, **named)


def test_a_printer_that_can_is_told_and_the_job_stays_its_own(
    three: Plate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr("loop_bench.Thermal", lambda path: ServersOwn(path, told))
    stops = [Stop(layer, three.job.layers[layer].end_line, three.job.layers[layer].z_mm)
             for layer in (4, 5)]  # fmt: skip
    tops = {stop.label: stop.z_mm for stop in stops}

    def seen(request: Any) -> Any:
        solid = plate([BLOCKS[0], Block(20.0, 0.0, (12.0, 12.0, STUMP_MM)), BLOCKS[2]])
        top_mm = tops[request.label]
        return with_bed(solid.trim_by_plane((0.0, 0.0, -1.0), -top_mm).translate(PLACE_MM))

    report, _ = three.run(tmp_path / "run", seen, stops=stops)
    assert told.count("1") == 1, "named once, at its stop"
    assert told.count(three.checked.program.sha256[:8]) == 3, "all of the job is the server's own"
    assert report.given_up == ("1",)
    assert rows(report)[:3] == ["S3", "S2a", "S12"]
    assert set(rows(report)[3:]) == {"S12"}, "later looks do not miss it"
