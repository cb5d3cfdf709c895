"""A run learns what its scanner leaves from its own first clean layers, and says so."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import loop_bench
import numpy as np
import pytest
from loop_bench import Small, scan_of

from amrepair.frames import Transform
from amrepair.loop import LoopReport, Stop, Tape, plan_stops
from amrepair.loop.learning import FIRST_LOOKS, OWN_CALIBRATION, told
from amrepair.loop.replay import replay
from amrepair.loop.run_folder import Setting, keep, open_run
from amrepair.loop.sites import sites
from amrepair.regions.error_calibration import BED_BESIDE, NORMAL_NOISE, Calibration
from amrepair.repair import Site
from amrepair.report.folder import RunFolder
from amrepair.scans import Scan, ScanRequest

LAYERS = (2, 3, 4)
WAVE_MM, HIGH_MM = 8.0, 0.05  # less than is a defect anywhere, more than this process leaves
PROCESS_MM = 0.01


@pytest.fixture(scope="module")
def small() -> Small:
    return Small.made()


@pytest.fixture(autouse=True)
def even_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sound layers of this process are even to a hundredth of a millimetre."""

    def even(*args: Any, **options: Any) -> Callable[[Stop], Site]:
        at = sites(*args, **options)
        return lambda stop: replace(at(stop), process_sigma_mm=PROCESS_MM)

    monkeypatch.setattr(loop_bench, "sites", even)
    monkeypatch.setattr("amrepair.loop.replay.sites", even)


def _scans(small: Small, wave_mm: float) -> Callable[[ScanRequest], Scan]:
    """Sound layers, seen with errors that hang together over half a wave."""

    def scan(request: ScanRequest) -> Scan:
        standing = small.part.trim_by_plane((0.0, 0.0, -1.0), -request.z_mm)
        seen = scan_of(standing.translate((100.0, 90.0, 0.0)), 1 + (request.layer_index or 0))
        assert seen.normals is not None
        common = wave_mm * np.sin(2 * np.pi * seen.points_mm.sum(axis=1) / WAVE_MM)
        points = seen.points_mm + common[:, None] * seen.normals
        return Scan(points, seen.sigma_mm, "scanner", seen.normals)

    return scan


def _run(
    small: Small,
    folder: Path,
    wave_mm: float,
    given: Calibration | None = None,
    scans: Callable[[ScanRequest], Scan] | None = None,
) -> tuple[LoopReport, tuple[Stop, ...], list[str]]:
    stops = plan_stops(small.job, LAYERS, final=False)
    setting = Setting.of(
        small.setup, ("prusa_mk3s", "pla", "repair_0.20"), stops=stops,
        build_from_template=small.placed, by_beads=False, seed=0,
        build_from_scanner=Transform.identity("build", "scanner"),
        sound=() if given is None else astuple(given),
    )  # fmt: skip
    keep(folder, setting, small.job.program.text, small.template)
    said: list[str] = []
    report, _ = small.run(
        folder, scans or _scans(small, wave_mm), stops=stops, tape=Tape(folder), calibration=given,
        look=RunFolder(folder).record, progress=lambda stage, done, total: said.append(stage),
    )  # fmt: skip
    return report, stops, said


def _events(folder: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (folder / "run.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_errors_that_hang_together_are_learned_told_and_used(small: Small, tmp_path: Path) -> None:
    report, _, said = _run(small, tmp_path, HIGH_MM)
    assert [str(look.decision.action) for look in report.looks] == ["go on"] * len(LAYERS)
    learned = report.calibration
    assert learned is not None
    assert (learned.name, learned.scans) == (OWN_CALIBRATION, FIRST_LOOKS)
    assert 0.2 * HIGH_MM < learned.wander_mm[0][0] < 1.5 * HIGH_MM
    by = [look.plan.anomaly.calibration for look in report.looks]
    assert by == [NORMAL_NOISE] * FIRST_LOOKS + [learned] * (len(LAYERS) - FIRST_LOOKS)
    (event,) = [e for e in _events(tmp_path) if e["event"] == "learned"]
    assert event["calibration"]["told"] == told(learned)  # type: ignore[index]
    assert any(told(learned) in stage for stage in said)
    assert "Judged by what 3 sound scans left" in report.looks[-1].plan.anomaly.told()[0]
    assert all(not one.differences for one in replay(tmp_path))


def test_normal_noise_is_told_and_changes_nothing(small: Small, tmp_path: Path) -> None:
    report, _, _ = _run(small, tmp_path, 0.0)
    assert report.calibration is NORMAL_NOISE
    assert {look.plan.anomaly.calibration for look in report.looks} == {NORMAL_NOISE}
    assert "normal noise" in told(NORMAL_NOISE)
    assert sum(e["event"] == "learned" for e in _events(tmp_path)) == 1


@pytest.mark.slow
def test_where_the_bed_tells_long_tails_each_look_is_judged_by_it(
    small: Small, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    sound = _scans(small, 0.0)

    def with_bed(request: ScanRequest) -> Scan:
        """Patches of 1.5 mm of the bed lie up to a millimetre too low."""
        seen = sound(request)
        xy = rng.uniform(-8.0, 24.0, (10_000, 2))
        low = rng.exponential(0.25, (22, 22)) * (rng.random((22, 22)) < 0.1)
        cell = ((xy + 8.0) / 1.5).astype(int)
        z = rng.normal(0.0, 0.02, len(xy)) - low[tuple(cell.T)]
        points = np.column_stack([xy + np.array([100.0, 90.0]), z])
        normals = np.tile([0.0, 0.0, 1.0], (len(xy), 1))
        return Scan(
            np.concatenate([seen.points_mm, points]), seen.sigma_mm, "scanner",
            np.concatenate([np.asarray(seen.normals), normals]),
        )  # fmt: skip

    report, _, said = _run(small, tmp_path, 0.0, scans=with_bed)
    by = [look.plan.anomaly.calibration for look in report.looks]
    assert {one.name for one in by if one is not None} == {BED_BESIDE}
    # each by its own and by those before it
    assert [one.scans for one in by if one is not None] == list(range(1, len(LAYERS) + 1))
    assert report.calibration is None
    assert sum(BED_BESIDE in stage for stage in said) == 1
    assert all(not one.differences for one in replay(tmp_path))


def test_a_calibration_that_somebody_named_goes_before(small: Small, tmp_path: Path) -> None:
    far_off = ((0.2, 0.001, 9.0), (0.2, 0.001, 9.0))
    given = Calibration("bench", 4, (3.0,), ((0.08, 0.1),), ((50.0, 9.0),), (far_off,) * 2)
    report, _, _ = _run(small, tmp_path, HIGH_MM, given)
    assert report.calibration == given
    assert {look.plan.anomaly.calibration for look in report.looks} == {given}
    assert not [e for e in _events(tmp_path) if e["event"] == "learned"]
    assert open_run(tmp_path).setting.scanners_errors == given
    assert all(not one.differences for one in replay(tmp_path))
