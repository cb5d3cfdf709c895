"""How pose, scale, bow and the views' offsets move a surface along its normal, and their priors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import helmert

from amrepair.arrays import Points

BOWS = ((0, 1), (0, 2), (1, 2))  # (along, towards): a long axis bends towards a shorter one
SCALE_AT, BOW_AT, VIEWS_AT = 6, 7, 11  # pose 0:6, bends 7:10, twist 10, views from 11 on
EXTENT_PERCENT = (1.0, 99.0)  # fliers do not lengthen the part
THIN_RATIO = 1e-6  # what is thinner than this part of its length is a line or a point


@dataclass(frozen=True, slots=True)
class NuisanceOptions:
    """Priors: standard deviations of what a normal part and a normal scan leave.

    Attributes
    ----------
    pose_translation_sigma_mm, pose_rotation_sigma_rad
        What an alignment leaves: single range images are laid within 0.30 mm, which is two
        standard deviations; the rotation moves a surface 50 mm off by as much.
    scale_sigma_ratio
        0.3 %: how far the shrinkage of PLA and PETG lies from part to part and from what a
        slicer's own setting allows for.
    bow_sigma_mm
        Half the flatness that ISO 2768-2, class H, allows at 100 to 300 mm (0.2 mm).
    view_offset_sigma_mm
        Between views: half of 0.1 to 0.3 mm, which views of a turntable scanner differ by.
    common_offset_sigma_mm
        Of all views together: a line laser's own bias after calibration. It is small, so that
        what all views say of a round part is its size.
    told_sigma
        What lies beyond this many standard deviations of its prior is told.
    support_p
        A term whose evidence is weaker than this probability under chance stays zero.
    """

    pose_translation_sigma_mm: float = 0.15
    pose_rotation_sigma_rad: float = 0.003
    scale_sigma_ratio: float = 0.003
    bow_sigma_mm: float = 0.1
    view_offset_sigma_mm: float = 0.1
    common_offset_sigma_mm: float = 0.02
    told_sigma: float = 2.0
    support_p: float = 0.01


DEFAULT_NUISANCE = NuisanceOptions()
"""What every fit goes by."""


@dataclass(frozen=True, slots=True)
class Frame:
    """Centre, principal axes (rows, the longest first) and half extents of what was seen."""

    centre_mm: Float[np.ndarray, " 3"]
    axes: Float[np.ndarray, "3 3"]
    half_extent_mm: Float[np.ndarray, " 3"]

    @classmethod
    def of(cls, place_mm: Points) -> Frame:
        """Return the frame of places that cover the surface evenly."""
        centre_mm = place_mm.mean(axis=0)
        axes = np.linalg.eigh(np.cov((place_mm - centre_mm).T, bias=True))[1].T[::-1]
        largest = np.argmax(np.abs(axes), axis=1)
        axes = axes * np.sign(axes[np.arange(3), largest])[:, None]
        along = (place_mm - centre_mm) @ axes.T
        low, high = np.percentile(along, EXTENT_PERCENT, axis=0)
        extent_mm = (high - low) / (np.ptp(EXTENT_PERCENT) / 100)
        extent_mm = np.minimum(extent_mm, np.ptp(along, axis=0))
        order = np.argsort(-extent_mm, kind="stable")
        return cls(centre_mm, axes[order], extent_mm[order] / 2)


def shape_columns(place_mm: Points, normal: Points, frame: Frame) -> Float[np.ndarray, "n 11"]:
    """How pose, scale and bow move each place along its normal.

    A bend along i towards j by the sag a moves a body by a xi²/hi² along j and, since sections
    stay square to the bent axis (pure bending), by −2 a xi xj/hi² along i; the twist of the plane
    of 1 and 2 by a moves it by a x1 x2/(h1 h2) along 3, −a x2 x3/(h1 h2) along 1 and
    −a x1 x3/(h1 h2) along 2.
    """
    off = place_mm - frame.centre_mm
    x, n = off @ frame.axes.T, normal @ frame.axes.T
    h = _lengths_mm(frame)
    rotation = np.cross(off, normal)  # n·(ω × x) = ω·(x × n)
    scale = np.sum(off * normal, axis=1)
    bends = [x[:, i] * (x[:, i] * n[:, j] - 2 * x[:, j] * n[:, i]) / h[i] ** 2 for i, j in BOWS]
    twist = x[:, 0] * x[:, 1] * n[:, 2] - x[:, 2] * (x[:, 1] * n[:, 0] + x[:, 0] * n[:, 1])
    return np.column_stack([normal, rotation, scale, *bends, twist / (h[0] * h[1])])


def bow_moves(
    place_mm: Points, frame: Frame, bow_mm: Float[np.ndarray, " 4"]
) -> Float[np.ndarray, "n 3"]:
    """(n, 3) how far a bow moves places: what `shape_columns` has of it along their normals."""
    x = (place_mm - frame.centre_mm) @ frame.axes.T
    h = _lengths_mm(frame)
    moved = np.zeros_like(x)
    for sag_mm, (i, j) in zip(bow_mm[:3], BOWS, strict=True):
        moved[:, j] += sag_mm * x[:, i] ** 2 / h[i] ** 2
        moved[:, i] -= 2 * sag_mm * x[:, i] * x[:, j] / h[i] ** 2
    twist = bow_mm[3] / (h[0] * h[1])
    moved[:, 2] += twist * x[:, 0] * x[:, 1]
    moved[:, 0] -= twist * x[:, 1] * x[:, 2]
    moved[:, 1] -= twist * x[:, 0] * x[:, 2]
    return np.asarray(moved @ frame.axes)


def _lengths_mm(frame: Frame) -> Float[np.ndarray, " 3"]:
    """Half extents that may be divided by."""
    return np.maximum(frame.half_extent_mm, THIN_RATIO * max(float(frame.half_extent_mm[0]), 1e-9))


def priors(
    half_extent_mm: Float[np.ndarray, " 3"], views: int, *, pose_known: bool = False
) -> tuple[Float[np.ndarray, "p q"], dict[str, Int[np.ndarray, " ..."]]]:
    """Return the unknowns' sizes for unknowns in units of their priors, and which are one term.

    A part bends along what is longer than it is wide: the prior of a sag goes with the square of
    its length, and towards zero where the part is as thick as it is long. Offsets of views are
    what they have in common and what they differ by, each with its own prior. Where the pose is
    known nothing is taken for it, nor for an offset of all views: what lies off as a whole is off.
    """
    options = DEFAULT_NUISANCE
    pose = [options.pose_translation_sigma_mm] * 3 + [options.pose_rotation_sigma_rad] * 3
    common_mm = options.common_offset_sigma_mm
    if pose_known:
        pose, common_mm = [0.0] * 6, 0.0
    h = half_extent_mm / max(float(half_extent_mm[0]), 1e-9)
    slender = [h[i] ** 2 * (1 - (h[j] / max(h[i], 1e-9)) ** 2) for i, j in BOWS]
    bow = options.bow_sigma_mm * np.maximum([*slender, h[1] * slender[2] / max(h[1], 1e-9)], 0.0)
    physical = np.diag(np.r_[pose, options.scale_sigma_ratio, bow, np.zeros(views)])
    terms = {"pose": np.arange(6), "scale": np.array([SCALE_AT])}
    terms |= {"bow": np.array([8, 9, 10]), "bow in plane": np.array([7])}
    if views:
        differ = options.view_offset_sigma_mm * helmert(views).T if views > 1 else np.zeros((1, 0))
        common = np.full((views, 1), common_mm)
        physical[VIEWS_AT:, VIEWS_AT:] = np.column_stack([differ, common])
        terms["common"] = np.array([VIEWS_AT + views - 1])
    if views > 1:
        terms["views"] = np.arange(VIEWS_AT, VIEWS_AT + views - 1)
    return physical, terms
