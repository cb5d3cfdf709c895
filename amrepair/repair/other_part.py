"""Another part: a thing that lies within its template, and whose walls stand elsewhere.

Wide tops make a smaller plate fit, and all that it lacks would be printed. What a print loses tells
the two apart. It may stop at any height, and its layers may lie too low: then its walls are the
part's as far as they go. Or a piece breaks off: on any line across the part the break is met once,
and the part's own surface once more at the line's other end, so a break never leaves more new wall
than walls of the part. What nobody saw may be the part's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amrepair.arrays import Mask, Points
from amrepair.errors import AlignmentError
from amrepair.regions import AnomalyMap, Label
from amrepair.template.port import Template


@dataclass(frozen=True, slots=True)
class OtherPartOptions:
    """What is a wall, and when it is none of the part's.

    Attributes
    ----------
    upright
        Of a wall's unit normal, at most so much points up or down: it is steeper than 60°.
    on_mm
        A wall of the part lies this near to its template, as a real print does nearly everywhere.
    laid_off_mm
        No bead is laid so far off: two usual lines side by side, as where both outer walls lack.
    most_ratio
        Of the walls that stand or may stand, new ones: a break leaves a half at most.
    least_mm2
        Less new wall than of a small screw's hole speaks for nothing.
    """

    upright: float = 0.5
    on_mm: float = 0.3
    laid_off_mm: float = 0.9
    most_ratio: float = 0.5
    least_mm2: float = 30.0


DEFAULT_OTHER_PART = OtherPartOptions()
"""What `refuse_other_part` goes by."""


@dataclass(frozen=True, slots=True)
class WallsSeen:
    """The walls that a scan shows, mm² each.

    Attributes
    ----------
    new_mm2
        That stand where the template has its inside, farther from its faces than beads are laid.
    own_mm2
        On the template's own walls.
    unseen_mm2
        WallsSeen of the template that nobody saw, standing or gone.
    """

    new_mm2: float
    own_mm2: float
    unseen_mm2: float

    def are_of_another(self, options: OtherPartOptions) -> bool:
        """Whether no stop and no break of the part leaves these."""
        may_stand_mm2 = self.new_mm2 + self.own_mm2 + self.unseen_mm2
        return self.new_mm2 > max(options.least_mm2, options.most_ratio * may_stand_mm2)


def walls_of(
    anomaly: AnomalyMap, template: Template, options: OtherPartOptions = DEFAULT_OTHER_PART
) -> WallsSeen:
    """The walls that a scan shows of a part whose template's Z is up."""
    assert anomaly.evidence is not None
    surfels = anomaly.evidence.surfels
    off_mm = surfels.deviation_mm
    within = np.flatnonzero(off_mm < -options.on_mm)
    normal = surfels.planes(within)
    wall = _is_wall(normal, options)
    within, normal = within[wall], normal[wall]
    aside_mm = options.laid_off_mm * normal
    deep = np.ones(len(within), dtype=bool)
    for way in (aside_mm, -aside_mm):
        deep &= template.distance(surfels.place_mm[within] + way) < 0.0
    on = np.flatnonzero(np.abs(off_mm) <= options.on_mm)
    outward = template.distance_and_gradient(surfels.place_mm[on])[1]
    own = _cell_mm2(outward, surfels.cell_mm)[_is_wall(outward, options)]
    unseen = np.flatnonzero(anomaly.template_label == Label.UNSEEN)
    facing = template.distance_and_gradient(anomaly.template_points_mm[unseen])[1]
    share = float(_is_wall(facing, options).sum()) / max(len(anomaly.template_label), 1)
    return WallsSeen(
        float(_cell_mm2(normal[deep], surfels.cell_mm).sum()),
        float(own.sum()),
        share * float(template.solid().surface_area()),
    )


def refuse_other_part(
    anomaly: AnomalyMap,
    template: Template,
    source: str,
    options: OtherPartOptions = DEFAULT_OTHER_PART,
) -> None:
    """Refuse a scan whose walls are none of its template's.

    Raises
    ------
    AlignmentError
        With how much wall stands where.
    """
    if not (anomaly.template_label == Label.MISSING).any():
        return
    walls = walls_of(anomaly, template, options)
    if not walls.are_of_another(options):
        return
    raise AlignmentError(
        f"the scan {source} does not fit its template: it shows {walls.new_mm2:.0f} mm² of walls "
        f"where the part is solid, and at most {walls.own_mm2 + walls.unseen_mm2:.0f} mm² can be "
        "walls of the part; no stop and no break of a print leaves that, so it is another part, or "
        "one of another size; if it is this part for certain, say so (align, detect and repair "
        "take --part-is-known)"
    )


def _is_wall(normal: Points, options: OtherPartOptions) -> Mask:
    return np.asarray(np.abs(normal[:, 2]) < options.upright)


def _cell_mm2(normal: Points, cell_mm: float) -> np.ndarray:
    """Area of surface in each cell: a plane meets (|x| + |y| + |z|) / cell² cells a mm²."""
    return np.asarray(cell_mm**2 / np.maximum(np.abs(normal).sum(axis=1), 1.0))
