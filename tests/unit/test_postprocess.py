"""Looks marked in jobs: nothing else changes, the nozzle is off the walls, and no spiral is cut."""

from __future__ import annotations

import math
import os
import re
import shutil
import stat
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from amrepair.cli.app import app
from amrepair.errors import InputError
from amrepair.postprocess import LooksAsked, mark, target_of
from amrepair.postprocess.covering import covered_mm2
from amrepair.postprocess.mark import decoded
from gcode.check import Policy, find_refusals
from gcode.cli import console
from gcode.cli.app import app as gcode_app
from gcode.moves import Program
from gcode.profiles import load_setup
from gcode.protocol import command_in
from gcode.reader import read_job
from gcode.slicing.job import slice_part
from gcode.writer import write
from tests.commands import here

SIDE_MM, HIGH_MM, LAYER_MM = 24.0, 4.0, 0.2
SETUP = load_setup("ender_3", "pla", "standard_0.20")  # sparse infill under five solid layers
BOX = m3.Manifold.cube((SIDE_MM, SIDE_MM, HIGH_MM)).translate((90.0, 90.0, 0.0))
WIDTH_MM = SETUP.process.line_width_mm
_XY = re.compile(r"^G[01] .*?X([\d.]+) Y([\d.]+)")


@cache
def job() -> str:
    """A box that our slicer cut."""
    return write(slice_part(BOX, SETUP), SETUP, title="box").text


def spiral(turns: int = 12) -> str:
    """A vase: two layers of floor, then one wall that climbs, as slicers write it."""
    lines = ["G28", "M109 S210", "G90", "M83"]
    z_mm = 0.0
    for layer in range(2):
        z_mm += LAYER_MM
        lines += [";LAYER_CHANGE", f";Z:{z_mm:.3f}", ";HEIGHT:0.2", "G1 E-1 F2400"]
        lines += [f"G1 X100 Y{100 + layer} Z{z_mm:.3f} F6000", "G1 E1 F2400", ";TYPE:Solid infill"]
        lines += [f"G1 X{120 - 20 * (k % 2)} Y{101 + k} E.7 F1200" for k in range(20)]
    lines += ["G1 E-1 F2400", "G1 X120 Y110 F6000", "G1 E1 F2400", ";TYPE:External perimeter"]
    for turn in range(turns):
        lines += [";LAYER_CHANGE", f";Z:{z_mm + LAYER_MM:.3f}", ";HEIGHT:0.2"]
        for k in range(36):
            z_mm += LAYER_MM / 36
            angle = 2 * math.pi * (k + 36 * turn) / 36
            x_mm, y_mm = 110 + 10 * math.cos(angle), 110 + 10 * math.sin(angle)
            lines.append(f"G1 X{x_mm:.3f} Y{y_mm:.3f} Z{z_mm:.4f} E.06")
    return "\n".join([*lines, "G1 E-1 F2400", f"G1 Z{z_mm + 5:.3f}", "M104 S0", "M140 S0", ""])


def without_looks(text: str, words: tuple[str, ...]) -> str:
    """The job again, by taking out what is known to have been put in."""
    return "\n".join(
        line
        for line in text.split("\n")
        if not line.startswith(";AMREPAIR_LOOK") and line.rstrip("\r") not in words
    )


def where(text: str) -> list[tuple[float, float, bool]]:
    """X, Y at each look, and whether filament is pulled back: read by the test's own parser."""
    found, at, pulled = [], (0.0, 0.0), 0.0
    for line in text.split("\n"):
        if line.startswith(";AMREPAIR_LOOK"):
            found.append((*at, pulled < -0.1))
        if (match := _XY.match(line)) is not None:
            at = (float(match.group(1)), float(match.group(2)))
        if (push := re.match(r"^G1 .*?E(-?[\d.]+)", line)) is not None:
            pulled = min(pulled + float(push.group(1)), 0.0)
    return found


def test_all_but_the_looks_stays_as_it_was() -> None:
    marked = mark(job(), "job.gcode", "marlin", LooksAsked(every=4))
    assert [place.layer for place in marked.places] == [3, 7, 11, 15, 19]
    assert without_looks(marked.text, ("M400", "M0")) == without_looks(job(), ("M400", "M0"))
    looks = re.findall(r"^;AMREPAIR_LOOK LAYER=(\d+) Z=(\S+)$", marked.text, re.MULTILINE)
    assert [(int(k), float(z)) for k, z in looks] == [
        (k, pytest.approx(LAYER_MM * (k + 1))) for k in (3, 7, 11, 15, 19)
    ]


def test_line_ends_and_odd_bytes_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # regression: a large job was marked for ten seconds without a word
    told: list[str] = []
    monkeypatch.setattr(console.Bars, "__call__", lambda _, stage, *__: told.append(stage))
    odd = job().replace("\n", "\r\n").encode() + b"; \xff\xfe no UTF-8\r\n"
    file = tmp_path / "job.gcode"
    file.write_bytes(odd)
    file.chmod(0o640)
    done = CliRunner().invoke(app, ["postprocess", "--for", "prusa", "--every", "5", str(file)])
    assert told == ["mark", "mark", "write", "write"]
    assert done.exit_code == 0, done.output
    data = file.read_bytes()
    assert data.count(b"M601\r\n") == 4
    kept = [line for line in data.split(b"\n") if not line.startswith((b";AMREPAIR_LOOK", b"M601"))]
    assert b"\n".join(kept) == odd
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    assert [path.name for path in tmp_path.iterdir()] == ["job.gcode"], "nothing is left beside it"


def test_looks_are_off_the_outer_walls_with_the_plastic_pulled_back() -> None:
    marked = mark(job(), "job.gcode", "klipper", LooksAsked(every=2, final=False))
    assert marked.on_walls == 0
    for x_mm, y_mm, pulled in where(marked.text):
        # the middle of the outer bead lies half a bead within the box
        inside = min(x_mm - 90.0, 90.0 + SIDE_MM - x_mm, y_mm - 90.0, 90.0 + SIDE_MM - y_mm)
        assert abs(inside - 0.5 * WIDTH_MM) >= WIDTH_MM - 0.01
        assert pulled


def test_nothing_is_marked_in_a_spiral() -> None:
    marked = mark(spiral(), "vase.gcode", "marlin", LooksAsked(every=1, final=False))
    assert [place.layer for place in marked.places] == [0]
    assert marked.spiral == 12
    whole = mark(spiral(), "vase.gcode", "marlin", LooksAsked(every=1))
    assert [place.layer for place in whole.places] == [0], "the spiral's own end is none, either"


def test_adaptive_looks_come_before_what_closes_the_infill() -> None:
    marked = mark(job(), "job.gcode", "klipper", LooksAsked(adaptive=True, final=False))
    layers = round(HIGH_MM / LAYER_MM)
    first_top = layers - SETUP.process.top_layers
    assert first_top - 1 in {place.layer for place in marked.places}
    bottom = SETUP.process.bottom_layers
    steady = set(range(bottom + 1, first_top - 1))  # infill on infill closes little
    assert not steady & {place.layer for place in marked.places}


def test_a_height_is_looked_at_when_it_is_reached() -> None:
    marked = mark(job(), "job.gcode", "reprap", LooksAsked(at_z_mm=(1.05,), final=False))
    assert [place.z_mm for place in marked.places] == [pytest.approx(1.2)]
    with pytest.raises(InputError, match="no layer at z = 9 mm"):
        mark(job(), "job.gcode", "reprap", LooksAsked(at_z_mm=(9.0,)))


def test_a_job_is_marked_once() -> None:
    once = mark(job(), "job.gcode", "marlin", LooksAsked(every=4)).text
    again = mark(once, "job.gcode", "marlin", LooksAsked(every=3))
    assert again.text == once
    assert again.marked_before


@pytest.mark.parametrize(
    ("target", "printer"),
    [("marlin", "ender_3"), ("prusa", "prusa_mk3s"), ("klipper", "voron_2_4"),
     ("reprap", "generic_reprap"), ("octoprint", "ender_3")],
)  # fmt: skip
def test_the_checker_passes_what_was_marked(target: str, printer: str) -> None:
    setup = load_setup(printer, "pla", "standard_0.20")
    small = m3.Manifold.cube((8.0, 8.0, 0.8)).translate((90.0, 90.0, 0.0))
    job = write(slice_part(small, setup), setup, title="box").text
    marked = mark(job, "job.gcode", target, LooksAsked(every=2))  # type: ignore[arg-type]
    assert len(marked.places) >= 2
    program = Program(marked.text, setup.printer.dialect)
    assert find_refusals(program, setup, policy=Policy.DANGER) == ()


def test_what_is_for_a_host_is_not_sent() -> None:
    lines = ("G28", "@amrepair scan layer=3 z=0.800", "M400 ; @here")
    assert [command_in(line) for line in lines] == ["G28", "", "M400"]


@pytest.mark.parametrize(
    ("environment", "target"),
    [
        ({"SLIC3R_GCODE_FLAVOR": "klipper"}, "klipper"),
        ({"SLIC3R_GCODE_FLAVOR": "marlin2"}, "marlin"),
        ({"SLIC3R_GCODE_FLAVOR": "reprapfirmware"}, "reprap"),
        ({"SLIC3R_GCODE_FLAVOR": "marlin", "SLIC3R_PP_HOST": "OctoPrint"}, "octoprint"),
    ],
)
def test_the_slicers_environment_says_who_reads(environment: dict[str, str], target: str) -> None:
    assert target_of(job(), "job.gcode", environment) == target


def test_a_prusas_own_pause_is_chosen_by_the_jobs_settings() -> None:
    keys = {"printer_model": "MK4", "gcode_flavor": "marlin2", "layer_height": "0.2"}
    block = "".join(f"; {key} = {value}\n" for key, value in keys.items())
    text = f"{job()}\n; prusaslicer_config = begin\n{block}; prusaslicer_config = end\n"
    assert target_of(text, "job.gcode", {"SLIC3R_GCODE_FLAVOR": "marlin2"}) == "prusa"


def test_a_mark_of_byte_order_hides_no_settings(tmp_path: Path) -> None:
    """regression: Windows' editors put one before Cura's first setting."""
    head = "\ufeff;FLAVOR:Marlin\n;Layer height: 0.2\n"
    assert target_of(f"{head}G28\n", "job.gcode", {}) == "marlin"
    file = tmp_path / "job.gcode"
    file.write_text(head + job(), encoding="utf-8")
    run = CliRunner().invoke(app, ["postprocess", "--every", "0", "--no-final", str(file)])
    assert "0 looks for marlin" in run.stderr
    assert file.read_text(encoding="utf-8") == head + job()


def test_nobody_tells_who_reads() -> None:
    with pytest.raises(InputError, match="say it by --for"):
        target_of(job(), "job.gcode", {})


@pytest.mark.parametrize(
    ("data", "said"),
    [(b"GCDE\1\0\0\0", "binary G-code"), (b"G28\n\0", "no text")],
)
def test_what_is_no_text_is_refused(data: bytes, said: str) -> None:
    with pytest.raises(InputError, match=said):
        decoded(data, "job.bgcode")


def test_a_failure_leaves_the_job_and_ends_with_one_line(tmp_path: Path) -> None:
    """The slicer shows what stands on standard error, and fails where the exit code is not 0."""
    file = tmp_path / "job.gcode"
    file.write_text("G28\nG1 X5\n")
    done = here("postprocess", "--for", "marlin", file)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert "extrudes nothing" in done.stderr
    assert file.read_text() == "G28\nG1 X5\n"


def test_a_command_of_ones_own() -> None:
    marked = mark(job(), "job.gcode", "marlin", LooksAsked(every=10, command="M117 z {z}\\nM600"))
    assert "\nM117 z 2.000\nM600\n" in marked.text
    with pytest.raises(InputError, match="may name"):
        mark(job(), "job.gcode", "marlin", LooksAsked(every=10, command="M117 {height}"))


PRUSA_SLICER = shutil.which("prusa-slicer")


@pytest.mark.slow
@pytest.mark.skipif(PRUSA_SLICER is None, reason="PrusaSlicer is not installed here")
def test_prusaslicer_runs_it_and_shows_its_error(tmp_path: Path) -> None:
    part, job, script = tmp_path / "part.stl", tmp_path / "job.gcode", tmp_path / "looks"
    trimesh.creation.box((8.0, 8.0, 4.0)).export(part)
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m amrepair postprocess "$@"\n')
    script.chmod(0o755)
    here = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}

    def slice_with(options: str) -> subprocess.CompletedProcess[str]:
        words = [str(PRUSA_SLICER), "--export-gcode", str(part), "--output", str(job)]
        words += ["--gcode-flavor", "marlin2", "--use-relative-e-distances"]
        words += ["--layer-gcode", "G92 E0", "--post-process", f"{script} {options}"]
        return subprocess.run(
            words, capture_output=True, text=True, check=False, timeout=240, env=here
        )

    done = slice_with("--every 4")
    text = job.read_text()
    looks = re.findall(r"^;AMREPAIR_LOOK LAYER=(\d+) Z=(\S+)\nM400\nM0$", text, re.MULTILINE)
    assert len(looks) == 4, done.stdout + done.stderr
    heights_mm = [float(z) for _, z in looks]  # layers of 0.3 mm; one later is allowed
    assert np.diff(heights_mm)[:2] == pytest.approx([1.2, 1.2], abs=0.31)
    assert "; prusaslicer_config = end" in text, "its own settings are all there"
    checked = CliRunner().invoke(gcode_app, ["check", str(job)])
    assert checked.exit_code == 0, checked.output
    job.unlink()
    failed = slice_with("--at-z 99")
    assert "no layer at z = 99 mm" in failed.stdout + failed.stderr


def test_a_job_that_leads_far_away_takes_no_gigabytes() -> None:
    """Regression: 600 bytes of a damaged job made a grid of 55 million cells: 1.3 GB and 12 s."""
    far = "G21\nG90\nM83\nG1 Z0.2 F600\nG1 X50 Y50 F3000\nG1 X60 Y84294967295 E1\nG1 X50 Y50 E1\n"
    began_s = time.process_time()
    areas = covered_mm2(read_job(Program(far, "marlin"), dialect="marlin"))
    assert areas.shape == (1,)
    assert time.process_time() - began_s < 2.0  # 0.1 s here
