"""The false-alarm rate that detection states: counted on clean scans, at rates that can be seen."""

from __future__ import annotations

import numpy as np
import pytest

from amrepair.detect import detect
from amrepair.scans import Scan
from tests.analytic import box, cylinder, difference, sample_surface

SIGMA_MM = 0.05


def alarms(false_alarms: float, scans: int, threshold_mm: float | None) -> float:
    """Regions that a clean scan has on average."""
    part = difference(box((0, 0, 0), (24, 16, 6)), cylinder((12, 8, -1), 4.0, 8.0))
    points = sample_surface(part.body, 0.3, seed=1)[0]
    found = 0
    for seed in range(scans):
        noise = np.random.default_rng(seed).normal(0, SIGMA_MM, points.shape)
        scan = Scan(points + noise, SIGMA_MM, "template")
        limits = {"threshold_mm": threshold_mm, "false_alarms": false_alarms}
        found += len(detect(scan, part, **limits).regions)  # type: ignore[arg-type]
    return found / scans


# Nothing systematic is left to the process here: noise alone, so that alarms can be counted.
@pytest.mark.parametrize("stated", [3.0, 30.0])
def test_noise_raises_no_more_alarms_than_stated(stated: float) -> None:
    assert alarms(stated, 4, 1e-6) <= stated


def test_the_rate_is_what_sets_the_limit() -> None:
    assert alarms(1e-3, 2, 1e-6) == 0.0
    assert alarms(300.0, 2, 1e-6) > 0.0  # so noise can raise alarms, and the limit holds them back
    assert alarms(300.0, 1, None) == 0.0  # the process's allowance is far above this noise
