"""Making a calibration of errors, from scans of sound parts or from the bed seen in many looks.

A scan of a sound surface is tested as any other; what the test finds there can only be errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.errors import InputError
from amrepair.regions.error_calibration import HALF_OCTAVE, Calibration, FarOffTold
from amrepair.regions.options import RegionOptions
from amrepair.regions.significance import LEAST_PEAKS, Level

# No outlier was seen.
NONE_FAR_OFF: FarOffTold = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class SoundScale:
    """What one tested scale of a sound surface shows of a scan's errors.

    Attributes
    ----------
    width_mm, windows
        The width of its windows, and how many there are.
    facing
        All but a few windows were seen at a cosine of incidence of at least this.
    wander_mm, freedom
        (c,) standard deviation of window means for each class of how well windows were seen, and
        its degrees of freedom.
    window_mm, common_mm, error_mm
        Medians of the independent part of a window's standard error, of the part that its cells
        have in common, and of the standard error of the tested statistic.
    far_mm
        For missing and for excess: how far beyond the tolerance outliers lie.
    """

    width_mm: float
    windows: int
    facing: float
    wander_mm: Float[np.ndarray, " c"]
    freedom: Float[np.ndarray, " c"]
    window_mm: float
    common_mm: float
    error_mm: float
    far_mm: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " q"]]


Sound = tuple[SoundScale, ...]
"""The scales of one scan: three cells together, then windows by rising width."""


def sound_scales(levels: Sequence[Level], options: RegionOptions) -> Sound:
    """Summarise the tested scales of a scan of a sound surface."""
    return tuple(
        SoundScale(
            level.scale.width_mm,
            len(level.scale),
            level.errors.facing,
            level.errors.wander_mm,
            level.errors.freedom,
            float(np.median(level.errors.window_mm)),
            float(np.median(level.errors.common_mm)),
            float(np.median(level.error_mm)),
            level.far_mm(options.tail_from),
        )
        for level in levels
    )


def calibrated(name: str, scans: Sequence[Sound], options: RegionOptions) -> Calibration:
    """Make a calibration of what scans of sound surfaces show.

    Raises
    ------
    InputError
        If there is none.
    """
    if not scans:
        raise InputError("a calibration needs a scan of a sound part at least; name one")
    windows = by_width(scans)
    wander = tuple(_wander(alike) for alike in windows.values())
    # three cells together are as wide as the narrowest windows
    width_mm = [next(iter(windows)), *windows]
    octave = np.log2(np.array(width_mm) / width_mm[0]).tolist()
    together = [[scales[0] for scales in scans], *windows.values()]
    sides = [_far_off(together, octave, side, options.longest_tail) for side in range(2)]
    return Calibration(
        name,
        len(scans),
        tuple(windows),
        tuple(told for told, _ in wander),
        tuple(freedom for _, freedom in wander),
        tuple(zip(*sides, strict=True)),
        min(scale.facing for alike in windows.values() for scale in alike),
    )


def by_width(scans: Sequence[Sound]) -> dict[float, list[SoundScale]]:
    """The scales by rising width of windows; each with those within half an octave of it."""
    every = [scale for scales in scans for scale in scales[1:]]
    octave = np.log2([scale.width_mm for scale in every])
    found = {}
    for key in np.unique(np.round(octave / HALF_OCTAVE)) * HALF_OCTAVE:
        alike = [every[k] for k in np.flatnonzero(np.abs(octave - key) <= HALF_OCTAVE)]
        found[round(float(2.0**key), 2)] = alike
    return found


def _wander(alike: Sequence[SoundScale]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """For each class the root mean square of the scans' wander, and the summed freedom."""
    # where windows are too wide for a small scan, none are far enough apart to tell their wander
    alike = [scale for scale in alike if scale.wander_mm[0] > 0.0] or alike
    classes = max(len(scale.wander_mm) for scale in alike)
    wander, freedom = (
        np.array([np.pad(told, (0, classes - len(told)), "edge") for told in both])
        for both in zip(*((scale.wander_mm, scale.freedom) for scale in alike), strict=True)
    )
    together_mm = np.sqrt(np.square(wander).mean(axis=0))
    return tuple(np.maximum.accumulate(together_mm).tolist()), tuple(freedom.sum(axis=0).tolist())


def _far_off(
    alike: Sequence[Sequence[SoundScale]], octave: Sequence[float], side: int, usual: float
) -> list[FarOffTold]:
    """The outliers to one side, of three cells together and then of windows by rising width.

    Before any outlier is seen the spread is taken to be `usual` standard errors; this prior counts
    as much as a few outliers. Windows without an outlier, up to twice as wide as the narrowest,
    take the spread of the narrowest and one outlier at least, since those may reach into them.
    """
    found: list[FarOffTold] = []
    narrowest: tuple[float, float] | None = None
    for scales, wider in zip(alike, octave, strict=True):
        far_mm = np.concatenate([scale.far_mm[side] for scale in scales])
        told = narrowest if wider <= 1.0 + HALF_OCTAVE else None
        if len(far_mm):
            usual_mm = usual * float(np.median([scale.error_mm for scale in scales]))
            told_by = float(LEAST_PEAKS + len(far_mm))
            square = (float((far_mm**2).sum()) + LEAST_PEAKS * usual_mm**2) / told_by
            told = float(np.sqrt(square)), told_by
            if wider <= HALF_OCTAVE:
                narrowest = told
        rate = max(len(far_mm), 1) / sum(scale.windows for scale in scales)
        found.append(NONE_FAR_OFF if told is None else (told[0], rate, told[1]))
    return found
