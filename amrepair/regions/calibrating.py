"""A calibration from the tested scales of sound scans."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from amrepair.errors import InputError
from amrepair.regions.calibration import Calibration, TailTold
from amrepair.regions.significance import LEAST_PEAKS, Level

# Peaks that are too few for it tell no tail.
NO_TAIL: TailTold = (0.0, 0.0, 0.0, 0.0)
# Windows are twice as wide from scale to scale: half of that to either side.
HALF_OCTAVE = 0.5


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
            width_mm = round(level.scale.width_mm, 1)
            widths.setdefault(width_mm, []).append(level.errors.wander_mm)
    wander = []
    for found in (widths[width] for width in sorted(widths)):
        classes = max(len(table) for table in found)
        whole = [np.append(t, np.full(classes - len(t), t[-1])) for t in found]
        mean = np.sqrt(np.square(whole).mean(axis=0))
        wander.append(tuple(float(v) for v in np.maximum.accumulate(mean)))
    known_mm = sorted(widths)
    alike = [[levels[0] for levels in scans]]
    for width_mm in known_mm:
        alike.append(
            [
                level
                for levels in scans
                for level in levels[1:]
                if abs(np.log2(level.scale.width_mm / width_mm)) <= HALF_OCTAVE
            ]
        )
    # three cells together are as wide as the narrowest windows
    octave = [0.0, *np.log2(np.array(known_mm) / known_mm[0]).tolist()]
    sides = (_tails(alike, octave, 0), _tails(alike, octave, 1))
    tails = tuple(zip(*sides, strict=True))
    return Calibration(name, len(scans), tuple(known_mm), tuple(wander), tails)


def _tails(alike: Sequence[Sequence[Level]], octave: Sequence[float], side: int) -> list[TailTold]:
    """How peaks to one side fall off, of three cells together and then by rising width.

    Where they are too few to tell, windows up to twice as wide as the narrowest take after those:
    what lies far off there may reach into them, so that one peak at least is taken to.
    """
    found: list[TailTold] = []
    narrowest = (0.0, 0.0)
    for levels, wider in zip(alike, octave, strict=True):
        peaks = np.concatenate([level.peaks[side] for level in levels])
        start = levels[0].tails[side].start
        tells = len(peaks) >= LEAST_PEAKS
        own = float(peaks.mean() - start) if tells else 0.0, float(len(peaks))
        if tells and wider <= HALF_OCTAVE:
            narrowest = own
        scale, told_by = own if tells or wider > 1.0 + HALF_OCTAVE else narrowest
        rate = max(len(peaks), 1) / sum(len(level.scale) for level in levels)
        found.append((start, scale, rate, told_by) if scale else NO_TAIL)
    return found
