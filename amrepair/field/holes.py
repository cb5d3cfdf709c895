"""Holes of a scan: template surface that no point lies on, and which of it broken faces speak of.

A part whose walls nobody saw has holes as large as its walls. Only one that a broken face touches,
or looks out of, can be missing; about all others the scan says nothing.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from amrepair.field.near import has_near
from amrepair.template.port import Template

# Patches nearer to each other than this are one hole; so near to its rim a face touches it.
HOLE_MM, RIM_MM = 1.0, 1.0
# Faces look out along their normals, so far at a time; so many of them tell.
LOOK_MM, LOOKING = 0.5, 2000
# Faces close what was seen but for this share of their own area: rims are ragged.
OPEN_RATIO = 0.25
# Along what is gone broken faces meet the template's seen surface: along so much of it at least.
LINED_RATIO = 0.5
UPRIGHT = np.array([0.0, 0.0, 1.0])
# A part's lowest surface, to so much, facing down to 26°; less than this share of it was seen.
FOOT_MM, FOOT_COSINE, SEEN_OF_FOOT = 0.3, -0.9, 0.3


def stood_on(
    patch_mm: Float[np.ndarray, "m 3"],
    patch_mm2: Float[np.ndarray, "m 3"],
    present: Bool[np.ndarray, " m"],
    up: Float[np.ndarray, " 3"],
) -> Bool[np.ndarray, " m"]:
    """(m,) unseen patches of the part's foot, where it stood on a bed while it was scanned.

    Nobody sees what a part stands on: of its lowest surface next to nothing was. That hole is
    the largest of such a scan, and says nothing: what broke looks out of the others.

    Parameters
    ----------
    patch_mm, patch_mm2
        The template's surface: places, and outward normals times area.
    present
        Which of it was seen.
    up
        Unit vector away from the bed.
    """
    if len(patch_mm) == 0:
        return np.zeros(0, dtype=bool)
    area_mm2 = np.linalg.norm(patch_mm2, axis=1)
    height_mm = patch_mm @ up
    foot = (height_mm < height_mm.min() + FOOT_MM) & (patch_mm2 @ up < FOOT_COSINE * area_mm2)
    seen_mm2 = area_mm2[foot & present].sum()
    if seen_mm2 >= SEEN_OF_FOOT * area_mm2[foot].sum():
        return np.zeros(len(patch_mm), dtype=bool)
    return np.asarray(foot & ~present)


def spoken_of(
    template: Template,
    hole_mm: Float[np.ndarray, "h 3"],
    face_mm: Float[np.ndarray, "q 3"],
    normal: Float[np.ndarray, "q 3"],
    *,
    spacing_mm: float,
) -> tuple[Bool[np.ndarray, " h"], Bool[np.ndarray, " h"]]:
    """(h,) patches of holes that a broken face touches or looks out of; and the very place there.

    Parameters
    ----------
    hole_mm
        Places on the template's surface that no point of the scan lies on.
    face_mm, normal
        Broken faces, and their outward unit normals.
    spacing_mm
        Of the scan.
    """
    from amrepair.field.groups import group_points

    if len(hole_mm) == 0 or len(face_mm) == 0:
        return np.zeros(len(hole_mm), dtype=bool), np.zeros(len(hole_mm), dtype=bool)
    hole = group_points(hole_mm, reach_mm=max(HOLE_MM, 2.0 * spacing_mm))
    reach_mm = max(RIM_MM, 3.0 * spacing_mm)
    some = slice(None, None, max(1, len(face_mm) // LOOKING))
    out = _ways_out(template, face_mm[some], normal[some])
    seen = np.concatenate([face_mm, out])
    distance, nearest = cKDTree(hole_mm).query(seen, distance_upper_bound=reach_mm, workers=2)
    spoken = np.isin(hole, np.unique(hole[nearest[np.isfinite(distance)]]))
    looked_at = cKDTree(out).query(hole_mm, distance_upper_bound=HOLE_MM, workers=2)[0]
    return spoken, np.isfinite(looked_at)


def is_backed(
    template: Template,
    hole_mm: Float[np.ndarray, "h 3"],
    outward: Float[np.ndarray, "h 3"],
    *,
    seen_mm: Float[np.ndarray, "m 3"],
    face_mm: Float[np.ndarray, "q 3"],
    spacing_mm: float,
) -> Bool[np.ndarray, " h"]:
    """(h,) patches of holes straight behind which stands surface that was seen, nothing between.

    What a view sees of a wall's front stands; that nobody saw its back says nothing about it.

    Parameters
    ----------
    hole_mm, outward
        Places on the template's surface that no point lies on, and unit normals.
    seen_mm
        Places on it that were seen.
    face_mm
        Broken faces.
    """
    backed = np.zeros(len(hole_mm), dtype=bool)
    if len(hole_mm) == 0 or len(seen_mm) == 0 or len(face_mm) == 0:
        return backed
    seen, faces = cKDTree(seen_mm), cKDTree(face_mm)
    near_mm = max(LOOK_MM, 2.0 * spacing_mm)
    left = np.arange(len(hole_mm))
    reach_mm = float(np.linalg.norm(np.ptp(template.bounds_mm, axis=0)))
    for step in range(1, int(reach_mm / LOOK_MM) + 2):
        front = hole_mm[left] - step * LOOK_MM * outward[left]
        out = template.distance(front) >= 0
        backed[left[out]] = np.isfinite(
            seen.query(front[out], distance_upper_bound=near_mm, workers=2)[0]
        )
        broken = np.isfinite(faces.query(front, distance_upper_bound=near_mm, workers=2)[0])
        left = left[~out & ~broken]
        if len(left) == 0:
            break
    return backed


def is_lined(
    hole_mm: Float[np.ndarray, "h 3"],
    seen_mm: Float[np.ndarray, "m 3"],
    face_mm: Float[np.ndarray, "q 3"],
    *,
    spacing_mm: float,
) -> bool:
    """Whether broken faces run along most of where holes meet surface that was seen.

    Where material is gone there is a break between what stands and what does not; where nobody
    looked there is none. A view from above leaves all walls open, and they cancel in `is_closed`.

    Parameters
    ----------
    hole_mm, seen_mm
        Places on the template's surface that no point lies on, and that were seen.
    face_mm
        Broken faces.
    spacing_mm
        Of the scan.
    """
    if len(hole_mm) == 0 or len(seen_mm) == 0 or len(face_mm) == 0:
        return True
    reach_mm = max(RIM_MM, 3.0 * spacing_mm)
    rim_mm = hole_mm[has_near(hole_mm, seen_mm, reach_mm)]
    return len(rim_mm) == 0 or bool(has_near(rim_mm, face_mm, 2.0 * reach_mm).mean() >= LINED_RATIO)


def is_closed(
    seen_mm2: Float[np.ndarray, " 3"],
    whole_mm2: Float[np.ndarray, " 3"],
    faces_mm2: Float[np.ndarray, "q 3"],
) -> bool:
    """Whether broken faces close what was seen of the template, all its holes being gone.

    The vector areas of a closed surface add up to nothing; those of a view do not.

    Parameters
    ----------
    seen_mm2, whole_mm2
        Vector area of the template's surface that stands for sure, and of all of it.
    faces_mm2
        Of each broken face.
    """
    broken_mm2 = faces_mm2.sum(axis=0)
    all_gone_mm2 = float(np.linalg.norm(seen_mm2 + broken_mm2))
    none_gone_mm2 = float(np.linalg.norm(whole_mm2 + broken_mm2))
    slack_mm2 = OPEN_RATIO * float(np.linalg.norm(faces_mm2, axis=1).sum())
    return all_gone_mm2 <= max(none_gone_mm2, slack_mm2)


def _ways_out(
    template: Template, face_mm: Float[np.ndarray, "q 3"], normal: Float[np.ndarray, "q 3"]
) -> Float[np.ndarray, "e 3"]:
    """Where lines from faces along their normals first leave the template."""
    front, along = face_mm, normal
    out = []
    reach_mm = float(np.linalg.norm(np.ptp(template.bounds_mm, axis=0)))
    for _ in range(int(reach_mm / LOOK_MM) + 1):
        front = front + LOOK_MM * along
        f_mm = template.distance(front)
        out.append(front[f_mm >= 0] - f_mm[f_mm >= 0, None] * along[f_mm >= 0])
        front, along = front[f_mm < 0], along[f_mm < 0]
        if len(front) == 0:
            break
    return np.concatenate(out)
