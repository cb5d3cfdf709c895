"""A defect that was found late: what stays open under later layers, and the ways to get at it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import manifold3d as m3
import pytest

from amrepair.loop.buried import buried, buried_mm3, ways
from amrepair.loop.looks import Stop
from amrepair.policy import USUAL_POLICY, Action, decide
from amrepair.policy.again import decided_again
from amrepair.policy.table import Situation
from amrepair.report.collect import loop_result
from gcode.estimate import estimate
from gcode.profiles import load_setup
from gcode.reader import job_for
from gcode.resumption import resume_at
from gcode.slicing.job import plan_part
from gcode.slicing.patch import PatchRegion
from gcode.writer import write
from tests.unit.loop_bench import PLACE_MM, Small, scan_of

SETUP = load_setup()
PROGRAM = write(
    plan_part(m3.Manifold.cube((12.0, 12.0, 4.0)).translate((100.0, 90.0, 0.0)), SETUP).toolpath,
    SETUP, title="block",
)  # fmt: skip
JOB = job_for(PROGRAM, SETUP.printer)
LAYER_MM = 0.2


def piece(low_mm: float, high_mm: float, reached: float) -> PatchRegion:
    return PatchRegion(40.0, (103.0, 93.0, low_mm, 108.0, 98.0, high_mm), reached)


def stop_after(layer: int) -> Stop:
    return Stop(layer, JOB.layers[layer].end_line, JOB.layers[layer].z_mm)


def test_what_lies_in_the_layer_just_printed_is_not_late() -> None:
    shallow, deep, whole = piece(2.81, 3.0, 0.5), piece(2.01, 3.0, 0.25), piece(2.01, 3.0, 1.0)
    left = buried((shallow, deep, whole), stop_after(14), LAYER_MM)
    assert left == (deep,)
    assert buried_mm3(left) == pytest.approx(30.0)


@pytest.mark.parametrize("low_mm", [1.9, 2.01, 2.08])
def test_the_part_is_cut_down_to_below_it_and_resume_at_goes_on_from_there(low_mm: float) -> None:
    stop = stop_after(14)
    reprint, leave = ways((piece(low_mm, 3.0, 0.25),), JOB, stop, SETUP)
    layer = JOB.layers[reprint.layer or 0]
    assert layer.z_mm - layer.height_mm <= low_mm + 0.5 * layer.height_mm
    assert reprint.cut_to_mm == pytest.approx(layer.z_mm - layer.height_mm)
    going_on = resume_at(PROGRAM, SETUP, layer=reprint.layer)
    assert going_on.standing.top_mm == pytest.approx(reprint.cut_to_mm, abs=1e-3)
    assert (reprint.filled_mm3, reprint.left_mm3) == (pytest.approx(30.0), 0.0)
    assert (leave.filled_mm3, leave.left_mm3) == (0.0, pytest.approx(30.0))
    # layers printed again, of a solid block
    again_mm = JOB.layers[14].z_mm - (reprint.cut_to_mm or 0.0)
    assert reprint.filament_mm3 == pytest.approx(12.0 * 12.0 * again_mm, rel=0.06)
    share = again_mm / JOB.layers[-1].z_mm
    assert reprint.print_time_s == pytest.approx(
        share * estimate(PROGRAM, SETUP.printer).print_time_s, rel=0.15
    )
    assert f"--layer {reprint.layer}" in reprint.told


def test_below_the_first_layer_nothing_is_cut() -> None:
    (only,) = ways((piece(0.0, 1.0, 0.5),), JOB, stop_after(14), SETUP)
    assert only.name == "leave"


def test_little_is_spanned_and_much_is_offered_whatever_else_is_decided() -> None:
    least = USUAL_POLICY.buried_mm3
    assert decide((), Situation(Action.GO_ON, buried_mm3=0.9 * least)).action is Action.GO_ON
    much = Situation(Action.FILL_NOW, last_pass=True, buried_mm3=1.1 * least)
    offered = decide((), much)
    assert (offered.action, offered.row) == (Action.OFFER, "S6, S12a")
    # a repair that can still be printed comes first
    assert decide((), replace(much, last_pass=False)).action is Action.FILL_NOW
    gone_on = decide((), Situation(Action.GO_ON, buried_mm3=1.1 * least))
    assert decided_again(gone_on.to_json()).action is Action.OFFER
    other = replace(USUAL_POLICY, buried_mm3=2.0 * least)
    assert decided_again(gone_on.to_json(), other).action is Action.GO_ON


@pytest.fixture(scope="module")
def hollowed() -> tuple[Small, Stop, m3.Manifold]:
    """A job, a stop in it, and what stands there: a hollow under a roof, open to the front."""
    small = Small.made(height_mm=2.8)
    layer = small.job.layers[11]
    hollow = m3.Manifold.cube((5.0, 8.0, 1.2)).translate((5.0, -1.0, 0.8))
    stands = small.part.trim_by_plane((0.0, 0.0, -1.0), -layer.z_mm) - hollow
    return small, Stop(11, layer.end_line, layer.z_mm), stands.translate(PLACE_MM)


def test_nobody_to_ask_the_run_goes_on_and_the_result_has_the_ways(
    hollowed: tuple[Small, Stop, m3.Manifold], tmp_path: Path
) -> None:
    small, stop, stands = hollowed
    report, _ = small.run(tmp_path / "run", lambda request: scan_of(stands), stops=[stop])
    assert not report.stopped
    last = report.looks[-1].decision
    assert last.action is Action.OFFER
    reprint, leave = last.ways
    assert reprint.layer in (3, 4)  # it begins at 0.8 mm: to a layer, as the scan has it
    assert reprint.filled_mm3 == pytest.approx(leave.left_mm3)
    assert USUAL_POLICY.buried_mm3 < leave.left_mm3 < 5.0 * 7.0 * 1.2
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
