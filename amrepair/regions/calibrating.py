"""A calibration from the tested scales of sound scans, or of the bed in many looks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.errors import InputError
from amrepair.regions.calibration import HALF_OCTAVE, Calibration, FarOffTold
from amrepair.regions.options import RegionOptions
from amrepair.regions.significance import LEAST_PEAKS, Level

# Of no such place at all.
NONE_FAR_OFF: FarOffTold = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class SoundScale:
    """What one tested scale of sound places shows of a scan's errors.

    Attributes
    ----------
    width_mm, windows
        Of its windows, and how many there are.
    facing
        Cosine of incidence of all but a few windows, at least.
    wander_mm, freedom
        (c,) standard deviation of window means, by how well they were seen, and its degrees of
        freedom.
    window_mm, common_mm, error_mm
        What windows err by themselves, what their cells have in common, and the standard error of
        what is tested: medians.
    far_mm
        For missing and excess: how far beyond what is allowed places lie that stand out.
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
"""Of one scan: three cells together, then windows by rising width."""


def sound_scales(levels: Sequence[Level], options: RegionOptions) -> Sound:
    """What the tested scales of sound places show of a scan's errors."""
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
    """What scans of sound places tell of a scanner's errors.

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
    """The scales of windows by width, rising, each with those of half an octave to either side."""
    every = [scale for scales in scans for scale in scales[1:]]
    octave = np.log2([scale.width_mm for scale in every])
    found = {}
    for key in np.unique(np.round(octave / HALF_OCTAVE)) * HALF_OCTAVE:
        alike = [every[k] for k in np.flatnonzero(np.abs(octave - key) <= HALF_OCTAVE)]
        found[round(float(2.0**key), 2)] = alike
    return found


def _wander(alike: Sequence[SoundScale]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """By class: root of the mean square of what windows wander by, and all degrees of freedom."""
    # of windows too wide for what was seen none are far enough apart to tell
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
    """What lies far off to one side, of three cells together and then by rising width.

    Before any is seen its spread is taken to be `usual` standard errors, which is worth a few
    places. Windows up to twice as wide as the narrowest that have none take after those: what lies
    far off there may reach into them, so that one place at least is taken to.
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
