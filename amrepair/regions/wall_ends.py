"""Broken ends of thin walls, found by geometry where no rays tell that the wall is gone.

Where a thin wall broke off, a scan without rays shows only the fracture: a strip as wide as the
wall. Its points lie inside the wall, so at most half the wall's thickness from the template, and
their deviations look harmless. But their orientation tells: a surface in the middle of a wall that
faces along the wall is neither of the wall's faces. How much is missing is then measured in the
direction that the fracture faces, not to the nearest face.

Stray points inside a wall may by chance seem to lie across it, too. They are told from a fracture
because both faces of the wall go on at either side of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from amrepair.arrays import Mask, Numbers, Points, Values
from amrepair.field.fused import Surfels
from amrepair.field.places import PlaceTree
from amrepair.field.scales import WINDOW_FACING
from amrepair.regions.options import WallEndOptions
from amrepair.scans import Scan
from amrepair.template.port import Template

# Steps along a ray from inside the part to where it leaves it; each as long as the distance there.
MOST_STEPS = 16


@dataclass(frozen=True)
class ShownSurface:
    """Points spread evenly over the template's surface, and which of them the scan shows.

    Attributes
    ----------
    place_mm, normal
        (m, 3) points, and outward unit normals.
    present
        (m,) whether scanned surface lies on each,
    present_mm
        which means no farther off than this.
    """

    place_mm: Points
    normal: Points
    present: Mask
    present_mm: float

    @cached_property
    def _tree(self) -> PlaceTree:
        return PlaceTree.of(self.place_mm)

    def nearest(self, points_mm: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
        """(n,) the surface point nearest to each of some points."""
        return self._tree.nearest_one(points_mm)


@dataclass(frozen=True, slots=True)
class WallEnds:
    """Broken ends, condensed to the cells of the scan, template frame.

    Attributes
    ----------
    place_mm, normal
        (e, 3) mean places; and unit normals of the wall's faces, with either sign: an error of the
        pose matters in this direction.
    depth_mm
        (e,) how far the end lies below the part's surface, in the direction that it faces.
    count
        (e,) the number of points of each.
    surfel
        (e,) the number of the cell that the points belong to.
    """

    place_mm: Points
    normal: Points
    depth_mm: Values
    count: Values
    surfel: Numbers

    def __len__(self) -> int:
        return len(self.depth_mm)


NO_ENDS = WallEnds(*2 * (np.empty((0, 3)),), *2 * (np.empty(0),), np.empty(0, np.int64))


def wall_ends(
    scan: Scan,
    template: Template,
    surfels: Surfels,
    surface: ShownSurface,
    plane_points: int,
    options: WallEndOptions,
) -> WallEnds:
    """Find points inside thin walls whose local planes lie across the wall, and condense them.

    Parameters
    ----------
    scan, surfels
        In the template's frame.
    surface
        The template's surface, and which of it the scan shows.
    plane_points
        How many neighbours a point's local plane is fitted to.
    """
    points_mm, sigma_mm = scan.points_mm, max(scan.sigma_mm, surfels.spread_mm)
    inside = surfels.of_point >= 0
    inside &= surfels.point_deviation_mm < -options.stray_sigmas * sigma_mm
    which = np.flatnonzero(inside)
    deep_mm = -surfels.point_deviation_mm[which]
    face = surface.normal[surface.nearest(points_mm[which])]
    most_mm = options.thin_depths * deep_mm
    through_mm = _distance_along(template, points_mm[which], face, most_mm)
    through_mm += _distance_along(template, points_mm[which], -face, most_mm)
    thin = through_mm < most_mm
    if not thin.any():
        return NO_ENDS
    which, face, through_mm = which[thin], face[thin], through_mm[thin]
    plane = _local_planes(points_mm, which, surfels, plane_points)
    across = np.abs((plane * face).sum(axis=1)) < WINDOW_FACING
    which, face, plane, through_mm = (told[across] for told in (which, face, plane, through_mm))
    ends = _faces_end_here(surface, points_mm[which], 0.5 * through_mm[:, None] * face, plane)
    which, face, plane, through_mm = (told[ends] for told in (which, face, plane, through_mm))
    # a cloud without normals does not say which way a plane faces, so the nearer surface counts
    depth_mm = np.minimum(
        _distance_along(template, points_mm[which], plane, through_mm),
        _distance_along(template, points_mm[which], -plane, through_mm),
    )
    return _condensed(points_mm[which], face, depth_mm, surfels.of_point[which])


def _faces_end_here(
    surface: ShownSurface, points_mm: Points, to_face_mm: Points, plane: Points
) -> Bool[np.ndarray, " n"]:
    """(n,) whether, on one side of a plane across a wall, the scan shows neither of its faces."""
    beyond_mm = 2.0 * surface.present_mm * plane  # what lies at the end itself is not there
    gone = [
        ~surface.present[surface.nearest(points_mm + way * beyond_mm + side * to_face_mm)]
        for way in (-1.0, 1.0)
        for side in (-1.0, 1.0)
    ]
    return (gone[0] & gone[1]) | (gone[2] & gone[3])


def _distance_along(
    template: Template, points_mm: Points, way: Points, most_mm: Values
) -> Float[np.ndarray, " n"]:
    """(n,) distance from points inside the template to its surface along a direction, or `most_mm`.

    Sphere tracing (Hart 1996).
    """
    far_mm, going = np.zeros(len(points_mm)), np.arange(len(points_mm))
    for _ in range(MOST_STEPS):
        if len(going) == 0:
            break
        f_mm = template.distance(points_mm[going] + far_mm[going, None] * way[going])
        far_mm[going] = np.minimum(far_mm[going] - f_mm, most_mm[going])
        going = going[(f_mm < -template.bias_mm) & (far_mm[going] < most_mm[going])]
    return np.maximum(far_mm, 0.0)


def _local_planes(
    points_mm: Float[np.ndarray, "p 3"], which: Numbers, surfels: Surfels, count: int
) -> Points:
    """(n, 3) normals of the planes through some points and their neighbours."""
    cells = np.unique(surfels.of_point[which])
    near = np.zeros(len(surfels) + 1, bool)  # the last is of no cell
    near[surfels.table[cells]] = True
    near[-1] = False
    around_mm = points_mm[near[surfels.of_point]]
    index = PlaceTree.of(around_mm).nearest(points_mm[which], count)[1]
    off = around_mm[index]
    off = off - off.mean(axis=1, keepdims=True)
    return np.asarray(np.linalg.eigh(np.swapaxes(off, 1, 2) @ off)[1][:, :, 0])


def _condensed(points_mm: Points, face: Points, depth_mm: Values, surfel: Numbers) -> WallEnds:
    """Average over the points of each cell."""
    cells, of_point = np.unique(surfel, return_inverse=True)
    count = np.bincount(of_point).astype(np.float64)

    def mean(value: Values) -> Float[np.ndarray, " c"]:
        return np.asarray(np.bincount(of_point, value, len(cells)) / count)

    # points of a cell may lie nearer to one face or the other: turn all to the same face
    side = (face * face[np.unique(of_point, return_index=True)[1]][of_point]).sum(axis=1)
    turned = face * np.where(side < 0.0, -1.0, 1.0)[:, None]
    normal = np.stack([mean(part) for part in turned.T], axis=1)
    largest = np.take_along_axis(normal, np.abs(normal).argmax(axis=1)[:, None], axis=1)
    normal *= np.where(largest < 0.0, -1.0, 1.0) / np.linalg.norm(normal, axis=1, keepdims=True)
    place_mm = np.stack([mean(part) for part in points_mm.T], axis=1)
    return WallEnds(place_mm, normal, mean(depth_mm), count, cells)
