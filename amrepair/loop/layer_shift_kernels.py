# mypy: disable-error-code="no-untyped-def"
"""How likely seen heights are, where the upper layers were moved aside: compiled, no policy."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit

SIGMAS_OF_NORMAL = 4.0  # standard deviations, beyond which a normal density is as good as none
ROOT_TWO_PI = float(np.sqrt(2.0 * np.pi))
_PER_SIGMA = 512.0  # entries of the table below: off by a part in 500 of the density at most
_NORMAL = np.exp(
    -0.5 * ((np.arange(SIGMAS_OF_NORMAL * _PER_SIGMA + 1.0) + 0.5) / _PER_SIGMA) ** 2
).astype(np.float32)


@njit(inner=True, cache=True, nogil=True)
def _height(raster, x, y, cell):
    """Of the column over a place, and of the nearest one where the raster ends."""
    i = min(max(int(np.floor(y / cell)), 0), raster.shape[0] - 1)
    j = min(max(int(np.floor(x / cell)), 0), raster.shape[1] - 1)
    return raster[i, j]


@njit(inner=True, cache=True, nogil=True)
def _normal(off, per_mm):
    """Of a height so far off, as a share of the density where it is off by nothing."""
    entry = int(abs(off) * per_mm)
    return _NORMAL[entry] if entry < len(_NORMAL) else 0.0


@njit(cache=True, nogil=True)
def densities(place, aside, upper, lower, cut, cell, move, shares, sigma):
    """(n, f) of each point's height, by which share of the upper layers' height is there.

    `upper` is what all layers reach, `lower` what the lower ones do; what of `upper` is higher than
    `cut` lies aside by the first two of `move`, what is `lower` by the others. `place` is from the
    rasters' corner; each lies as likely at any of the places `aside` of it.
    """
    found = np.zeros((len(place), len(shares)))
    per_mm = _PER_SIGMA / sigma
    for i in range(len(place)):
        z = place[i, 2]
        for a in range(len(aside)):
            x, y = place[i, 0] + aside[a, 0], place[i, 1] + aside[a, 1]
            high = _height(upper, x - move[0], y - move[1], cell)
            below = _height(lower, x - move[2], y - move[3], cell)
            if high <= max(cut, below):  # nothing of the upper layers
                high = below
            for k in range(len(shares)):
                found[i, k] += _normal(z - below - shares[k] * (high - below), per_mm)
    return found / (len(aside) * sigma * ROOT_TWO_PI)


@njit(cache=True, nogil=True)
def evidence(place, aside, upper, lower, cut, cell, moves, shares, weights, sigma, stray, other):
    """(m,) sum of the points' log densities, by move.

    `weights` are those of the shares, and make up one; with probability `stray` a height is
    anything, of density `other`. The same sum as of `densities`, without an array of them: of some
    thousand moves each, this is what a look at shifts takes its time for.
    """
    found = np.zeros(len(moves))
    per_mm = _PER_SIGMA / sigma
    by = (1.0 - stray) / (len(aside) * sigma * ROOT_TWO_PI)
    for i in range(len(place)):
        z = place[i, 2]
        told_high, told_below, told = np.nan, np.nan, 0.0
        for m in range(len(moves)):
            total = 0.0
            for a in range(len(aside)):
                x, y = place[i, 0] + aside[a, 0], place[i, 1] + aside[a, 1]
                high = _height(upper, x - moves[m, 0], y - moves[m, 1], cell)
                below = _height(lower, x - moves[m, 2], y - moves[m, 3], cell)
                if high != told_high or below != told_below:  # most tops are flat
                    told_high, told_below, told = high, below, 0.0
                    if high <= max(cut, below):  # nothing of the upper layers: all shares are one
                        told = _normal(z - below, per_mm)
                    else:
                        for k in range(len(shares)):
                            off = z - below - shares[k] * (high - below)
                            told += weights[k] * _normal(off, per_mm)
                total += told
            found[m] += np.log(by * total + stray * other)
    return found
