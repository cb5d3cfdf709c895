"""What needs no cable runs on Windows, too: regression: no command did, for want of fcntl."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LIKE_WINDOWS = ROOT / "tests" / "like_windows.py"
KNOB = ROOT / "examples" / "parts" / "knob.stl"


def like_windows(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "ignore", str(LIKE_WINDOWS), *map(str, words)]
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        command, capture_output=True, text=True, timeout=280, check=False, env=environ
    )


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("windows") / "job.gcode"
    done = like_windows("gcode", "slice", KNOB, "--process", "repair_0.30", "-o", path)
    assert done.returncode == 0, done.stderr
    return path


def test_a_job_is_written_to_a_file(job: Path, tmp_path: Path) -> None:
    done = like_windows("gcode", "send", job, "--port", f"file:{tmp_path / 'sent.gcode'}")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "sent.gcode").read_text().rstrip() == job.read_text().rstrip()


def test_a_slicer_may_call_the_postprocessor(job: Path) -> None:
    done = like_windows("amrepair", "postprocess", "--every", "20", job)
    assert done.returncode == 0, done.stderr
    assert "\nM601\n" in job.read_text()  # the printer's own pause


def test_a_cable_is_refused_in_one_sentence(job: Path) -> None:
    done = like_windows("gcode", "send", job, "--port", "COM3")
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1].startswith("gcode: 'COM3' is a printer on a cable")


def test_an_emulated_printer_is_refused_in_one_sentence() -> None:
    done = like_windows("gcode", "emulate")
    assert done.returncode == 2
    assert done.stderr.strip() == (
        "gcode: an emulated printer needs a pseudo-terminal, which Linux and macOS have; on "
        "Windows use WSL"
    )
