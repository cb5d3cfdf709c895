"""What needs no cable runs on Windows, too: regression: no command did, for want of fcntl."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.commands import call

ROOT = Path(__file__).parents[2]
KNOB = ROOT / "examples" / "parts" / "knob.stl"
like_windows = partial(call, windows=True, quiet=True)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("windows") / "job.gcode"
    done = like_windows("slice", KNOB, "--process", "repair_0.30", "-o", path, program="gcode")
    assert done.returncode == 0, done.stderr
    return path


def test_a_job_is_written_to_a_file(job: Path, tmp_path: Path) -> None:
    done = like_windows("send", job, "--port", f"file:{tmp_path / 'sent.gcode'}", program="gcode")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "sent.gcode").read_text().rstrip() == job.read_text().rstrip()


def test_a_slicer_may_call_the_postprocessor(job: Path) -> None:
    done = like_windows("postprocess", "--every", "20", job)
    assert done.returncode == 0, done.stderr
    assert "\nM601\n" in job.read_text()  # the printer's own pause


def test_a_cable_is_refused_in_one_sentence(job: Path) -> None:
    done = like_windows("send", job, "--port", "COM3", program="gcode")
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1].startswith("gcode: 'COM3' is a printer on a cable")


def test_an_emulated_printer_is_refused_in_one_sentence() -> None:
    done = like_windows("emulate", program="gcode")
    assert done.returncode == 2
    assert done.stderr.strip() == (
        "gcode: an emulated printer needs a pseudo-terminal, which Linux and macOS have; on "
        "Windows use WSL"
    )


def test_a_folder_of_scans_is_judged(tmp_path: Path) -> None:
    """Regression: a batch asked for `resource`, which Windows lacks."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=6.0)
    mesh.export(tmp_path / "ball.stl")
    (tmp_path / "scans").mkdir()
    points, _ = trimesh.sample.sample_surface(mesh, 3000, seed=0)
    np.savetxt(tmp_path / "scans" / "one.xyz", points, fmt="%.4f")
    done = like_windows(
        *("batch", "align", tmp_path / "scans", "--template", tmp_path / "ball.stl"),
        *("--out", tmp_path / "out", "--executor", "serial"),
    )
    assert done.returncode == 0, done.stderr
    (result,) = (tmp_path / "out" / "results").rglob("*.json")
    assert "peak_mb" not in json.loads(result.read_text())["cost"]
