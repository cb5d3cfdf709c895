"""`amrepair repair --job JOB` of a part that still stands among what its job laid beside it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest

from amrepair.frames import Transform
from amrepair.repair import Site, plan_repair
from amrepair.scans import Scan
from amrepair.template import load_or_fit
from gcode.cli.options import grid_of
from gcode.profiles import load_setup
from gcode.reader import job_for
from gcode.slicing.job import plan_part
from gcode.slicing.layers import LayerGrid
from gcode.writer import write
from tests import analytic
from tests.analytic import sample_surface
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
    unsaid = here(*words)  # found beside them, which are other pieces
    assert json.loads(unsaid.stdout)["excess_mm3_before"] < 0.5
    done = here(*words, "--part-pose", "job")
    result = json.loads(done.stdout)
    assert result["missing_mm3_before"] == pytest.approx((BLOCK ^ CORNER).volume(), rel=0.1)
    assert result["excess_mm3_before"] < 0.5
    assert result["filament_mm"] > 0.0


@pytest.mark.parametrize(("away_mm", "high_mm", "reached"), [(15, 40, False), (40, 20, True)])
def test_the_head_keeps_off_what_the_scan_shows_beside_the_part(
    away_mm: int, high_mm: int, reached: bool
) -> None:
    # regression: what stood farther off than the nozzle's cone is wide was not known to stand, and
    # the carriage went 30 mm deep into a tower 15 mm beside the part
    tower = m3.Manifold.cube((6.0, 20.0, high_mm)).translate((110.0 + away_mm, 88.0, 0.0))
    at = Transform.identity("build", "template")
    template = load_or_fit(analytic.to_trimesh(BLOCK))
    site = Site(template, SETUP, LayerGrid.from_setup(SETUP), build_from_template=at)
    points = sample_surface(BLOCK - CORNER + tower, 0.3, seed=1)[0]
    noise = np.random.default_rng(0).normal(scale=0.03, size=points.shape)
    scan = Scan((points + noise)[points[:, 2] > 0.01], 0.03, "build")
    plan = plan_repair(scan, site, title="repair", guess=at.inverse())
    assert plan.deficit.missing_mm3 == pytest.approx((BLOCK ^ CORNER).volume(), rel=0.1)
    assert plan.patch is not None
    assert bool(plan.patch.toolpath.extrusions) == reached
    assert plan.deficit.as_built.top_mm == pytest.approx(high_mm, abs=1.0)


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
