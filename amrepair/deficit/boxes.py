"""Where solids are to be made: boxes around what detection labelled, and how deep it lies.

They hold a void's walls and mouth too, which nobody sampled; what is solid there `solids` says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Mask, Numbers, Points, Values
from amrepair.deficit.options import DeficitOptions
from amrepair.field.as_built import Evidence
from amrepair.field.groups import group_points, touching_mm
from amrepair.frames import box_of, boxes_meet, cells_of, diagonal
from amrepair.regions import AnomalyMap, Label
from amrepair.regions.planned_beads import PlannedBeads
from amrepair.template.port import Template


@dataclass(frozen=True, slots=True)
class Sought:
    """What solids of one label are made from, template frame.

    Attributes
    ----------
    gone
        Lines of the job that are not there; None where there are none, and for excess. There rays
        speak: the nearest planes are those of what lies below and beside, and stand as designed.
    """

    template: Template
    evidence: Evidence
    anomaly: AnomalyMap
    label: Label
    gone: PlannedBeads | None
    options: DeficitOptions

    @property
    def tau_mm(self) -> float:
        """What is no farther from the template counts only by its label."""
        return self.anomaly.threshold_mm

    @property
    def is_excess(self) -> bool:
        """Too much, not missing."""
        return self.label is Label.EXCESS

    @property
    def sign(self) -> float:
        """Of the template's distance where there may be any: negative inside."""
        return 1.0 if self.is_excess else -1.0

    @property
    def labelled(self) -> Mask:
        """(s,) surfels that the test found."""
        return np.asarray(np.asarray(self.anomaly.surfel_label) == int(self.label))

    @property
    def surface_mm(self) -> Points:
        """(g, 3) places of the template's surface that the test found."""
        return self.anomaly.template_points_mm[self.anomaly.template_label == int(self.label)]

    def told_mm(self, inside: Mask) -> Float[np.ndarray, "p 3"]:
        """(p, 3) places that are known to be missing: some surfels, surface, lines of the job."""
        told = [self.evidence.surfels.place_mm[inside], self.surface_mm]
        if self.gone is not None:
            told.append(self.gone.samples_mm(self.options.skipped.sample_step_mm))
        return np.concatenate(told)

    def nearest_is_labelled(self, samples_mm: Points) -> Mask:
        """(k,) whether the test found the surfel nearest to each place."""
        nearest = self.evidence.surfels.tree.nearest_one(samples_mm)
        return np.asarray(self.labelled[nearest])

    def allowed_mm(self, samples_mm: Points, asked: Mask) -> Values:
        """(k,) how far out of the template nothing is too much, by the nearest surfel."""
        allowed_mm = np.zeros(len(samples_mm))
        higher_mm = self.anomaly.surfel_higher_mm
        if self.is_excess and higher_mm is not None and (higher_mm > 0).any():
            nearest = self.evidence.surfels.tree.nearest_one(samples_mm[asked])
            allowed_mm[asked] = higher_mm[nearest]
        return allowed_mm


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """(2, 3) its lowest and highest corner, and how thick what lies in it is."""

    corners_mm: Float[np.ndarray, "2 3"]
    depth_mm: float

    @classmethod
    def around(cls, places_mm: Points, margin_mm: float, depth_mm: float) -> Box:
        """With a margin."""
        return cls(box_of(places_mm) + margin_mm * np.array([[-1.0], [1.0]]), depth_mm)

    def joined(self, other: Box) -> Box:
        """One around both, as fine as the finer of them needs."""
        both_mm = np.concatenate([self.corners_mm, other.corners_mm])
        return Box(box_of(both_mm), min(self.depth_mm, other.depth_mm))


def boxes_of(sought: Sought) -> list[Box]:
    """Around each group of labelled cells and template points, and around lines that are gone."""
    s, options = sought.evidence.surfels, sought.options.voxels
    which = np.flatnonzero(sought.labelled)
    if sought.is_excess:
        # where excess surfels stand on the template: along their planes, back by their height
        film, normal = np.zeros(len(which), bool), sought.evidence.normal[which]
        beside = s.place_mm[which] - s.deviation_mm[which, None] * normal
    else:
        film = _films(sought, which)
        beside = np.concatenate([sought.surface_mm, _paths_out(sought, which)])
    points = np.concatenate([s.place_mm[which], beside])
    depth = np.append(np.abs(s.deviation_mm[which]), np.full(len(beside), np.nan))
    film = np.append(film, np.zeros(len(beside), bool))
    group = group_points(points, reach_mm=touching_mm(s.cell_mm))
    found: list[Box] = []
    for g in range(int(group.max(initial=-1)) + 1):
        mine = group == g
        known = depth[mine & ~np.isnan(depth)]
        # cells with a handful of template points and nothing else are pixels, not defects
        if len(known) == 0 and (mine.sum() < 4 or sought.is_excess):
            continue  # nor is where something would stand what stands
        thick = float(np.percentile(known, 90)) if len(known) else 2.0
        thin = depth[mine & film]
        if len(thin) * s.cell_mm**2 > options.least_film_mm2:
            thick = min(thick, float(np.median(thin)))  # so that samples lie in its lower half
        found.append(Box.around(points[mine], options.margin_mm, thick))
    if (gone := sought.gone) is not None:
        for *ends, thick in zip(gone.start_mm, gone.end_mm, gone.height_mm, strict=True):
            found.append(Box.around(np.stack(ends), options.margin_mm, float(thick)))
    return _merged(found)


def _films(sought: Sought, which: Numbers) -> Mask:
    """Cells of an even surface over which a film is missing: no deeper, and it faces out of it.

    What is left of a thin roof lies as near to the template's surface, but to its other side.
    """
    s, options = sought.evidence.surfels, sought.options.voxels
    depth_mm, wide_mm = np.abs(s.deviation_mm[which]), np.abs(s.wide_mean(s.deviation_mm, which))
    film = (depth_mm < options.film_mm) & (np.abs(depth_mm - wide_mm) < options.even_mm)
    some = which[film]
    outward = sought.template.distance_and_gradient(s.place_mm[some])[1]
    film[film] = (outward * sought.evidence.normal[some]).sum(axis=1) > options.facing
    return film


def _paths_out(sought: Sought, which: Numbers) -> Float[np.ndarray, "p 3"]:
    """Points through the empty space from a void's floor to where it leaves the template.

    They tie the floor to the mouth where nobody sampled the walls between.
    """
    s, step_mm = sought.evidence.surfels, sought.options.voxels.path_step_mm
    first = np.unique(cells_of(s.place_mm[which], 0.0, step_mm), axis=0, return_index=True)[1]
    front, along = s.place_mm[which[first]], sought.evidence.normal[which[first]]
    found = [front[:0]]
    reach_mm = diagonal(sought.template.bounds_mm)
    for _ in range(int(reach_mm / step_mm) + 1):
        front = front + step_mm * along
        f = sought.template.distance(front)
        go_on = (f < 0) & (sought.evidence.clearance(front, f, 0.0)[0] > 0)
        if not go_on.any():
            break
        front, along = front[go_on], along[go_on]
        found.append(front)
    return np.concatenate(found)


def _merged(boxes: list[Box]) -> list[Box]:
    """Boxes that overlap become one, so that no volume is made twice."""
    apart: list[Box] = []
    for box in boxes:
        whole = box
        while beside := [b for b in apart if boxes_meet(b.corners_mm, whole.corners_mm)]:
            apart.remove(beside[0])
            whole = whole.joined(beside[0])
        apart.append(whole)
    return apart
