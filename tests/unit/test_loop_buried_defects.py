"""A defect that was found late: what stays open under later layers, and the ways to get at it."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from functools import cache
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
from typer.testing import CliRunner

from amrepair.cli.app import app as repair_app
from amrepair.loop.buried_defects import buried, buried_mm3, ways
from amrepair.loop.looks import Stop
from amrepair.policy import DEFAULT_POLICY, Action, decide
from amrepair.policy.replay import decided_again
from amrepair.policy.table import Situation
from amrepair.report.collect import loop_result
from gcode.cli.app import app as gcode_app
from gcode.estimate import estimate
from gcode.moves import Program
from gcode.profiles import load_setup
from gcode.reader import Job, job_for
from gcode.resumption import resume_at
from gcode.slicing.job import plan_part
from gcode.slicing.patch import PatchRegion
from gcode.writer import write
from tests.unit.loop_bench import PLACE_MM, Small, scan_of, solid_mesh

SETUP = load_setup()
LAYER_MM = 0.2


@cache
def block() -> tuple[Program, Job]:
    """A job of a block, as text and as it is read."""
    part = m3.Manifold.cube((12.0, 12.0, 4.0)).translate((100.0, 90.0, 0.0))
    program = write(plan_part(part, SETUP).toolpath, SETUP, title="block")
    return program, job_for(program, SETUP.printer)


def piece(low_mm: float, high_mm: float, reached: float) -> PatchRegion:
    return PatchRegion(40.0, (103.0, 93.0, low_mm, 108.0, 98.0, high_mm), reached)


def stop_after(layer: int) -> Stop:
    return Stop(layer, block()[1].layers[layer].end_line, block()[1].layers[layer].z_mm)


def test_what_lies_in_the_layer_just_printed_is_not_late() -> None:
    shallow, deep, whole = piece(2.81, 3.0, 0.5), piece(2.01, 3.0, 0.25), piece(2.01, 3.0, 1.0)
    left = buried((shallow, deep, whole), stop_after(14), LAYER_MM)
    assert left == (deep,)
    assert buried_mm3(left) == pytest.approx(30.0)


@pytest.mark.parametrize("low_mm", [1.9, 2.01, 2.08])
def test_the_part_is_cut_down_to_below_it_and_resume_at_goes_on_from_there(low_mm: float) -> None:
    stop = stop_after(14)
    reprint, leave = ways((piece(low_mm, 3.0, 0.25),), block()[1], stop, SETUP)
    layer = block()[1].layers[reprint.layer or 0]
    assert layer.z_mm - layer.height_mm <= low_mm + 0.5 * layer.height_mm
    assert reprint.cut_to_mm == pytest.approx(layer.z_mm - layer.height_mm)
    going_on = resume_at(block()[0], SETUP, layer=reprint.layer)
    assert going_on.standing.top_mm == pytest.approx(reprint.cut_to_mm, abs=1e-3)
    assert (reprint.filled_mm3, reprint.left_mm3) == (pytest.approx(30.0), 0.0)
    assert (leave.filled_mm3, leave.left_mm3) == (0.0, pytest.approx(30.0))
    # layers printed again, of a solid block
    again_mm = block()[1].layers[14].z_mm - (reprint.cut_to_mm or 0.0)
    assert reprint.filament_mm3 == pytest.approx(12.0 * 12.0 * again_mm, rel=0.06)
    share = again_mm / block()[1].layers[-1].z_mm
    assert reprint.print_time_s == pytest.approx(
        share * estimate(block()[0], SETUP.printer).print_time_s, rel=0.15
    )
    assert f"--layer {reprint.layer}" in reprint.told


def test_below_the_first_layer_nothing_is_cut() -> None:
    (only,) = ways((piece(0.0, 1.0, 0.5),), block()[1], stop_after(14), SETUP)
    assert only.name == "leave"


def test_little_is_spanned_and_much_is_offered_whatever_else_is_decided() -> None:
    least = DEFAULT_POLICY.buried_mm3
    assert decide((), Situation(Action.GO_ON, buried_mm3=0.9 * least)).action is Action.GO_ON
    much = Situation(Action.FILL_NOW, last_pass=True, buried_mm3=1.1 * least)
    offered = decide((), much)
    assert (offered.action, offered.row) == (Action.OFFER, "S6, S12a")
    # a repair that can still be printed comes first
    assert decide((), replace(much, last_pass=False)).action is Action.FILL_NOW
    gone_on = decide((), Situation(Action.GO_ON, buried_mm3=1.1 * least))
    assert decided_again(gone_on.to_json()).action is Action.OFFER
    other = replace(DEFAULT_POLICY, buried_mm3=2.0 * least)
    assert decided_again(gone_on.to_json(), other).action is Action.GO_ON


@pytest.fixture(scope="module")
def hollowed() -> tuple[Small, Stop, m3.Manifold]:
    """A job, a stop in it, and what stands there: a hollow under a roof, open to the front."""
    small = Small.made(height_mm=2.8)
    layer = small.job.layers[11]
    hollow = m3.Manifold.cube((5.0, 8.0, 1.2)).translate((5.0, -1.0, 0.8))
    stands = small.part.trim_by_plane((0.0, 0.0, -1.0), -layer.z_mm) - hollow
    return small, Stop(11, layer.end_line, layer.z_mm), stands.translate(PLACE_MM)


@pytest.mark.slow
def test_nobody_to_ask_the_run_goes_on_and_the_result_has_the_ways(
    hollowed: tuple[Small, Stop, m3.Manifold], tmp_path: Path
) -> None:
    small, stop, stands = hollowed
    report, _ = small.run(
        tmp_path / "run", lambda request: scan_of(stands, spacing_mm=0.18), stops=[stop]
    )
    assert not report.stopped
    last = report.looks[-1].decision
    assert last.action is Action.OFFER
    assert not report.within_tolerance
    reprint, leave = last.ways
    assert reprint.layer in (3, 4)  # it begins at 0.8 mm: to a layer, as the scan has it
    assert reprint.filled_mm3 == pytest.approx(leave.left_mm3)
    assert leave.left_mm3 == pytest.approx(5.0 * 7.0 * 1.2, rel=0.05)
    result = loop_result(
        report, repaired_ratio=None, gcode=None, seed=0, seconds={}, setup=small.setup
    )
    assert [each["stop"] for each in result["found_late"]] == ["layer-011"]
    assert result["found_late"][0]["ways"][0]["layer"] == reprint.layer


def test_a_no_ends_the_run_with_the_command_to_go_on_from(
    hollowed: tuple[Small, Stop, m3.Manifold], tmp_path: Path
) -> None:
    small, stop, stands = hollowed
    report, lines = small.run(
        tmp_path / "run", lambda request: scan_of(stands), stops=[stop],
        ask=lambda decision: decision.action is not Action.OFFER,
    )  # fmt: skip
    assert "gcode resume-at JOB --layer" in report.stopped
    assert lines[-1] == "heaters off"


def test_layers_that_lie_aside_end_the_run_with_the_layer_to_print_again(
    hollowed: tuple[Small, Stop, m3.Manifold], tmp_path: Path
) -> None:
    small, stop, _ = hollowed
    first, below_mm = 9, small.job.layers[8].z_mm
    done = small.part.trim_by_plane((0.0, 0.0, -1.0), -stop.z_mm)
    low, high = (
        done.trim_by_plane((0.0, 0.0, sign), sign * below_mm).translate(PLACE_MM)
        for sign in (-1.0, 1.0)
    )
    stands = low + high.translate((0.0, 1.5, 0.0))
    report, lines = small.run(tmp_path / "run", lambda request: scan_of(stands), stops=[stop])
    assert f"from layer {first} on it lies aside" in report.stopped
    assert f"cut the part down to {below_mm:.2f} mm" in report.stopped
    assert f"gcode resume-at JOB --layer {first}" in report.stopped
    assert lines[-1] == "heaters off"
    result = loop_result(
        report, repaired_ratio=None, gcode=None, seed=0, seconds={}, setup=small.setup
    )
    (told,) = result["shifted"]
    assert (told["stop"], told["layer"]) == ("layer-011", first)
    (again,) = told["ways"]
    assert again["filament_mm3"] == pytest.approx(high.volume(), rel=0.06)
    assert not result["found_late"]


@pytest.fixture(scope="module")
def job_file(
    hollowed: tuple[Small, Stop, m3.Manifold], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    small, *_ = hollowed
    folder = tmp_path_factory.mktemp("finished")
    (folder / "job.gcode").write_text(small.checked.program.text)
    solid_mesh(small.part).export(folder / "part.stl")
    return folder / "job.gcode"


def hollow_at(small: Small, place_mm: tuple[float, float, float], path: Path) -> Path:
    """A scan of the finished part with a hollow under its roof, somewhere on the bed."""
    hollow = m3.Manifold.cube((5.0, 8.0, 1.2)).translate((5.0, -1.0, 0.8))
    scan = scan_of((small.part - hollow).translate(place_mm))
    np.savetxt(path, np.hstack([scan.points_mm, scan.normals]), fmt="%.4f")
    return path


def words_for(scan: Path, job_file: Path) -> list[str]:
    """`amrepair repair` of it, its foot on the bed."""
    out, part = job_file.with_name("repair.gcode"), job_file.with_name("part.stl")
    return ["repair", f"{scan}", "--template", f"{part}", "-o", f"{out}", "--job", f"{job_file}",
            "--printer", "prusa_mk3s"]  # fmt: skip


def test_a_finished_part_is_offered_the_ways_and_the_command_makes_the_program(
    hollowed: tuple[Small, Stop, m3.Manifold], job_file: Path
) -> None:
    # regression: only the loop offered them; `repair --job` left the hollow and said no more
    small, *_ = hollowed
    words = words_for(hollow_at(small, PLACE_MM, job_file.with_name("scan.xyz")), job_file)
    report = job_file.with_name("report.html")
    done = CliRunner().invoke(repair_app, [*words, "--report", f"{report}", "--json"])
    assert done.exit_code == 3, done.output
    result = json.loads(done.stdout)
    reprint, leave = result["ways"]
    assert result["buried_mm3"] == pytest.approx(leave["left_mm3"], abs=1e-3)
    assert leave["left_mm3"] == pytest.approx(5.0 * 7.0 * 1.2, rel=0.05)
    assert reprint["layer"] in (2, 3, 4)  # it begins at 0.8 mm; never higher, lower as scanned
    assert reprint["filament_mm3"] == pytest.approx(
        16.0 * 12.0 * (2.8 - reprint["cut_to_mm"]), rel=0.06
    )
    assert reprint["print_time_s"] > 0
    assert result["not_again"] is None
    page = report.read_text()
    assert reprint["command"] in page
    assert "Let it be: " in page
    name, *rest = shlex.split(reprint["command"])
    assert name == "gcode"
    made = CliRunner().invoke(gcode_app, rest)
    assert made.exit_code == 0, made.output
    assert f"from layer {reprint['layer']}" in " ".join(made.output.split())
    assert job_file.with_name("rest.gcode").stat().st_size > 1000


@pytest.mark.slow
def test_of_a_finished_part_whose_layers_lie_aside_the_first_is_told(
    hollowed: tuple[Small, Stop, m3.Manifold], job_file: Path
) -> None:
    # regression: its edges were chips and blobs, and the program for them was all that was told
    small, *_ = hollowed
    low, high = (small.part.trim_by_plane((0.0, 0.0, s), s * 1.8) for s in (-1.0, 1.0))
    scan = scan_of((low + high.translate((0.0, 1.2, 0.0))).translate(PLACE_MM))
    path = job_file.with_name("aside.xyz")
    np.savetxt(path, np.hstack([scan.points_mm, scan.normals]), fmt="%.4f")
    done = CliRunner().invoke(repair_app, [*words_for(path, job_file), "--part-pose", "job"])
    assert done.exit_code == 3, done.output
    told = " ".join(done.output.split())
    assert re.search(
        r"job: from layer 9 on it lies aside of what is below, \+1\.[123] mm in Y", told
    )
    assert "--layer 9" in told


@pytest.mark.slow
def test_a_part_that_was_moved_cannot_be_printed_again_from_a_layer_on(
    hollowed: tuple[Small, Stop, m3.Manifold], job_file: Path
) -> None:
    small, *_ = hollowed
    moved = (PLACE_MM[0] + 3.0, *PLACE_MM[1:])
    words = words_for(hollow_at(small, moved, job_file.with_name("moved.xyz")), job_file)
    done = CliRunner().invoke(repair_app, words)
    told = " ".join(done.output.split())
    assert "By its job: let it be" in told
    assert "resume-at" not in told
    assert "the part stands up to 3.0" in told
    assert "put it back there" in told
