"""Boxes in which solids are made: around what detection labelled, with its depth.

A box also has to hold a void's walls and mouth, where the scan has no points.
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
    """All that solids of one label (missing or excess) are made from, template frame.

    Attributes
    ----------
    gone
        Missing lines of the job; None where there are none, and for excess. Around them only rays
        count: the surfaces next to a missing line belong to the lines below and beside it.
    """

    template: Template
    evidence: Evidence
    anomaly: AnomalyMap
    label: Label
    gone: PlannedBeads | None
    options: DeficitOptions

    @property
    def tau_mm(self) -> float:
        """τ: nearer to the template than this, only what detection labelled counts."""
        return self.anomaly.threshold_mm

    @property
    def is_excess(self) -> bool:
        """Whether this is about excess rather than missing material."""
        return self.label is Label.EXCESS

    @property
    def sign(self) -> float:
        """Sign of the template's distance where such material may be: negative inside."""
        return 1.0 if self.is_excess else -1.0

    @property
    def labelled(self) -> Mask:
        """(s,) whether detection gave each surfel this label."""
        return np.asarray(np.asarray(self.anomaly.surfel_label) == int(self.label))

    @property
    def surface_mm(self) -> Points:
        """(g, 3) points of the template's surface with this label."""
        return self.anomaly.template_points_mm[self.anomaly.template_label == int(self.label)]

    def told_mm(self, inside: Mask) -> Float[np.ndarray, "p 3"]:
        """(p, 3) places known to be missing: the given surfels, template points, missing lines."""
        told = [self.evidence.surfels.place_mm[inside], self.surface_mm]
        if self.gone is not None:
            told.append(self.gone.samples_mm(self.options.skipped.sample_step_mm))
        return np.concatenate(told)

    def nearest_is_labelled(self, samples_mm: Points) -> Mask:
        """(k,) whether the surfel nearest to each place has this label."""
        nearest = self.evidence.surfels.tree.nearest_one(samples_mm)
        return np.asarray(self.labelled[nearest])

    def allowed_mm(self, samples_mm: Points, asked: Mask) -> Values:
        """(k,) how far outside the template material is allowed, by the nearest surfel."""
        allowed_mm = np.zeros(len(samples_mm))
        higher_mm = self.anomaly.surfel_higher_mm
        if self.is_excess and higher_mm is not None and (higher_mm > 0).any():
            nearest = self.evidence.surfels.tree.nearest_one(samples_mm[asked])
            allowed_mm[asked] = higher_mm[nearest]
        return allowed_mm


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """A box by its (2, 3) lowest and highest corner, and how thick the defect in it is.

    Of a wall that broke off that is how far its end lies from its sides; of a film its height.
    """

    corners_mm: Float[np.ndarray, "2 3"]
    depth_mm: float
    is_film: bool

    @classmethod
    def around(cls, places_mm: Points, margin_mm: float, depth_mm: float, is_film: bool) -> Box:
        """The box around places, with a margin."""
        return cls(box_of(places_mm) + margin_mm * np.array([[-1.0], [1.0]]), depth_mm, is_film)

    def joined(self, other: Box) -> Box:
        """The box around two boxes, as finely sampled as the finer of them."""
        both_mm = np.concatenate([self.corners_mm, other.corners_mm])
        depth_mm = min(self.depth_mm, other.depth_mm)
        return Box(box_of(both_mm), depth_mm, self.is_film or other.is_film)


def boxes_of(sought: Sought) -> list[Box]:
    """Boxes around each group of labelled cells and template points, and around missing lines."""
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
        is_film = 2 * len(thin) > len(known)
        found.append(Box.around(points[mine], options.margin_mm, thick, is_film))
    if (gone := sought.gone) is not None:
        for *ends, thick in zip(gone.start_mm, gone.end_mm, gone.height_mm, strict=True):
            found.append(Box.around(np.stack(ends), options.margin_mm, float(thick), is_film=True))
    return _merged(found)


def _films(sought: Sought, which: Numbers) -> Mask:
    """Which cells lie under a missing film: shallow, even, and facing out of the template.

    The rest of a thin roof also lies near to the template's surface, but faces the other way.
    """
    s, options = sought.evidence.surfels, sought.options.voxels
    depth_mm, wide_mm = np.abs(s.deviation_mm[which]), np.abs(s.wide_mean(s.deviation_mm, which))
    film = (depth_mm < options.film_mm) & (np.abs(depth_mm - wide_mm) < options.even_mm)
    some = which[film]
    outward = sought.template.distance_and_gradient(s.place_mm[some])[1]
    film[film] = (outward * sought.evidence.normal[some]).sum(axis=1) > options.facing
    return film


def _paths_out(sought: Sought, which: Numbers) -> Float[np.ndarray, "p 3"]:
    """Points on straight lines through empty space, from a void's floor to outside the template.

    They connect the floor with the mouth where the scan has no points on the walls between.
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
    """Join boxes that overlap, so that no volume is made twice."""
    apart: list[Box] = []
    for box in boxes:
        whole = box
        while beside := [b for b in apart if boxes_meet(b.corners_mm, whole.corners_mm)]:
            apart.remove(beside[0])
            whole = whole.joined(beside[0])
        apart.append(whole)
    return apart
