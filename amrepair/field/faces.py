"""Broken faces: what a scan without rays says of the space around what left the template.

Around a defect every point of the scan is looked at for itself: on the template's own surface, or
on a broken face with a plane of its own. The nearest faces say how far a point of space is from
what stands there, and `occupancy` on which side of it. Nothing is labelled here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from amrepair.field import faces_kernels as kernels
from amrepair.field.fused import Surfels
from amrepair.field.near import has_near
from amrepair.field.occupancy import Broken, Occupancy, find_occupancy
from amrepair.field.options import EvidenceOptions, FaceOptions
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

    value_mm: Float[np.ndarray, " n"]
    distance_mm: Float[np.ndarray, " n"]
    height_mm: Float[np.ndarray, " n"]
    sideways_mm: Float[np.ndarray, " n"]
    index: Int[np.ndarray, " n"]


def nearest_planes(
    points_mm: Float[np.ndarray, "n 3"],
    f_mm: Float[np.ndarray, " n"],
    tree: cKDTree,
    *,
    place_mm: Float[np.ndarray, "k 3"],
    deviation_mm: Float[np.ndarray, " k"],
    off: Bool[np.ndarray, " k"],
    normal: Float[np.ndarray, "k 3"],
    count: int,
    blur_mm: float,
) -> NearestPlanes:
    """Ask the nearest places of a surface on which side of it points lie.

    A place on the template answers f(x) − f(place): exact on curves and edges. One off it answers
    with its own plane. `blur_mm` says how fast farther ones count less.
    """
    k = min(count, len(place_mm))
    distance, index = tree.query(points_mm, k=k, workers=2)
    distance, index = distance.reshape(-1, k), index.reshape(-1, k)
    value, height = kernels.plane_values(
        np.ascontiguousarray(points_mm), f_mm, distance, index,
        place_mm, deviation_mm, off, normal, blur_mm,
    )  # fmt: skip
    sideways = np.sqrt(np.maximum(distance[:, 0] ** 2 - height**2, 0.0))
    return NearestPlanes(value, distance[:, 0].copy(), height, sideways, index[:, 0].copy())


@dataclass(frozen=True, slots=True)
class Faces:
    """The scanned surface around defects, template frame.

    Attributes
    ----------
    place_mm, deviation_mm
        (k, 3) and (k,) places and the template's distance there; around defects moved onto the
        plane through their neighbours, elsewhere the surfels.
    off
        (k,) on a broken face.
    normal
        (k, 3) outward unit normals where `off`, else zero.
    spacing_mm
        Of the scan.
    occupancy
        Which space around the broken faces is solid.
    options
        That it was made with.
    """

    place_mm: Float[np.ndarray, "k 3"]
    deviation_mm: Float[np.ndarray, " k"]
    off: Bool[np.ndarray, " k"]
    normal: Float[np.ndarray, "k 3"]
    spacing_mm: float
    tree: cKDTree
    occupancy: Occupancy
    options: FaceOptions

    def clearance(
        self, points_mm: Float[np.ndarray, "n 3"], f_mm: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Signed distance to what stands there, positive outside.

        The nearest places answer (`nearest_planes`). Where none lies over the point, the occupancy
        says the side and the nearest place how far; beyond its box it is as designed.
        """
        options = self.options
        near = nearest_planes(
            points_mm,
            f_mm,
            self.tree,
            place_mm=self.place_mm,
            deviation_mm=self.deviation_mm,
            off=self.off,
            normal=self.normal,
            count=options.neighbours,
            blur_mm=2 * self.spacing_mm,
        )
        best, distance = near.value_mm, near.distance_mm
        s = self.spacing_mm
        beside_mm = options.beside_spacings * s + options.beside_per_height * near.height_mm
        far = (distance > options.near_spacings * s) | (near.sideways_mm > beside_mm)
        ask = np.flatnonzero(far | (distance > self.occupancy.voxel_mm))
        told = self.occupancy.at(points_mm[ask])
        designed = -np.sign(f_mm[ask])
        solid = np.where((told == 0) | (designed < 0), designed, np.sign(told))
        decided = far[ask] | (best[ask] * solid > 0)
        best[ask[decided]] = -solid[decided] * distance[ask[decided]]
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

    place_mm: Float[np.ndarray, "n 3"]
    plane: Float[np.ndarray, "n 3"]
    area_mm2: Float[np.ndarray, " n"]
    neighbours: Int[np.ndarray, "n k"]
    deviation_mm: Float[np.ndarray, " n"]
    outward: Float[np.ndarray, "n 3"]
    is_broken: Bool[np.ndarray, " n"]

    @classmethod
    def of(
        cls,
        points_mm: Float[np.ndarray, "n 3"],
        template: Template,
        *,
        spacing_mm: float,
        sigma_mm: float,
        threshold_mm: float,
        options: FaceOptions,
    ) -> _Places:
        """Planes through the points, and which are none of the template's."""
        place, plane, area_mm2, neighbours = _planes(
            points_mm, spacing_mm=spacing_mm, sigma_mm=sigma_mm, options=options
        )
        deviation, gradient = template.distance_and_gradient(place)
        outward = unit_vectors(gradient)
        along = np.abs((outward * plane).sum(axis=1))
        is_broken = np.abs(deviation) > threshold_mm
        is_broken |= (along < options.strip_cosine) & (deviation < -options.strip_mm)
        # a lone point among others is noise, as are crumbs along the rim of what nobody saw
        is_broken &= is_broken[neighbours].mean(axis=1) > options.lone_ratio
        return cls(place, plane, area_mm2, neighbours, deviation, outward, is_broken)


def _looked_at(
    scan: Scan,
    template: Template,
    surfels: Surfels,
    off: Bool[np.ndarray, " s"],
    threshold_mm: float,
    options: FaceOptions,
) -> tuple[Bool[np.ndarray, " s"], Bool[np.ndarray, " n"], _Places]:
    """Which cells and points are looked at, and what they say: around what lies off, and from
    what is broken there on, as far as that goes.
    """
    kept = surfels.of_point >= 0
    far = np.abs(surfels.point_deviation_mm[kept]) > threshold_mm
    share = np.bincount(surfels.of_point[kept], far, len(surfels)) / surfels.count
    near_cell = has_near(surfels.place_mm, surfels.place_mm[off], options.around_mm)
    while True:
        chosen = np.zeros(len(scan.points_mm), bool)
        chosen[kept] = near_cell[surfels.of_point[kept]]
        found = _Places.of(
            scan.points_mm[chosen],
            template,
            spacing_mm=surfels.spacing_mm,
            sigma_mm=max(scan.sigma_mm, surfels.spread_mm),
            threshold_mm=threshold_mm,
            options=options,
        )
        broken_mm = found.place_mm[found.is_broken]
        beside = has_near(surfels.place_mm, broken_mm, options.around_mm) & ~near_cell
        # a film's cell has both its sides, and lies off as a whole only where one of them does
        if not (share[beside] > options.lone_ratio).any():
            return near_cell, chosen, found
        near_cell |= beside


def find_faces(
    scan: Scan,
    template: Template,
    surfels: Surfels,
    off: Bool[np.ndarray, " s"],
    surface: tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]],
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
    place, plane, deviation, is_broken = at.place_mm, at.plane, at.deviation_mm, at.is_broken
    which = np.flatnonzero(is_broken)
    broken = Broken(place[which], plane[which], deviation[which], at.outward[which])
    spacing_mm = float(np.sqrt(np.median(at.area_mm2))) or surfels.spacing_mm  # 0: all in one place
    on_mm = np.concatenate([place[~is_broken], scan.points_mm[(surfels.of_point >= 0) & ~chosen]])
    occupancy = find_occupancy(
        template, broken, on_mm, surface, spacing_mm=spacing_mm, options=options.occupancy
    )
    given = None
    if scan.normals is not None:
        given = _given(scan.normals[chosen], at.outward, ~is_broken, options.faces)
    if given is not None:
        side = (plane[which] * given[which]).sum(axis=1)
    else:
        side = _voted(occupancy.open_side(broken), plane, at.outward, which, at.neighbours)
    rest = ~near_cell
    places = np.concatenate([place, surfels.place_mm[rest]])
    normal = np.zeros_like(places)
    normal[which] = np.where(side[:, None] < 0, -plane[which], plane[which])
    return Faces(
        place_mm=places,
        deviation_mm=np.concatenate([deviation, surfels.deviation_mm[rest]]),
        off=np.append(is_broken, np.zeros(int(rest.sum()), bool)),
        normal=normal,
        spacing_mm=spacing_mm,
        tree=cKDTree(places, compact_nodes=False, balanced_tree=False),
        occupancy=occupancy,
        options=options.faces,
    )


def _voted(
    side: Float[np.ndarray, " q"],
    plane: Float[np.ndarray, "n 3"],
    gradient: Float[np.ndarray, "n 3"],
    which: Int[np.ndarray, " q"],
    neighbours: Int[np.ndarray, "n k"],
) -> Float[np.ndarray, " q"]:
    """(q,) sides as neighbours say together; where they say nothing, as the template faces."""
    falls = np.zeros_like(plane)
    falls[which] = side[:, None] * plane[which]
    vote = (falls[neighbours[which]].sum(axis=1) * plane[which]).sum(axis=1)
    by_template = (plane[which] * gradient[which]).sum(axis=1)
    return np.asarray(np.where(np.abs(vote) > 1e-6, vote, by_template))


def _planes(
    points_mm: Float[np.ndarray, "n 3"],
    *,
    spacing_mm: float,
    sigma_mm: float,
    options: FaceOptions,
) -> tuple[
    Float[np.ndarray, "n 3"],
    Float[np.ndarray, "n 3"],
    Float[np.ndarray, " n"],
    Int[np.ndarray, "n k"],
]:
    """Points moved onto the planes through their neighbours, those planes' normals, and areas."""
    k = min(options.plane_points, len(points_mm))
    distance, index = cKDTree(points_mm).query(points_mm, k=k, workers=2)
    distance, index = distance.reshape(-1, k), index.reshape(-1, k)
    place, normal = kernels.smoothed(
        points_mm, index, options.plane_rounds, spacing_mm, 2 * sigma_mm
    )
    area = np.pi * distance[:, -1] ** 2 / max(k - 1, 1)
    return place, normal, area, index


def _given(
    normals: Float[np.ndarray, "n 3"],
    gradient: Float[np.ndarray, "n 3"],
    on: Bool[np.ndarray, " n"],
    options: FaceOptions,
) -> Float[np.ndarray, "n 3"] | None:
    """The file's normals, turned outward as a whole; None where they contradict the template."""
    if not on.any():
        return normals
    agreement = float(np.median((gradient[on] * normals[on]).sum(axis=1)))
    if abs(agreement) < options.normal_agreement:
        return None
    return np.asarray(normals * np.sign(agreement))
