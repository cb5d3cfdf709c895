"""Broken faces: what a scan without rays says of the space around what left the template.

Around a defect every point of the scan is looked at for itself: on the template's own surface, or
on a broken face with a plane of its own. The nearest faces say how far a point of space is from
what stands there, and `occupancy` on which side of it. Nothing is labelled here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from amrepair.arrays import Mask, Numbers, Points, Values
from amrepair.field import faces_kernels as kernels
from amrepair.field.fused import Surfels
from amrepair.field.occupancy import find_occupancy
from amrepair.field.options import EvidenceOptions, FaceOptions
from amrepair.field.places import PlaceTree
from amrepair.field.space import Broken, Occupancy
from amrepair.frames import unit_vectors
from amrepair.scans import Scan
from amrepair.template.port import Template


@dataclass(frozen=True, slots=True)
class NearestPlanes:
    """What the places nearest to some points say of them.

    Attributes
    ----------
    value_mm
        (n,) signed distance to the surface through them, positive outside.
    distance_mm, height_mm, sideways_mm
        (n,) to the nearest place: in all, over its surface, along it.
    index
        (n,) the nearest place.
    """

    value_mm: Values
    distance_mm: Values
    height_mm: Values
    sideways_mm: Values
    index: Numbers


@dataclass(frozen=True, slots=True)
class SurfacePlanes:
    """Places of a scanned surface, template frame.

    Attributes
    ----------
    place_mm, deviation_mm
        (n, 3) and (n,) places and the template's distance there.
    off
        (n,) whether a place is none of the template's surface.
    normal
        (n, 3) outward unit normals where `off`.
    tree
        Of the places.
    """

    place_mm: Points
    deviation_mm: Values
    off: Mask
    normal: Points
    tree: PlaceTree

    @property
    def broken(self) -> SurfacePlanes:
        """Those of them that are none of the template's surface."""
        place_mm = self.place_mm[self.off]
        return SurfacePlanes(
            place_mm, self.deviation_mm[self.off], self.off[self.off], self.normal[self.off],
            PlaceTree.of(place_mm),
        )  # fmt: skip

    def nearest(
        self,
        points_mm: Float[np.ndarray, "m 3"],
        f_mm: Values,
        count: int,
        blur_mm: float,
        within_mm: float = np.inf,
        most_mm: float = np.inf,
    ) -> NearestPlanes:
        """Ask as many nearest places on which side of the surface points lie.

        A place on the template answers f(x) − f(place): exact on curves and edges. One off it
        answers with its own plane. `blur_mm` says how fast farther ones count less. Where none lies
        within a distance only how far the nearest lies is told, up to `most_mm`.
        """
        distance, index = self.tree.nearest(points_mm, count, within_mm, most_mm)
        value, height = kernels.plane_values(
            np.ascontiguousarray(points_mm), f_mm, distance, index,
            self.place_mm, self.deviation_mm, self.off, self.normal, blur_mm,
        )  # fmt: skip
        sideways = np.sqrt(np.maximum(distance[:, 0] ** 2 - height**2, 0.0))
        return NearestPlanes(value, distance[:, 0].copy(), height, sideways, index[:, 0].copy())


@dataclass(frozen=True, slots=True)
class Faces:
    """The scanned surface around defects, template frame.

    Attributes
    ----------
    planes
        Around defects points moved onto the planes through their neighbours, elsewhere the surfels.
    spacing_mm
        Of the scan.
    occupancy
        Which space around the broken faces is solid.
    options
        That it was made with.
    """

    planes: SurfacePlanes
    spacing_mm: float
    occupancy: Occupancy
    options: FaceOptions

    def clearance(self, points_mm: Points, f_mm: Values, most_mm: float) -> Values:
        """Signed distance to what stands there, positive outside; exact up to `most_mm`.

        The nearest places answer. Where none lies over the point, the occupancy says the side and
        the nearest place how far; beyond its box it is as designed.
        """
        options, s = self.options, self.spacing_mm
        near_mm = options.near_spacings * s
        most_mm = max(most_mm, 1.001 * near_mm)  # what is beyond must not be told to lie at it
        near = self.planes.nearest(points_mm, f_mm, options.neighbours, 2 * s, near_mm, most_mm)
        best, distance = near.value_mm, near.distance_mm
        beside_mm = options.beside_spacings * s + options.beside_per_height * near.height_mm
        far = (distance > near_mm) | (near.sideways_mm > beside_mm)
        ask = far | (distance > self.occupancy.voxel_mm)
        solid, within = -np.sign(f_mm), np.flatnonzero(ask & (f_mm < 0))
        told = self.occupancy.at(points_mm[within])
        solid[within] = np.where(told == 0, 1.0, np.sign(told))
        decided = far | (ask & (best * solid > 0))
        best[decided] = -solid[decided] * distance[decided]
        return best


@dataclass(frozen=True, slots=True)
class _Places:
    """Points of a scan looked at one by one.

    Attributes
    ----------
    place_mm, plane
        (n, 3) moved onto the planes through their neighbours, and those planes' normals.
    area_mm2, neighbours
        (n,) that each stands for, (n, k) which lie beside it.
    deviation_mm, outward
        (n,) the template's distance, (n, 3) its unit gradient.
    is_broken
        (n,) on a surface that is not the template's.
    """

    place_mm: Points
    plane: Points
    area_mm2: Values
    neighbours: Int[np.ndarray, "n k"]
    deviation_mm: Values
    outward: Points
    is_broken: Mask

    @classmethod
    def of(
        cls, points_mm: Points, template: Template, sigma_mm: float, threshold_mm: float,
        spacing_mm: float, options: FaceOptions,
    ) -> _Places:  # fmt: skip
        """Points moved onto the planes through their neighbours, and which are broken."""
        distance, index = PlaceTree.of(points_mm).neighbours(options.plane_points)
        place, plane = kernels.smoothed(
            points_mm, index, options.plane_rounds, spacing_mm, 2 * sigma_mm
        )
        area_mm2 = np.pi * distance[:, -1] ** 2 / max(index.shape[1] - 1, 1)
        deviation, gradient = template.distance_and_gradient(place)
        outward = unit_vectors(gradient)
        along = np.abs((outward * plane).sum(axis=1))
        is_broken = np.abs(deviation) > threshold_mm
        is_broken |= (along < options.strip_cosine) & (deviation < -options.strip_mm)
        # a lone point among others is noise, as are crumbs along the rim of what nobody saw
        is_broken &= is_broken[index].mean(axis=1) > options.lone_ratio
        return cls(place, plane, area_mm2, index, deviation, outward, is_broken)

    @property
    def broken(self) -> Broken:
        """Those that are."""
        at = self.is_broken
        return Broken(self.place_mm[at], self.plane[at], self.deviation_mm[at], self.outward[at])

    def given(self, normals: Points | None, least_agreement: float) -> Points | None:
        """The file's normals, all turned outward; None where they contradict the template."""
        on = ~self.is_broken
        if normals is None or not on.any():
            return normals
        agreement = float(np.median((self.outward[on] * normals[on]).sum(axis=1)))
        return None if abs(agreement) < least_agreement else normals * np.sign(agreement)

    def outward_planes(self, occupancy: Occupancy, given: Points | None) -> Points:
        """(n, 3) the planes of what is broken, turned outward; zero elsewhere.

        As the file's own normals say, or the occupancy of neighbours together; where that says
        nothing, as the template faces.
        """
        which, normal = np.flatnonzero(self.is_broken), np.zeros_like(self.plane)
        plane = self.plane[which]
        if given is not None:
            side = (plane * given[which]).sum(axis=1)
        else:
            normal[which] = occupancy.open_side(self.broken)[:, None] * plane
            vote = (normal[self.neighbours[which]].sum(axis=1) * plane).sum(axis=1)
            side = np.where(np.abs(vote) > 1e-6, vote, (plane * self.outward[which]).sum(axis=1))
        normal[which] = np.where(side[:, None] < 0, -plane, plane)
        return normal


def _looked_at(
    scan: Scan,
    template: Template,
    surfels: Surfels,
    off: Mask,
    threshold_mm: float,
    options: FaceOptions,
) -> tuple[Mask, Bool[np.ndarray, " m"], _Places]:
    """Which cells and points are looked at, and what they say: around what lies off, and from
    what is broken there on, as far as that goes.
    """
    kept = surfels.of_point >= 0
    far = np.abs(surfels.point_deviation_mm[kept]) > threshold_mm
    share = np.bincount(surfels.of_point[kept], far, len(surfels)) / surfels.count
    sigma_mm = max(scan.sigma_mm, surfels.spread_mm)

    def around(places_mm: Points) -> Mask:
        return surfels.tree.beside(places_mm, options.around_mm)

    def looked_at(cells: Mask) -> tuple[Mask, _Places]:
        chosen = np.zeros(len(scan.points_mm), bool)
        chosen[kept] = cells[surfels.of_point[kept]]
        places = _Places.of(
            scan.points_mm[chosen], template, sigma_mm, threshold_mm, surfels.spacing_mm, options
        )
        return chosen, places

    near_cell = around(surfels.place_mm[off])
    chosen, found = looked_at(near_cell)
    last = found
    while True:
        beside = around(last.place_mm[last.is_broken]) & ~near_cell
        # a film's cell has both its sides, and lies off as a whole only where one of them does
        if not (share[beside] > options.lone_ratio).any():
            break
        near_cell |= beside
        # what is new, with what lies around it for its planes
        last = looked_at(around(surfels.place_mm[beside]) & near_cell)[1]
    if last is not found:
        chosen, found = looked_at(near_cell)
    return near_cell, chosen, found


def find_faces(
    scan: Scan,
    template: Template,
    surfels: Surfels,
    off: Bool[np.ndarray, " s"],
    surface: tuple[Points, Points],
    *,
    threshold_mm: float,
    options: EvidenceOptions,
) -> Faces:
    """Look at the scan around the surfels in `off`, and at which space there is solid.

    Parameters
    ----------
    surface
        Places evenly spread on the template's surface, and outward unit normals.
    threshold_mm
        Deviation from the template that is more than noise for a mean of a plane's points.
    """
    near_cell, chosen, at = _looked_at(scan, template, surfels, off, threshold_mm, options.faces)
    spacing_mm = float(np.sqrt(np.median(at.area_mm2))) or surfels.spacing_mm  # 0: all in one place
    other_mm = scan.points_mm[(surfels.of_point >= 0) & ~chosen]
    on_mm = np.concatenate([at.place_mm[~at.is_broken], other_mm])
    occupancy = find_occupancy(
        template, at.broken, on_mm, surface, spacing_mm=spacing_mm, options=options.occupancy
    )
    own = None if scan.normals is None else scan.normals[chosen]
    normal = at.outward_planes(occupancy, at.given(own, options.faces.normal_agreement))
    rest = ~near_cell
    places = np.concatenate([at.place_mm, surfels.place_mm[rest]])
    planes = SurfacePlanes(
        places,
        np.concatenate([at.deviation_mm, surfels.deviation_mm[rest]]),
        np.append(at.is_broken, np.zeros(int(rest.sum()), bool)),
        np.concatenate([normal, np.zeros((int(rest.sum()), 3))]),
        PlaceTree.of(places),
    )
    return Faces(planes, spacing_mm, occupancy, options.faces)
