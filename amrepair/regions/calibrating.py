"""A calibration from the tested scales of sound scans."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from amrepair.errors import InputError
from amrepair.regions.calibration import Calibration
from amrepair.regions.significance import Level


def calibrated(name: str, scans: Sequence[tuple[Level, ...]]) -> Calibration:
    """What the tested scales of scans of sound parts tell of their errors.

    Raises
    ------
    InputError
        If there is none.
    """
    if not scans:
        raise InputError("a calibration needs a scan of a sound part at least; name one")
    widths: dict[float, list[Float[np.ndarray, " c"]]] = {}
    for levels in scans:
        for level in levels[1:]:
            width_mm = round(3.0 * level.scale.cell_mm, 1)
            widths.setdefault(width_mm, []).append(level.errors.wander_mm)
    wander = []
    for found in (widths[width] for width in sorted(widths)):
        classes = max(len(table) for table in found)
        whole = [np.append(t, np.full(classes - len(t), t[-1])) for t in found]
        mean = np.sqrt(np.square(whole).mean(axis=0))
        wander.append(tuple(float(v) for v in np.maximum.accumulate(mean)))
    tails = []
    for statistic in (0, 1):
        for side in (0, 1):
            some = [levels[0:1] if statistic == 0 else levels[1:] for levels in scans]
            every = [level for levels in some for level in levels]
            peaks = np.concatenate([level.peaks[side] for level in every])
            windows = sum(len(level.scale) for level in every)
            start = every[0].tails[side].start
            mean_z = float(peaks.mean() - start) if len(peaks) else 0.0
            tails.append((start, mean_z, len(peaks) / windows, float(len(peaks))))
    return Calibration(name, len(scans), tuple(sorted(widths)), tuple(wander), tuple(tails))
