"""Views that contradict the others: which, and by how much, where several saw the same place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from amrepair.observe.basis import NuisanceOptions
from amrepair.observe.robust import MAD_TO_SIGMA

LEAST_PLACES = 30  # that a view shares with others: fewer tell nothing of it
# Two views contradict each other alike, within so much: the template says which of them is off.
CONTRADICT_ALIKE = 1.1


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A view that was left out.

    Attributes
    ----------
    view
        Its number, from 0.
    apart_mm
        Robust standard deviation of what it says from what the others say of the same places.
    places
        How many places it shares with others.
    """

    view: int
    apart_mm: float
    places: int

    def told(self) -> str:
        """In a sentence; views count from 1."""
        return (
            f"View {self.view + 1} contradicts the others by {self.apart_mm:.2f} mm over "
            f"{self.places} places that they share: the result is without it."
        )

    def to_json(self) -> dict[str, object]:
        """As results have it; views count from 1, as in sentences."""
        return {"view": self.view + 1, "apart_mm": self.apart_mm, "places": self.places}


def contradictions(
    cell: Int[np.ndarray, " k"],
    view: Int[np.ndarray, " k"],
    value_mm: Float[np.ndarray, " k"],
    count: Int[np.ndarray, " k"],
    *,
    point_sigma_mm: float,
    options: NuisanceOptions,
) -> tuple[Contradiction, ...]:
    """Views to leave out, the worst first, until the rest agree.

    Parameters
    ----------
    cell, view, value_mm, count
        (k,) each: which view says what of which place, by how many points, without what belongs
        to the whole part or to a whole view. A view may say several things of a place.
    point_sigma_mm
        Standard deviation of one point about its neighbours.
    options
        Beyond `told_sigma` times what views differ by, and the noise, they contradict each other.
    """
    found: list[Contradiction] = []
    views = int(view.max(initial=0)) + 1
    key = cell * views + view
    summed, points = np.bincount(key, count * value_mm), np.bincount(key, count)
    key = np.flatnonzero(points)
    cell, view = key // views, key % views
    points = points[key]
    value_mm = summed[key] / points
    while True:
        total = np.bincount(cell, points * value_mm)[cell] - points * value_mm
        others = np.bincount(cell, points)[cell] - points
        shared = others > 0
        apart_mm = value_mm[shared] - total[shared] / others[shared]
        noise_mm = point_sigma_mm * np.sqrt(1.0 / points[shared] + 1.0 / others[shared])
        table = []
        for k in np.unique(view):
            own = view[shared] == k
            if own.sum() < LEAST_PLACES:
                continue
            spread_mm = MAD_TO_SIGMA * float(np.median(np.abs(apart_mm[own])))
            usual_mm = np.hypot(options.view_offset_sigma_mm, float(np.median(noise_mm[own])))
            if spread_mm > options.told_sigma * usual_mm:
                off_mm = float(np.median(np.abs(value_mm[shared][own])))
                table.append((spread_mm, off_mm, Contradiction(int(k), spread_mm, int(own.sum()))))
        if not table:
            return tuple(found)
        most_mm = max(row[0] for row in table)
        worst = max(
            (row for row in table if CONTRADICT_ALIKE * row[0] >= most_mm), key=lambda row: row[1]
        )[2]
        found.append(worst)
        stays = view != worst.view
        cell, view, value_mm, points = cell[stays], view[stays], value_mm[stays], points[stays]
