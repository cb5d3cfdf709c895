"""Incidence: how squarely each place was looked at, from the sensors or from the surface alone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Points, Values
from amrepair.frames import spread_directions, unit_vectors
from amrepair.observe.rays import MIN_COSINE
from amrepair.observe.views import Shares

# One view sees what faces it; this share of its places may seem not to, at edges and by noise.
TURNED_AWAY = 0.03
DIRECTIONS, FEW_PLACES = 1000, 1200  # 6° apart; so many places tell the way that they face


def incidence(normal: Points, to_sensor: Points | None, shares: Shares | None = None) -> Values:
    """(n,) cosine of the angle of incidence, at least that of a grazing ray; 1 where nobody knows.

    Parameters
    ----------
    to_sensor
        Ways to what saw each place; None: they are told by what each view faces.
    shares
        What each view saw of the places; None takes all for one view.
    """
    if to_sensor is None:
        to_sensor = _ways_of_views(normal, shares)
    if to_sensor is None:
        return np.ones(len(normal))
    return np.maximum((unit_vectors(to_sensor) * normal).sum(axis=1), MIN_COSINE)


def _ways_of_views(normal: Points, shares: Shares | None) -> Points | None:
    """(n, 3) the mean way that the views of each place face; None where one faces no single way."""
    if shares is None:
        way = _way_of_one_view(normal)
        return None if way is None else np.tile(way, (len(normal), 1))
    toward = np.zeros((len(normal), 3))
    for view in np.flatnonzero(np.bincount(shares.view)):
        own = shares.view == view
        way = _way_of_one_view(normal[shares.place[own]])
        if way is None:
            return None
        toward += np.bincount(shares.place[own], shares.count[own], len(normal))[:, None] * way
    return toward


def _way_of_one_view(normal: Points) -> Float[np.ndarray, " 3"] | None:
    """(3,) the way that all but a few places face; None where they were seen from more sides."""
    ways = spread_directions(DIRECTIONS)
    facing = ways @ normal[:: len(normal) // FEW_PLACES + 1].T
    least = np.quantile(facing, TURNED_AWAY, axis=1, overwrite_input=True)
    best = int(np.argmax(least))
    return ways[best] if least[best] > 0.0 else None
