"""What a run keeps of its looks: all that is told, and next to nothing of a clean one's points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loop_bench import Small, scan_of

from amrepair.loop import memory
from amrepair.report.collect import look_of
from amrepair.scans import Scan


@pytest.fixture(scope="module")
def small() -> Small:
    return Small.made()


def test_a_clean_look_keeps_few_points_and_can_still_be_drawn(
    small: Small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "CLEAN_POINTS", 2_000)
    report, _ = small.run(tmp_path, lambda n: scan_of(small.standing, n))
    (look,) = report.looks
    assert len(look.scan) <= memory.CLEAN_POINTS
    assert look.plan.anomaly.evidence is None
    for array in (look.scan.points_mm, look.plan.anomaly.label):
        assert array.base is None or array.base.nbytes <= 2 * array.nbytes  # no view of all of it
    drawn = look_of(look.plan, "clean", printed=False)
    height = np.asarray(drawn.height_map.z_mm)
    assert np.isclose(height, small.top_mm, atol=0.1).mean() > 0.1  # the part, amid its bed


@pytest.mark.slow
def test_what_was_found_is_kept_as_it_was_decided(small: Small, tmp_path: Path) -> None:
    broken = small.standing - small.block(-0.8, 0.2)
    report, lines = small.run(tmp_path, lambda n: scan_of(broken if n == 1 else small.standing, n))
    first, last = report.looks
    assert first.printed
    assert first.plan.deficit.missing_mm3 > 20.0
    assert first.plan.patch is not None
    assert last.plan.deficit.missing_mm3 < 1.0
    assert len(lines) > 100


def test_the_part_is_kept_and_not_the_bed_beside_it(small: Small, tmp_path: Path) -> None:
    # regression: of a look after a repair one point in fifty was left, most of them of the bed
    broken = small.standing - small.block(-0.8, 0.2)

    def on_its_bed(number: int) -> Scan:
        seen = scan_of(broken if number == 1 else small.standing, number)
        far_mm = np.random.default_rng(number).uniform((20, 20, 0), (70, 70, 0.01), (5000, 3))
        up = np.tile([0.0, 0.0, 1.0], (5000, 1))
        return replace(
            seen,
            points_mm=np.vstack([seen.points_mm, far_mm]),
            normals=np.vstack([np.asarray(seen.normals), up]),
        )

    report, _ = small.run(tmp_path, on_its_bed)
    for look in report.looks:
        assert look.scanned_points == len(on_its_bed(look.number))
        assert len(look.scan) == len(look.plan.scan) == len(look.plan.anomaly.label)
        assert len(look.scan) == look.scanned_points - 5000
        assert look.scan.points_mm[:, 0].min() > 80.0
