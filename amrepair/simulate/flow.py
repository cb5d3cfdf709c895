"""Flow that varies as an extruder's does: slowly, around what was asked for.

It changes motion before the world sees it; how plastic lies down is the world's business.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate

import numpy as np

from amrepair.simulate.parameters import FlowModel
from gcode.firmware.motion import MotionBatch


def noisy_flow(
    motion: MotionBatch,
    rng: np.random.Generator,
    model: FlowModel,
) -> MotionBatch:
    """The same moves with flow that wanders around its mean (Ornstein-Uhlenbeck along the path).

    Parameters
    ----------
    motion
        Executed moves; retractions and travels are left as they are.
    model
        How much it wanders, and over what length of path.
    """
    if model.sigma_ratio == 0.0 and model.mean_ratio == 1.0:
        return motion
    length_mm = np.linalg.norm(motion.end_mm - motion.start_mm, axis=1)
    laid = np.flatnonzero((motion.filament_mm > 0) & (length_mm > 0))
    if len(laid) == 0:
        return motion
    step_mm = max(float(np.median(length_mm[laid])), 1e-3)
    ends_mm = np.cumsum(length_mm[laid])
    count = int(ends_mm[-1] / step_mm) + 2
    keep = float(np.exp(-step_mm / model.over_mm))
    kicks = rng.normal(size=count) * np.sqrt(1 - keep**2)
    kicks[0] = rng.normal()
    wander = np.array(list(accumulate(kicks.tolist(), lambda last, kick: kick + keep * last)))
    middle = (ends_mm - 0.5 * length_mm[laid]) / step_mm
    factor = model.mean_ratio + model.sigma_ratio * np.interp(middle, np.arange(count), wander)
    filament = motion.filament_mm.copy()
    filament[laid] *= np.maximum(factor, 0.0)
    return replace(motion, filament_mm=filament)
