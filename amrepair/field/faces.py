"""Broken faces: what a scan without rays says of the space around what left the template.

Around a defect every point of the scan is looked at for itself: on the template's own surface, or
on a broken face with a plane of its own. With the template's surface where it was seen, they close
what stands there; the winding number then says which side a point of space is on, and the nearest
face how far. Nothing is labelled here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from amrepair.field import faces_kernels as kernels
from amrepair.field.fused import Surfels
from amrepair.field.holes import UPRIGHT, is_backed, is_closed, is_lined, spoken_of, stood_on
from amrepair.field.near import has_near
from amrepair.field.rooms import Rooms, find_rooms
from amrepair.field.sheets import other_sides, with_own_area
from amrepair.field.turning import side_by_view, turned_down, turned_to_close
from amrepair.field.winding import Shell
from amrepair.frames import unit_vectors
from amrepair.scans import Scan
from amrepair.template.port import Template

# The scan is looked at point by point within this of what lies off the template.
AROUND_MM = 1.5
# Points of one plane: at the spacing s of the scan a disc of about 2 s.
PLANE_POINTS = 16
PLANE_ROUNDS = 4
LONE_RATIO = 0.2  # of its neighbours must be broken, too
NEIGHBOURS = 6
# Planes more than 40° off the template's own slope are another surface, if they lie below it.
STRIP_COSINE, STRIP_MM = 0.77, 0.03
# The template's surface is there where a point of the scan lies this near (in spacings).
PRESENT_SPACINGS = 1.6
# Nearer than this share of that, a patch needs no even samples around it.
SURE_RATIO = 0.4
# No sample of those around a patch lies farther from it (in the same reach).
OFF_REACHES = 4.0
# Samples on one side only: a patch beside a rim (0 amid even samples, 1 far outside).
SURROUND_POINTS, LOPSIDED = 8, 0.6
# A face answers for what lies over it: sideways within a spacing and this share of the height.
BESIDE_SPACINGS, BESIDE_PER_HEIGHT = 2.0, 0.5
NEAR_SPACINGS = 3.0
# Nearer to ½ than this the winding number does not say on which side of a surface a point is.
SURE_WINDING = 0.05
PROBE_MM = 0.5
OPEN_WINDING = 0.3
STEP_SPACINGS = 2.0  # before a face and behind it, where the winding number is asked
# Faces are turned to close what was seen where that leaves less than so much of the opening.
CLOSER_RATIO = 0.5
# A sign vector needs this mean agreement with the template before file normals are believed.
NORMAL_AGREEMENT = 0.5


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
    shell
        All that is known to stand there as one closed surface.
    """

    place_mm: Float[np.ndarray, "k 3"]
    deviation_mm: Float[np.ndarray, " k"]
    off: Bool[np.ndarray, " k"]
    normal: Float[np.ndarray, "k 3"]
    spacing_mm: float
    tree: cKDTree
    shell: Shell

    def clearance(
        self, points_mm: Float[np.ndarray, "n 3"], f_mm: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Signed distance to what stands there, positive outside.

        The nearest places answer (`nearest_planes`). Where none lies over the point, the winding
        number says the side and the nearest place how far.
        """
        near = nearest_planes(
            points_mm,
            f_mm,
            self.tree,
            place_mm=self.place_mm,
            deviation_mm=self.deviation_mm,
            off=self.off,
            normal=self.normal,
            count=NEIGHBOURS,
            blur_mm=2 * self.spacing_mm,
        )
        best, distance = near.value_mm, near.distance_mm
        s = self.spacing_mm
        far = (distance > NEAR_SPACINGS * s) | (
            near.sideways_mm > BESIDE_SPACINGS * s + BESIDE_PER_HEIGHT * near.height_mm
        )
        ask = np.flatnonzero(far | (distance > s))
        if len(ask):
            inside = self.shell.winding(points_mm[ask])
            contrary = np.where(
                best[ask] < 0, inside < 0.5 - SURE_WINDING, inside > 0.5 + SURE_WINDING
            )
            decided = far[ask] | contrary
            sign = np.where(inside[decided] < 0.5, 1.0, -1.0)
            best[ask[decided]] = sign * distance[ask[decided]]
        return np.asarray(best)


@dataclass(frozen=True, slots=True)
class Patches:
    """The template's surface: (m, 3) places, and outward normals times area."""

    place_mm: Float[np.ndarray, "m 3"]
    vector_mm2: Float[np.ndarray, "m 3"]


def find_faces(
    scan: Scan,
    template: Template,
    surfels: Surfels,
    off: Bool[np.ndarray, " s"],
    patches: Patches,
    *,
    threshold_mm: float,
    up: Float[np.ndarray, " 3"] = UPRIGHT,
) -> Faces:
    """Look at the scan around the surfels in `off` and close what stands there.

    Parameters
    ----------
    threshold_mm
        Deviation from the template that is more than noise for a mean of `PLANE_POINTS` points.
    up
        Unit vector away from what the part stands on.
    """
    kept = surfels.of_point >= 0
    near_cell = _around(scan.points_mm[kept], surfels, off, patches)
    chosen = np.flatnonzero(kept)[near_cell[surfels.of_point[kept]]]
    points = scan.points_mm[chosen]
    place, plane, area, neighbours = _planes(
        points, spacing_mm=surfels.spacing_mm, sigma_mm=max(scan.sigma_mm, surfels.spread_mm)
    )
    deviation, gradient = template.distance_and_gradient(place)
    gradient = unit_vectors(gradient)
    along = np.abs((gradient * plane).sum(axis=1))
    broken = np.abs(deviation) > threshold_mm
    broken |= (along < STRIP_COSINE) & (deviation < -STRIP_MM)
    # a lone point among others is noise, as are crumbs along the rim of what nobody saw
    broken &= broken[neighbours].mean(axis=1) > LONE_RATIO
    broken &= has_near(place, surfels.place_mm[off], AROUND_MM)
    sheet = other_sides(place, plane, deviation, gradient, broken, spacing_mm=surfels.spacing_mm)
    area = with_own_area(area, neighbours, sheet)
    rest = np.flatnonzero(~near_cell)
    places = np.concatenate([place, surfels.place_mm[rest]])
    is_off = np.concatenate([broken, np.zeros(len(rest), bool)])
    tree = cKDTree(places, compact_nodes=False, balanced_tree=False)
    spacing_mm = float(np.sqrt(np.median(area)))
    reach = np.full(len(places), PRESENT_SPACINGS * spacing_mm)
    reach[len(place) :] = 1.8 * surfels.cell_mm
    crossing = is_off.copy()
    crossing[: len(place)] &= ~sheet
    present = _present(patches, places, crossing, tree, reach)
    foot = stood_on(patches.place_mm, patches.vector_mm2, present, up)
    stands = present | foot
    which = np.flatnonzero(broken)
    rooms = find_rooms(
        template,
        scan.points_mm[kept],
        place[which],
        patches.place_mm[present],
        unit_vectors(patches.vector_mm2[present]),
        foot=(up, float((patches.place_mm[foot] @ up).min())) if foot.any() else None,
    )
    given = None
    if scan.normals is not None:
        given = _given(scan.normals[chosen], gradient, ~broken)
    if given is not None:
        flip = (plane[which] * given[which]).sum(axis=1) < 0
        outward = np.where(flip[:, None], -plane[which], plane[which])
    else:
        side = rooms.open_side(place[which], plane[which])
        by_view = side_by_view(plane[which], patches.vector_mm2, present)
        side = np.where(side == 0, by_view, side)
        away = -np.sign((plane[which] * gradient[which]).sum(axis=1))
        side = np.where(sheet[which], away, side)
        outward = turned_down(
            place,
            which,
            plane,
            area,
            neighbours,
            present_mm=patches.place_mm[stands],
            present_mm2=patches.vector_mm2[stands],
            step_mm=STEP_SPACINGS * spacing_mm,
            side=side,
        )
    seen = present.copy()
    holes = np.flatnonzero(~present)
    spoken, looked_at = spoken_of(
        template, patches.place_mm[holes], place[which], outward, spacing_mm=spacing_mm
    )
    present[holes[~spoken]] = True
    seen_mm2 = patches.vector_mm2[present | foot].sum(axis=0)
    whole_mm2 = patches.vector_mm2.sum(axis=0)
    lined = is_lined(
        patches.place_mm[~(present | foot)],
        patches.place_mm[seen],
        place[which],
        spacing_mm=spacing_mm,
    )
    closed = lined and is_closed(seen_mm2, whole_mm2, outward * area[which, None])
    if given is None and lined and not closed:
        other = turned_to_close(
            outward, area[which], side != 0, which, neighbours, seen_mm2=seen_mm2
        )
        closed = is_closed(seen_mm2, whole_mm2, other * area[which, None])
        before_mm2, after_mm2 = (
            float(np.linalg.norm(seen_mm2 + area[which] @ way)) for way in (outward, other)
        )
        # what is open for want of a look stays open: turning faces only hides some of it
        closed &= after_mm2 < CLOSER_RATIO * before_mm2
        outward = other if closed else outward
    vectors = outward * area[which, None]
    normal = np.zeros((len(places), 3))
    normal[which] = outward
    deviations = np.concatenate([deviation, surfels.deviation_mm[rest]])

    def faces_with(keep: Bool[np.ndarray, " m"]) -> Faces:
        shell = Shell.of(
            np.concatenate([patches.place_mm[keep], place[which]]),
            np.concatenate([patches.vector_mm2[keep], vectors]),
        )
        return Faces(places, deviations, is_off, normal, spacing_mm, tree, shell)

    if closed:
        return faces_with(_standing(faces_with, template, patches, present, rooms))
    backed = is_backed(
        template,
        patches.place_mm[holes := np.flatnonzero(~present)],
        unit_vectors(patches.vector_mm2[holes]),
        seen_mm=patches.place_mm[seen],
        face_mm=place[which],
        spacing_mm=spacing_mm,
    )
    lit = looked_at[spoken]
    return faces_with(
        _standing_unless_faced(faces_with, template, patches, present, rooms, lit, backed)
    )


def _around(
    points_mm: Float[np.ndarray, "n 3"],
    surfels: Surfels,
    off: Bool[np.ndarray, " s"],
    patches: Patches,
) -> Bool[np.ndarray, " s"]:
    """Surfels near what lies off the template, or near template that no point lies on."""
    seen = has_near(patches.place_mm, points_mm, PRESENT_SPACINGS * surfels.spacing_mm)
    lost = np.concatenate([surfels.place_mm[off], patches.place_mm[~seen]])
    return has_near(surfels.place_mm, lost, AROUND_MM)


def _present(
    patches: Patches,
    places_mm: Float[np.ndarray, "k 3"],
    off: Bool[np.ndarray, " k"],
    tree: cKDTree,
    reach_mm: Float[np.ndarray, " k"],
) -> Bool[np.ndarray, " m"]:
    """Patches of the template's surface amid scanned surface, not beside its rim."""
    first, nearest = tree.query(patches.place_mm, workers=2)
    near = np.asarray(first < SURE_RATIO * reach_mm[nearest])
    # broken faces are looked for among the samples only where there are any
    rim = has_near(patches.place_mm, places_mm[off], OFF_REACHES * float(reach_mm.max()))
    asked = np.flatnonzero((~near & (first < reach_mm[nearest])) | (near & rim))
    k = min(SURROUND_POINTS, len(places_mm))
    index = tree.query(patches.place_mm[asked], k=k, workers=2)[1].reshape(-1, k)
    offset = places_mm[index] - patches.place_mm[asked, None, :]
    normal = unit_vectors(patches.vector_mm2[asked])
    offset -= np.einsum("mki,mi->mk", offset, normal)[:, :, None] * normal[:, None, :]
    sideways = np.linalg.norm(offset, axis=2).mean(axis=1)
    lopsided = np.linalg.norm(offset.mean(axis=1), axis=1) / np.maximum(sideways, 1e-9)
    near[asked] = (near[asked] | (lopsided < LOPSIDED)) & (off[index].mean(axis=1) < 0.5)
    return near


def _standing(
    faces_with: Callable[[Bool[np.ndarray, " m"]], Faces],
    template: Template,
    patches: Patches,
    present: Bool[np.ndarray, " m"],
    rooms: Rooms,
) -> Bool[np.ndarray, " m"]:
    """Patches of the template that stand: those seen, and those that nothing speaks against.

    A hole in the scan is missing where just inside the template's surface there is a room that is
    open to the outside and nothing else; a broken face that looks out at it; or a winding number
    of 0, since broken faces close it from within. It is covered where they close it from outside
    (1). Else it is unseen: then the template's own surface is taken to stand there.
    """
    probes, f_mm, room = _probes(template, patches, holes := np.flatnonzero(~present), rooms)
    keep = present
    for _ in range(2):  # what is unseen elsewhere pulls on the first answer
        faces = faces_with(keep)
        inside = faces.shell.winding(probes)
        faced = _faced(faces, probes, f_mm)
        unseen = (inside > OPEN_WINDING) & (inside < 1 - OPEN_WINDING / 2) & ~faced & (room <= 0)
        # a patch that stands closes the surface itself: only the others are asked again
        keep = keep.copy()
        keep[holes[unseen]] = True
    return keep


def _standing_unless_faced(
    faces_with: Callable[[Bool[np.ndarray, " m"]], Faces],
    template: Template,
    patches: Patches,
    present: Bool[np.ndarray, " m"],
    rooms: Rooms,
    lit: Bool[np.ndarray, " h"],
    backed: Bool[np.ndarray, " h"],
) -> Bool[np.ndarray, " m"]:
    """The same of a scan that leaves more open than what is broken: views of a part.

    There a winding number of 0 tells nothing: all stands at first, and a patch goes where broken
    faces look at it, or the opening that those leave which went before. So what is gone grows from
    the faces on, as far as their openings are wide, and never to walls that nobody saw. `lit` are
    the holes' patches that a face looks at along its normal; `backed` ones stay.
    """
    probes, f_mm, room = _probes(template, patches, holes := np.flatnonzero(~present), rooms)
    faces = faces_with(np.ones(len(present), dtype=bool))
    # the template's own surface alone is 1 inside, but for how finely it is cut in patches
    inside = 1.0 + faces_with(np.zeros(len(present), dtype=bool)).shell.winding(probes)
    gone = np.zeros(len(holes), dtype=bool)
    new = (_faced(faces, probes, f_mm) | (room > 0) | lit) & (inside < 1 - OPEN_WINDING / 3)
    new = (new | (inside < 1 - OPEN_WINDING)) & ~backed
    while new.any():
        gone |= new
        went = Shell.of(patches.place_mm[holes[new]], patches.vector_mm2[holes[new]])
        rest = np.flatnonzero(~gone)
        inside[rest] -= went.winding(probes[rest])
        new = ~gone & ~backed & (inside < 1 - OPEN_WINDING)
    keep = np.ones(len(present), dtype=bool)
    keep[holes[gone | (inside > 1 + OPEN_WINDING)]] = False  # gone, or covered
    return keep


def _probes(
    template: Template, patches: Patches, holes: Int[np.ndarray, " h"], rooms: Rooms
) -> tuple[Float[np.ndarray, "h 3"], Float[np.ndarray, " h"], Float[np.ndarray, " h"]]:
    """Places just inside the holes' patches, the template's distance there, and their rooms."""
    probes = patches.place_mm[holes] - PROBE_MM * unit_vectors(patches.vector_mm2[holes])
    return probes, template.distance(probes), rooms.value_at(probes)


def _faced(
    faces: Faces, probes: Float[np.ndarray, "h 3"], f_mm: Float[np.ndarray, " h"]
) -> Bool[np.ndarray, " h"]:
    """Where a broken face is near, and looks at the place."""
    distance, nearest = faces.tree.query(probes, workers=2)
    faced = faces.off[nearest] & (distance < NEAR_SPACINGS * faces.spacing_mm)
    faced[faced] = faces.clearance(probes[faced], f_mm[faced]) > 0
    return np.asarray(faced)


def _planes(
    points_mm: Float[np.ndarray, "n 3"], *, spacing_mm: float, sigma_mm: float
) -> tuple[
    Float[np.ndarray, "n 3"],
    Float[np.ndarray, "n 3"],
    Float[np.ndarray, " n"],
    Int[np.ndarray, "n k"],
]:
    """Points moved onto the planes through their neighbours, those planes' normals, and areas."""
    k = min(PLANE_POINTS, len(points_mm))
    distance, index = cKDTree(points_mm).query(points_mm, k=k, workers=2)
    distance, index = distance.reshape(-1, k), index.reshape(-1, k)
    place, normal = kernels.smoothed(points_mm, index, PLANE_ROUNDS, spacing_mm, 2 * sigma_mm)
    area = np.pi * distance[:, -1] ** 2 / max(k - 1, 1)
    return place, normal, area, index


def _given(
    normals: Float[np.ndarray, "n 3"],
    gradient: Float[np.ndarray, "n 3"],
    on: Bool[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"] | None:
    """The file's normals, turned outward as a whole; None where they contradict the template."""
    if not on.any():
        return normals
    agreement = float(np.median((gradient[on] * normals[on]).sum(axis=1)))
    if abs(agreement) < NORMAL_AGREEMENT:
        return None
    return np.asarray(normals * np.sign(agreement))
