"""A calibration from the tested scales of sound scans."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from amrepair.errors import InputError
from amrepair.field.scales import RANK
from amrepair.regions.calibration import Calibration, TailTold
from amrepair.regions.significance import Level

# Peaks that are too few for it tell no tail.
NO_TAIL: TailTold = (0.0, 0.0, 0.0, 0.0)
# Windows are twice as wide from scale to scale: half of that to either side.
ALIKE_OCTAVES = 0.5


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
    tails = [_tails([levels[0] for levels in scans], (NO_TAIL, NO_TAIL))]
    for width_mm in sorted(widths):
        alike = [
            level
            for levels in scans
            for level in levels[1:]
            if abs(np.log2(3.0 * level.scale.cell_mm / width_mm)) <= ALIKE_OCTAVES
        ]
        tails.append(_tails(alike, tails[-1]))
    return Calibration(name, len(scans), tuple(sorted(widths)), tuple(wander), tuple(tails))


def _tails(
    levels: Sequence[Level], narrower: tuple[TailTold, TailTold]
) -> tuple[TailTold, TailTold]:
    """How peaks fall off, too low and too high; too few of them do so as in narrower windows."""
    windows = sum(len(level.scale) for level in levels)
    found = []
    for side in (0, 1):
        peaks = np.concatenate([level.peaks[side] for level in levels])
        start, scale, _, told_by = narrower[side]
        if len(peaks) >= 2 * RANK:
            start = levels[0].tails[side].start
            scale, told_by = float(peaks.mean() - start), float(len(peaks))
        told = len(peaks) > 0 and scale > 0.0
        found.append((start, scale, len(peaks) / windows, told_by) if told else NO_TAIL)
    return found[0], found[1]
