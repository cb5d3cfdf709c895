"""Poses along a motion that a scan hardly hinders: steps to both sides, and once all around.

On a disc with a notch nearly every turn fits nearly; the one that fits is narrower than any search
over all rotations is dense. So where a pose can turn freely, it is turned all the way round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.align.options import FamilyOptions
from amrepair.align.refine import Refined
from amrepair.align.search import CoarseField, misfits_mm
from amrepair.align.thinning import in_order, thin_out
from amrepair.arrays import Matrix, Points, Vector
from amrepair.frames import moved, rigid, rotation_from_vector
from amrepair.template.port import Template


@dataclass(frozen=True, slots=True)
class Motion:
    """A rigid motion that changes the fit hardly.

    Attributes
    ----------
    turn, shift
        (3,) each, template frame, about and of the cloud's centroid; the cloud's farthest point
        moves by about 1 mm.
    """

    turn: Vector
    shift: Vector

    def applied(self, matrix: Matrix, centre_mm: Vector, step_mm: float) -> Matrix:
        """(4, 4) the pose after a small step."""
        place = matrix[:3, :3] @ centre_mm + matrix[:3, 3]
        turned = rotation_from_vector(step_mm * self.turn) @ matrix[:3, :3]
        return rigid(turned, place + step_mm * self.shift - turned @ centre_mm)


def motions(pose: Refined, cloud_mm: Points) -> tuple[Float[np.ndarray, " 6"], list[Motion]]:
    """(6,) how much each motion is hindered (Σ f² / σ² after a step of 1 mm), and the motions."""
    centre = cloud_mm.mean(axis=0)
    reach_mm = float(np.linalg.norm(cloud_mm - centre, axis=1).max())
    # Rotations are measured by the motion of the farthest point.
    unit = np.array([1.0 / reach_mm] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(pose.information * np.outer(unit, unit))
    return values, [Motion(unit[:3] * one[:3], one[3:]) for one in vectors.T]


def slides(pose: Refined, cloud_mm: Points, step_mm: float) -> list[Matrix]:
    """A step along every motion that leaves the residuals within the noise, both ways."""
    centre = cloud_mm.mean(axis=0)
    return [
        motion.applied(pose.matrix, centre, way * step_mm)
        for value, motion in zip(*motions(pose, cloud_mm), strict=True)
        if value * step_mm**2 <= len(cloud_mm)
        for way in (1.0, -1.0)
    ]


def best_turns(
    poses: Sequence[Refined],
    judged_mm: Points,
    template: Template,
    field: CoarseField,
    *,
    diagonal_mm: float,
    sigma_mm: float,
    cap_mm: float,
    off_mm: float,
    options: FamilyOptions,
    rng: np.random.Generator,
) -> list[Matrix]:
    """The best poses of each family: those that turn freely, turned once around.

    Parameters
    ----------
    poses
        Best first, refined on the points in `judged_mm`.
    judged_mm
        (n, 3) in the scan's frame.
    field
        The template's: where around the circle it is worth asking.
    diagonal_mm
        Of the template.
    sigma_mm
        That the poses' information was made with.
    cap_mm
        Farther off is as bad.
    off_mm
        Points farther off lie off the part for certain.
    """
    step_mm = options.step_ratio * diagonal_mm
    cloud = in_order(thin_out(judged_mm, options.swept_points, rng))
    known: list[Float[np.ndarray, "k 4 4"]] = []
    found: list[Matrix] = []
    for pose in poses:
        if len(known) == options.most_families:
            break
        within_mm = options.same_steps * step_mm
        if any(_among(pose.matrix, family, cloud, within_mm) for family in known):
            continue
        for value, motion in zip(*motions(pose, judged_mm), strict=True):
            share = value * sigma_mm**2 / len(judged_mm)
            family = _turned(pose.matrix, motion, judged_mm, share, diagonal_mm, options)
            if family is None:
                continue
            known.append(family)
            # A feature that decides is small: where it is seen, its points lie off this pose.
            off = judged_mm[np.abs(pose.residual_mm) > off_mm]
            for judges in (cloud, off[:: len(off) // options.swept_points + 1]):
                if len(judges) >= options.least_judges:
                    found += _best_of(family, judges, template, field, cap_mm, options)
    return found


def _best_of(
    family: Float[np.ndarray, "k 4 4"],
    judges_mm: Points,
    template: Template,
    field: CoarseField,
    cap_mm: float,
    options: FamilyOptions,
) -> list[Matrix]:
    """The best poses of a family but for its first, which is known."""
    few = judges_mm[:: len(judges_mm) // options.coarse_points + 1]
    dips = _lowest(misfits_mm(few, family, field, cap_mm))
    asked = [family[k] for k in dips[: options.most_asked] if k > 0]
    scores = np.array([_score(judges_mm, one, template, cap_mm) for one in asked])
    return [asked[k] for k in np.argsort(scores, kind="stable")[: options.best_of_each]]


def _turned(
    matrix: Matrix,
    motion: Motion,
    cloud_mm: Points,
    share: float,
    diagonal_mm: float,
    options: FamilyOptions,
) -> Float[np.ndarray, "k 4 4"] | None:
    """(k, 4, 4) the pose turned around the motion's axis; None where that is hindered.

    `share` is of the points that resist, were all of them moved by as much as the farthest.
    """
    rate = float(np.linalg.norm(motion.turn))
    # The radius is at most the diagonal.
    if rate < 1e-9 or share > options.most_resisting * (rate * diagonal_mm) ** 2:
        return None
    axis = motion.turn / rate
    centre = matrix[:3, :3] @ cloud_mm.mean(axis=0) + matrix[:3, 3]
    through = centre + np.cross(axis, motion.shift) / rate
    few = cloud_mm[:: len(cloud_mm) // options.radius_points + 1]  # a radius needs no more
    away = moved(few, matrix) - through
    radius_mm = float(np.linalg.norm(away - np.outer(away @ axis, axis), axis=1).max())
    in_part = options.least_radius_ratio * diagonal_mm < radius_mm < diagonal_mm
    if not in_part or share > options.most_resisting * (rate * radius_mm) ** 2:
        return None
    count = int(np.ceil(2.0 * np.pi * radius_mm / (options.step_ratio * diagonal_mm)))
    angles = 2.0 * np.pi * np.arange(count)[:, None, None] / count
    along, across = np.outer(axis, axis), np.cross(axis, np.eye(3)).T
    turns = np.cos(angles) * (np.eye(3) - along) + np.sin(angles) * across + along  # Rodrigues
    family = np.tile(np.eye(4), (count, 1, 1))
    family[:, :3, :3] = turns @ matrix[:3, :3]
    family[:, :3, 3] = turns @ (matrix[:3, 3] - through) + through
    return family


def _among(
    matrix: Matrix, family: Float[np.ndarray, "k 4 4"], cloud_mm: Points, within_mm: float
) -> bool:
    few = cloud_mm[:: max(1, len(cloud_mm) // 50)]
    placed = moved(few, matrix)
    others = few @ np.swapaxes(family[:, :3, :3], 1, 2) + family[:, None, :3, 3]
    return bool(np.linalg.norm(others - placed, axis=2).max(axis=1).min() < within_mm)


def _score(cloud_mm: Points, matrix: Matrix, template: Template, cap_mm: float) -> float:
    residual = np.abs(template.distance(moved(cloud_mm, matrix)))
    return float(np.minimum(residual, cap_mm).mean())


def _lowest(scores: Float[np.ndarray, " k"]) -> list[int]:
    """The local minima around the circle, deepest first."""
    dips = (scores <= np.roll(scores, 1)) & (scores < np.roll(scores, -1))
    order = np.flatnonzero(dips)
    return [int(k) for k in order[np.argsort(scores[order], kind="stable")]]
