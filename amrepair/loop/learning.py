"""What a run learns of its scanner from its own first clean layers.

Until then, and where errors turn out to be normal, looks are judged by normal noise; where the bed
beside the part says otherwise, every look by its bed and those of the looks before it, and nothing
is learned from layers. A calibration that somebody named goes before all of that.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from amrepair.loop.looks import Stop
from amrepair.policy.table import Action, Decision
from amrepair.regions.detection import judged_scales
from amrepair.regions.error_calibration import BED_BESIDE, NORMAL_NOISE, Calibration
from amrepair.regions.error_calibration_fit import Sound, by_width, calibrated
from amrepair.repair import RepairPlan, Site

FIRST_LOOKS = 3  # clean layers that are learned from
OWN_CALIBRATION = "this run's first layers"


class Learning:
    """The calibration that a run's looks are judged by.

    Parameters
    ----------
    given
        What somebody named: nothing is learned then.
    """

    def __init__(self, given: Calibration | None = None) -> None:
        self.calibration = given
        self._seen: list[Sound] = []
        self._beds: tuple[Sound, ...] = ()
        self._done = given is not None

    def judged_by(self, site: Site) -> Site:
        """What is expected, with what is known of the scanner's errors."""
        site = replace(site, beds=self._beds)
        if self.calibration is None or site.calibration != NORMAL_NOISE:
            return site
        return replace(site, calibration=self.calibration)

    def note(self, stop: Stop, plan: RepairPlan, decision: Decision) -> Calibration | None:
        """Learn from a look, if its layer is clean; what was learned, once that is enough."""
        clean = decision.action is Action.GO_ON and not plan.anomaly.regions
        self._beds = plan.beds
        if by_bed(plan) is not None:  # it tells in every look
            return None
        if self._done or not clean or stop.layer_index is None:
            return None
        self._seen.append(judged_scales(plan.anomaly))
        if len(self._seen) < FIRST_LOOKS:
            return None
        self._done = True
        assert plan.anomaly.options is not None
        learned = (
            NORMAL_NOISE
            if _as_normal(self._seen)
            else calibrated(OWN_CALIBRATION, self._seen, plan.anomaly.options)
        )
        self._seen = []
        self.calibration = learned
        return learned


def by_bed(plan: RepairPlan) -> Calibration | None:
    """What the bed beside the part told, of a look that is judged by it."""
    by = plan.anomaly.calibration
    return by if by is not None and by.name == BED_BESIDE else None


def _as_normal(seen: list[Sound]) -> bool:
    """Whether windows wander by no more than normal noise and the process leave, at any width."""
    return all(
        float(np.median([scale.common_mm for scale in alike])) == 0.0
        for alike in by_width(seen).values()
    )


def told(calibration: Calibration) -> str:
    """What was learned, in a sentence."""
    if calibration == NORMAL_NOISE:
        return f"The first {FIRST_LOOKS} clean layers show normal noise and nothing else."
    if calibration.name != OWN_CALIBRATION:
        return calibration.told()
    widths = ", ".join(
        f"{wander[0]:.3f} mm over {width:g} mm"
        for width, wander in zip(calibration.width_mm, calibration.wander_mm, strict=True)
    )
    return (
        f"Learned from the first {calibration.scans} clean layers: local means of sound surface "
        f"wander by {widths}."
    )


def to_json(calibration: Calibration) -> dict[str, Any]:
    """As a run's record and its result have it."""
    return {**asdict(calibration), "told": told(calibration)}
