"""A part that nobody has placed is printed in the middle of the bed, foot down, and it is said."""

from __future__ import annotations

import json
import re
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from gcode.cli.app import app
from gcode.profiles import load_setup
from gcode.reader import job_for
from gcode.slicing.placing import in_the_middle

SETUP = load_setup()


@pytest.fixture
def anywhere(tmp_path: Path) -> Path:
    """A wedge about the origin, as most files on the web are: half of it below the bed."""
    wedge = m3.Manifold.cube((12.0, 8.0, 2.0), True) + m3.Manifold.cube((4.0, 4.0, 4.0))
    mesh = wedge.translate((-50.0, 3.0, -7.0)).to_mesh64()
    path = tmp_path / "part.stl"
    vertices = np.array(mesh.vert_properties)[:, :3]
    trimesh.Trimesh(vertices, np.array(mesh.tri_verts).astype(int), process=False).export(path)
    return path


def test_the_middle_of_the_box_is_the_middle_of_the_bed() -> None:
    solid = m3.Manifold.cube((3.0, 5.0, 7.0)).translate((-40.0, 900.0, -2.0))
    placed, by_mm = in_the_middle(solid, SETUP.printer)
    x0, y0, z0, x1, y1, z1 = placed.bounding_box()
    assert ((x0 + x1) / 2, (y0 + y1) / 2) == pytest.approx((125.0, 105.0))
    assert (z0, z1) == pytest.approx((0.0, 7.0))
    assert by_mm == pytest.approx((125.0 + 38.5, 105.0 - 902.5, 2.0))


def test_any_part_is_sliced_and_its_place_is_told(anywhere: Path, tmp_path: Path) -> None:
    job = tmp_path / "job.gcode"
    done = CliRunner().invoke(app, ["slice", str(anywhere), "-o", str(job)])
    assert done.exit_code == 0, done.output
    words = re.search(r"X (\S+) to (\S+), Y (\S+) to (\S+) mm", done.stdout)
    assert words is not None
    x0, x1, y0, y1 = (float(word) for word in words.groups())
    assert ((x0 + x1) / 2, (y0 + y1) / 2) == pytest.approx((125.0, 105.0), abs=0.01)
    beads = job_for(job.read_text(), SETUP.printer).beads
    part = beads.layer == beads.layer.max()  # no skirt up there
    middle = 0.5 * (beads.start_mm[part].min(axis=0) + beads.start_mm[part].max(axis=0))
    assert abs(middle[0] - 125.0) < 12.0
    assert abs(middle[1] - 105.0) < 12.0


def test_kept_it_is_refused_where_it_does_not_stand_on_the_bed(
    anywhere: Path, tmp_path: Path
) -> None:
    job = tmp_path / "job.gcode"
    done = CliRunner().invoke(app, ["slice", str(anywhere), "-o", str(job), "--place", "keep"])
    assert done.exit_code != 0
    assert "move, turn or scale" in str(done.exception)
    assert not job.exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--place", "corner"], "it is centre or keep"),
        (["--place", "centre", "--as-built", "x.stl"], "would move the piece away"),
    ],
)
def test_places_that_are_none(anywhere: Path, tmp_path: Path, words: list[str], said: str) -> None:
    job = tmp_path / "job.gcode"
    done = CliRunner().invoke(app, ["slice", str(anywhere), "-o", str(job), *words])
    assert said in str(done.exception)


def test_where_it_was_placed_is_in_the_json(anywhere: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(
        app, ["slice", str(anywhere), "-o", str(tmp_path / "job.gcode"), "--json"]
    )
    told = json.loads(done.stdout)
    assert told["placed"] == "centre"
    assert told["moved_mm"][2] == pytest.approx(8.0)
