"""What residuals of a scanner are like: spread, tail, and how they hang together over distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.observe.robust import MAD_TO_SIGMA

FARTHEST_PAIR_MM = 12.0
CLIP_SIGMAS = 3.0  # pairs are compared within: a few points far off would say all


@dataclass(frozen=True, slots=True)
class NoiseFigures:
    """What residuals are like.

    Attributes
    ----------
    sigma_mm
        1.4826 times the median absolute deviation.
    over_half_ratio
        Share that is off by more than 0.5 mm.
    lag_mm, correlation
        (m,) of pairs so far apart, along rows and columns; residuals clipped at three sigma.
    length_mm
        Where the correlation falls to 1/e.
    """

    sigma_mm: float
    over_half_ratio: float
    lag_mm: Float[np.ndarray, " m"]
    correlation: Float[np.ndarray, " m"]
    length_mm: float

    def correlation_at(self, lag_mm: float) -> float:
        """Correlation of pairs so far apart."""
        return float(np.interp(lag_mm, self.lag_mm, self.correlation))


def noise_figures(residual_mm: Float[np.ndarray, "k ny nx"], pitch_mm: float) -> NoiseFigures:
    """Robust spread, tail, and correlation over distance of rasters of residuals.

    The correlation is 1 − γ(h) / variance with the variogram γ(h) = ½ mean (r(x + h) − r(x))²
    (Matheron 1963).
    """
    found = residual_mm[np.isfinite(residual_mm)].astype(np.float64)
    if not len(found):
        return NoiseFigures(0.0, 0.0, np.zeros(1), np.zeros(1), 0.0)
    middle = float(np.median(found))
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(found - middle)))
    limit = CLIP_SIGMAS * max(sigma, 1e-9)
    clipped = np.clip(residual_mm.astype(np.float64) - middle, -limit, limit)
    variance = float(np.nanvar(clipped))
    lags, correlation = [0.0], [1.0]
    for step in range(1, int(FARTHEST_PAIR_MM / pitch_mm) + 1):
        squares, pairs = 0.0, 0
        for one, other in (
            (clipped[:, step:], clipped[:, :-step]),
            (clipped[:, :, step:], clipped[:, :, :-step]),
        ):
            apart = (one - other) ** 2
            squares, pairs = (
                squares + float(np.nansum(apart)),
                pairs + int(np.isfinite(apart).sum()),
            )
        if pairs and variance > 0.0:
            lags.append(step * pitch_mm)
            correlation.append(1.0 - 0.5 * squares / pairs / variance)
    return NoiseFigures(
        sigma,
        float((np.abs(found) > 0.5).mean()),
        np.array(lags),
        np.array(correlation),
        _falls_to(np.array(lags), np.array(correlation), float(np.exp(-1.0))),
    )


def _falls_to(
    lag_mm: Float[np.ndarray, " m"], correlation: Float[np.ndarray, " m"], level: float
) -> float:
    below = np.flatnonzero(correlation < level)
    if not len(below):
        return float(lag_mm[-1])
    k = int(below[0])
    drop = correlation[k - 1] - correlation[k]
    share = (correlation[k - 1] - level) / drop
    return float(lag_mm[k - 1] + share * (lag_mm[k] - lag_mm[k - 1]))
