"""`amrepair repair --job JOB` of a part that still stands among what its job laid beside it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest

from gcode.cli.options import grid_of
from gcode.profiles import load_setup
from gcode.reader import job_for
from gcode.slicing.job import plan_part
from gcode.writer import write
from tests import analytic
from tests.commands import here

SETUP = load_setup("prusa_mk3s", "pla", "repair_0.20")
BLOCK = m3.Manifold.cube((20.0, 14.0, 5.0)).translate((90.0, 90.0, 0.0))
WALL = m3.Manifold.cube((16.0, 20.0, 4.0)).translate((114.0, 88.0, 0.0))
CORNER = m3.Manifold.cube((5.0, 5.0, 1.2)).translate((90.0, 90.0, 3.8))


def job_text() -> str:
    """The job of the block and of a wall beside it, whose lines are a support's."""
    text = write(plan_part(BLOCK + WALL, SETUP).toolpath, SETUP, title="job").text
    beads = job_for(text, SETUP.printer).beads
    wall = beads.start_mm[:, 0] > 113.0
    role = dict(zip(beads.line[wall], beads.role[wall], strict=True))
    told = [
        f";TYPE:Support material\n{line}\n;TYPE:{beads.roles[role[k]]}" if k in role else line
        for k, line in enumerate(text.split("\n"))
    ]
    return "\n".join(told)


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("broken")
    (folder / "job.gcode").write_text(job_text())
    analytic.to_trimesh(BLOCK).export(folder / "part.stl")
    sensors = np.array([[0.0, 0.0, 300.0], [200.0, 200.0, 300.0], [100.0, 97.0, 300.0]])
    bed = m3.Manifold.cube((54.0, 36.0, 1.0)).translate((83.0, 81.0, -1.0))
    stands = m3.Manifold.batch_boolean([BLOCK - CORNER, WALL, bed], m3.OpType.Add)
    points, _ = analytic.ray_scan(stands, sensors, spacing_mm=0.25, sigma_mm=0.03, seed=1)
    np.savetxt(folder / "scan.xyz", points, fmt="%.4f")
    return folder


def test_what_the_job_laid_beside_is_none_of_the_part(broken: Path, tmp_path: Path) -> None:
    # regression: a clean skirt was 202 mm³ too much, and with supports or a wipe tower beside it a
    # part "did not fit its template", whatever was said
    words = ["repair", broken / "scan.xyz", "--template", broken / "part.stl"]
    words += ["-o", tmp_path / "repair.gcode", "--job", broken / "job.gcode", "--json"]
    unsaid = here(*words)  # found beside them, of which some are too much
    assert json.loads(unsaid.stdout)["excess_mm3_before"] > 100.0
    assert "say --part-pose job" in unsaid.stderr
    done = here(*words, "--part-pose", "job")
    result = json.loads(done.stdout)
    assert result["missing_mm3_before"] == pytest.approx((BLOCK ^ CORNER).volume(), rel=0.1)
    assert result["excess_mm3_before"] < 0.5
    assert result["filament_mm"] > 0.0


def test_a_plate_of_different_parts_is_one_scan(tmp_path: Path) -> None:
    # regression: a folder of templates, as 'amrepair loop' takes it, was "neither a .safetensors
    # file nor a mesh", and one template "did not fit" the job's second thing
    text = write(plan_part(BLOCK + WALL, SETUP).toolpath, SETUP, title="job").text
    (tmp_path / "job.gcode").write_text(text)
    (tmp_path / "parts").mkdir()
    for name, part in (("block", BLOCK), ("wall", WALL)):
        analytic.to_trimesh(part).export(tmp_path / "parts" / f"{name}.stl")
    sensors = np.array([[0.0, 0.0, 300.0], [200.0, 200.0, 300.0], [100.0, 97.0, 300.0]])
    points, _ = analytic.ray_scan(
        BLOCK - CORNER + WALL, sensors, spacing_mm=0.25, sigma_mm=0.03, seed=1
    )
    np.savetxt(tmp_path / "scan.xyz", points, fmt="%.4f")
    words = ["repair", tmp_path / "scan.xyz", "-o", tmp_path / "repair.gcode", "--json"]
    job = ["--job", tmp_path / "job.gcode", "--part-pose", "job"]
    one = here(*words, "--template", tmp_path / "parts" / "block.stl", *job)
    assert "name a folder of templates" in one.stderr
    unsaid = here(*words, "--template", tmp_path / "parts")
    assert "--part-pose job" in unsaid.stderr
    done = here(*words, "--template", tmp_path / "parts", *job)
    assert "prints 1 of wall.stl, 1 of block.stl" in done.stderr
    result = json.loads(done.stdout)
    assert result["missing_mm3_before"] == pytest.approx((BLOCK ^ CORNER).volume(), rel=0.1)
    assert result["filament_mm"] > 0.0


def test_a_grid_ascends_where_objects_are_printed_one_after_another() -> None:
    """regression: 'The tops of layers must ascend from above 0 mm.' of a sequential job."""
    one = job_text()
    begins, ends = one.index(";LAYER_CHANGE"), one.rindex("\nG1 X")
    again = re.sub(r"(?<= X)\d+", lambda x: str(int(x[0]) - 60), one[begins:ends])
    twice = job_for(one[:ends] + "\nG1 Z20 F720\n" + again + one[ends:], SETUP.printer)
    assert len(twice.turns) == 2
    assert grid_of(twice, SETUP) == grid_of(job_for(one, SETUP.printer), SETUP)
