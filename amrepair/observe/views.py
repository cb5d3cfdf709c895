"""Views of a scan compared with each other, and those that contradict the others found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amrepair.arrays import Mask, Numbers, Values
from amrepair.observe.basis import DEFAULT_NUISANCE
from amrepair.observe.robust import MAD_TO_SIGMA

LEAST_PLACES = 30  # a view that shares fewer places with others cannot be compared
# Of two views that disagree, each contradicts the other: within this factor they count as equally
# bad, and the template tells which of them is off.
CONTRADICT_ALIKE = 1.1


@dataclass(frozen=True, slots=True)
class Shares:
    """What each view says of each place: (n,) places, views, mean deviations, numbers of points."""

    place: Numbers
    view: Numbers
    value_mm: Values
    count: Numbers

    def gathered(self) -> Shares:
        """The same with a single entry for each place and view, ordered by places."""
        views = int(self.view.max(initial=0)) + 1
        key = self.place * views + self.view
        count = np.bincount(key, self.count)
        keys = np.flatnonzero(count)
        mean_mm = np.bincount(key, self.count * self.value_mm)[keys] / count[keys]
        return Shares(keys // views, keys % views, mean_mm, count[keys].astype(np.int64))

    @property
    def views(self) -> Numbers:
        """(n,) how many views saw the place of each entry."""
        return np.bincount(self.place)[self.place]

    @property
    def apart_mm(self) -> float | None:
        """Robust standard deviation between views of a place; None where none has several views."""
        views = self.views
        several = views > 1
        if not several.any():
            return None
        mean_mm = np.bincount(self.place, self.value_mm) / np.maximum(np.bincount(self.place), 1)
        off_mm, views = (self.value_mm - mean_mm[self.place])[several], views[several]
        return MAD_TO_SIGMA * float(np.median(np.abs(off_mm) * np.sqrt(views / (views - 1.0))))

    def some(self, which: Mask) -> Shares:
        """The chosen entries."""
        return Shares(self.place[which], self.view[which], self.value_mm[which], self.count[which])


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


def contradictions(shares: Shares, *, point_sigma_mm: float) -> tuple[Contradiction, ...]:
    """Views to leave out, the worst first, until the rest agree.

    They contradict each other beyond `told_sigma` times what views differ by, and the noise.

    Parameters
    ----------
    shares
        Without what belongs to the whole part or to a whole view.
    point_sigma_mm
        Standard deviation of one point about its neighbours.
    """
    found: list[Contradiction] = []
    options = DEFAULT_NUISANCE
    told = shares.gathered()
    while True:
        points, place = told.count, told.place
        total = np.bincount(place, points * told.value_mm)[place] - points * told.value_mm
        others = np.bincount(place, points)[place] - points
        shared = others > 0
        apart_mm = told.value_mm[shared] - total[shared] / others[shared]
        noise_mm = point_sigma_mm * np.sqrt(1.0 / points[shared] + 1.0 / others[shared])
        table = []
        for k in np.flatnonzero(np.bincount(told.view)):
            own = told.view[shared] == k
            if own.sum() < LEAST_PLACES:
                continue
            spread_mm = MAD_TO_SIGMA * float(np.median(np.abs(apart_mm[own])))
            usual_mm = np.hypot(options.view_offset_sigma_mm, float(np.median(noise_mm[own])))
            if spread_mm > options.told_sigma * usual_mm:
                off_mm = float(np.median(np.abs(told.value_mm[shared][own])))
                table.append((spread_mm, off_mm, Contradiction(int(k), spread_mm, int(own.sum()))))
        if not table:
            return tuple(found)
        most_mm = max(row[0] for row in table)
        alike = [row for row in table if CONTRADICT_ALIKE * row[0] >= most_mm]
        found.append(max(alike, key=lambda row: row[1])[2])
        told = told.some(told.view != found[-1].view)
