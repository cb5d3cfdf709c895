"""Other readers of G-code on real slicers' files: the same filament, the same place on the bed."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from peer_harness import HERE, peer

from gcode.reader import Job, read_job

pytestmark = pytest.mark.peers

FOLDER = os.environ.get("AMREPAIR_DATA")
FILES = sorted((Path(FOLDER) / "gcode").glob("*.gcode")) if FOLDER else []
ARCS = re.compile(r"^G[23] ", re.MULTILINE)


def ours(path: Path) -> tuple[Job, list[float]]:
    """The file, read, and x_min, y_min, x_max, y_max of its beads."""
    job = read_job(path.read_text(errors="replace"))
    points = np.concatenate([job.beads.start_mm, job.beads.end_mm])[:, :2]
    return job, [*points.min(axis=0).tolist(), *points.max(axis=0).tolist()]


@pytest.mark.skipif(not FILES, reason="AMREPAIR_DATA is not set")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_printruns_gcoder_agrees(path: Path) -> None:
    done = subprocess.run(
        [peer("printrun"), HERE / "printrun_totals.py", path],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    theirs = json.loads(done.stdout)
    job, box_mm = ours(path)
    assert job.filament_mm == pytest.approx(theirs["filament_mm"], rel=1e-3)
    # gcoder takes an arc for its end points
    slack_mm = 0.2 if ARCS.search(job.program.text) else 2e-3
    assert box_mm == pytest.approx(theirs["box_mm"], abs=slack_mm)


@pytest.mark.skipif(not FILES, reason="AMREPAIR_DATA is not set")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_octoprints_analysis_agrees(path: Path) -> None:
    done = subprocess.run(
        [peer("octoprint"), "-m", "octoprint", "analysis", "gcode", path],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    lengths = re.search(r"extrusion_length:\n((?:- [\d.]+\n)+)", done.stdout)
    area = re.search(r"printing_area:\n((?: +\w+: [-\d.]+\n)+)", done.stdout)
    assert lengths is not None
    assert area is not None
    edges = dict(re.findall(r"(\w+): ([-\d.]+)", area[1]))
    job, box_mm = ours(path)
    by_tool_mm = [float(word) for word in re.findall(r"[\d.]+", lengths[1])]
    assert job.filament_mm == pytest.approx(sum(by_tool_mm), rel=1e-3)
    theirs = [float(edges[k]) for k in ("minX", "minY", "maxX", "maxY")]
    assert box_mm == pytest.approx(theirs, abs=2e-3)
