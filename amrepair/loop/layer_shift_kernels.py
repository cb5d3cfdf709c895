# mypy: disable-error-code="no-untyped-def"
"""How likely seen heights are, where the upper layers were moved aside: compiled, no policy."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit

SIGMAS_OF_NORMAL = 4.0  # standard deviations, beyond which a normal density is as good as none
ROOT_TWO_PI = float(np.sqrt(2.0 * np.pi))


@njit(cache=True, nogil=True)
def _height(raster, x, y, cell):
    """Of the column over a place, and of the nearest one where the raster ends."""
    i = min(max(int(np.floor(y / cell)), 0), raster.shape[0] - 1)
    j = min(max(int(np.floor(x / cell)), 0), raster.shape[1] - 1)
    return raster[i, j]


@njit(cache=True, nogil=True)
def _add(found, z, x, y, move, upper, lower, cut, cell, shares, sigma, by):
    """Add to (f,) `found` the density of a height, by which share of the upper layers is there."""
    high = _height(upper, x - move[0], y - move[1], cell)
    below = _height(lower, x - move[2], y - move[3], cell)
    by /= sigma * ROOT_TWO_PI
    if high <= max(cut, below):  # nothing of the upper layers: all shares are one
        off = (z - below) / sigma
        if abs(off) < SIGMAS_OF_NORMAL:
            density = by * np.exp(-0.5 * off * off)
            for k in range(len(shares)):
                found[k] += density
        return
    for k in range(len(shares)):
        off = (z - below - shares[k] * (high - below)) / sigma
        if abs(off) < SIGMAS_OF_NORMAL:
            found[k] += by * np.exp(-0.5 * off * off)


@njit(cache=True, nogil=True)
def densities(place, aside, upper, lower, cut, cell, move, shares, sigma):
    """(n, f) of each point's height, by which share of the upper layers' height is there.

    `upper` is what all layers reach, `lower` what the lower ones do; what of `upper` is higher than
    `cut` lies aside by the first two of `move`, what is `lower` by the others. `place` is from the
    rasters' corner; each lies as likely at any of the places `aside` of it.
    """
    found = np.zeros((len(place), len(shares)))
    for i in range(len(place)):
        for a in range(len(aside)):
            x, y = place[i, 0] + aside[a, 0], place[i, 1] + aside[a, 1]
            _add(found[i], place[i, 2], x, y, move, upper, lower, cut, cell, shares, sigma,
                 1.0 / len(aside))  # fmt: skip
    return found


@njit(cache=True, nogil=True)
def evidence(place, aside, upper, lower, cut, cell, moves, shares, weights, sigma, stray, other):
    """(m,) sum of the points' log densities, by move.

    `weights` are those of the shares; with probability `stray` a height is anything, of density
    `other`.
    """
    found = np.zeros(len(moves))
    by_share = np.zeros(len(shares))
    for m in range(len(moves)):
        for i in range(len(place)):
            by_share[:] = 0.0
            for a in range(len(aside)):
                x, y = place[i, 0] + aside[a, 0], place[i, 1] + aside[a, 1]
                _add(by_share, place[i, 2], x, y, moves[m], upper, lower, cut, cell, shares,
                     sigma, 1.0 / len(aside))  # fmt: skip
            total = 0.0
            for k in range(len(shares)):
                total += weights[k] * by_share[k]
            found[m] += np.log((1.0 - stray) * total + stray * other)
    return found
