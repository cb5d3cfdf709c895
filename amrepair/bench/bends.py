"""A part bent in two: its pieces, over how much of it, and where it is bent a little.

No material is bent in a crease: from one piece to the other the part turns over a zone. There
points lie in neither pose, and some were moved along their own surface, which no distance tells.

A little bend is found by the cut beyond which another rigid motion explains more. To first order a
rigid motion of a piece changes the deviation at x by n·(t + ω × x), n the field's
gradient. So what the best motion of either side of a cut explains are sums over points, and all
cuts across an axis are judged in one pass. It finds where to look; `bodies` moves the pieces.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Matrix, Points, Values, Vector
from amrepair.bench.options import BendOptions
from amrepair.frames import diagonal, moved, unit_vectors
from amrepair.template.port import Template

CREASE_MM = 1e-6  # a narrower zone is a crease

Pose = Matrix


@dataclass(frozen=True, slots=True)
class Pieces:
    """A part in one piece, or in two that stand in poses of their own.

    Attributes
    ----------
    pose
        (4, 4) template from scan, of the piece that stands where it was.
    other
        The same of the other piece; None where there is none.
    normal, through_mm
        Of the plane between them, template frame, away from the standing one.
    zone_mm
        The part turns over so much of its length, half on either side of the plane.
    """

    pose: Pose
    other: Pose | None = None
    normal: Vector = field(default_factory=lambda: np.zeros(3))
    through_mm: Vector = field(default_factory=lambda: np.zeros(3))
    zone_mm: float = 0.0

    def moved_mm(self, points_mm: Points) -> Values:
        """(n,) how far points of the scan, in its frame, were moved with the other piece."""
        return np.asarray(np.linalg.norm(self.motion_mm(points_mm), axis=1))

    def motion_mm(self, points_mm: Points) -> Points:
        """(n, 3) by what points of the scan, in its frame, were moved; template frame.

        In an evenly bent zone a place has been turned by the share w of the angle that lies before
        it, about the middle of that: to first order by w of the whole motion, and by what the
        lines that it was turned about lie nearer to the standing piece.
        """
        if self.other is None:
            return np.zeros_like(points_mm)
        home = moved(points_mm, self.other)
        return _motion_mm(
            moved(points_mm, self.pose) - home,
            (home - self.through_mm) @ self.normal,
            self.zone_mm,
            self.turned,
        )

    @property
    def turned(self) -> Vector:
        """By what a place moves that lies 1 mm farther along the normal; nothing in one piece."""
        if self.other is None:
            return np.zeros(3)
        turn = (self.pose @ np.linalg.inv(self.other))[:3, :3]
        return np.asarray(turn @ self.normal - self.normal)


def _motion_mm(
    whole_mm: Points, height_mm: Float[np.ndarray, "*k n"], zone_mm: Any, turned: Vector
) -> Float[np.ndarray, "*k n 3"]:
    """(*k, n, 3) motions of places at some heights over the middle of a zone, k ways."""
    share = np.clip(height_mm / np.maximum(zone_mm, CREASE_MM) + 0.5, 0.0, 1.0)
    nearer_mm = 0.5 * zone_mm * share * (1.0 - share)
    return np.asarray(share[..., None] * whole_mm + nearer_mm[..., None] * turned)


def with_zone(
    pieces: Pieces,
    points_mm: Points,
    template: Template,
    *,
    limit_mm: float,
    sigma_mm: float,
    options: BendOptions,
) -> Pieces:
    """The pieces with the zone that what lies about the plane between them tells.

    Its middle and its width are means over what is likely: where the points tell nothing, no crease
    and nothing very wide.

    Parameters
    ----------
    points_mm
        (n, 3) in the scan's frame, of noise `sigma_mm`.
    limit_mm
        Farther off the template a point counts as so far off.
    """
    if pieces.other is None:
        return pieces
    diagonal_mm = diagonal(template.bounds_mm)
    widest_mm = (0.5 * options.widest_zone_ratio + options.aside_ratio) * diagonal_mm
    home = moved(points_mm, pieces.other)
    height_mm = (home - pieces.through_mm) @ pieces.normal
    near = np.flatnonzero(np.abs(height_mm) < widest_mm)
    near = near[:: len(near) // options.zone_points + 1]
    here, home, height_mm = moved(points_mm[near], pieces.pose), home[near], height_mm[near]
    lattice = np.meshgrid(options.aside_ratios, options.zone_ratios)
    aside, zone = (diagonal_mm * each.ravel() for each in lattice)
    motion = _motion_mm(here - home, height_mm - aside[:, None], zone[:, None], pieces.turned)
    off_mm = np.abs(template.distance((here - motion).reshape(-1, 3))).reshape(len(zone), -1)
    misfit = (np.minimum(off_mm, limit_mm) ** 2).sum(axis=1) / sigma_mm**2
    likely = np.exp(0.5 * (misfit.min() - misfit))
    likely /= likely.sum()
    through_mm = pieces.through_mm + float(likely @ aside) * pieces.normal
    return replace(pieces, through_mm=through_mm, zone_mm=float(likely @ zone))


@dataclass(frozen=True, slots=True)
class Cut:
    """A plane across one of the part's main axes.

    Attributes
    ----------
    gain
        By how much the motions of both sides lessen the sum of squares of the noise's standard
        deviations, beyond what one motion of all does: χ² of six degrees of freedom if nothing is
        bent.
    normal, height_mm
        Places p of the surface with p · normal < height lie on the first side.
    """

    gain: float
    normal: Vector
    height_mm: float


def best_cuts(
    points_mm: Points,
    template: Template,
    surface_mm: Float[np.ndarray, "m 3"],
    *,
    scale_mm: float,
    sigma_mm: float,
    options: BendOptions,
) -> list[Cut]:
    """The best cut across each main axis of the template's surface, the best first.

    Parameters
    ----------
    points_mm
        (n, 3) placed.
    surface_mm
        (m, 3) points of the template's surface.
    scale_mm
        Of the loss of Geman and McClure: what lies much farther off tells nothing.
    """
    f_mm, gradient = template.distance_and_gradient(points_mm)
    normals = unit_vectors(gradient)
    # by where a point is due: noise must not choose on which side of a face's own plane it is
    feet_mm = points_mm - f_mm[:, None] * normals
    local = points_mm - points_mm.mean(axis=0)
    reach_mm = float(np.linalg.norm(local, axis=1).max())
    motion = np.concatenate([np.cross(local, normals) / reach_mm, normals], axis=1)
    weight = (scale_mm**2 / (f_mm**2 + scale_mm**2)) ** 2
    products = np.concatenate(
        [
            (motion[:, :, None] * motion[:, None, :]).reshape(-1, 36) * weight[:, None],
            motion * (weight * f_mm)[:, None],
        ],
        axis=1,
    )
    explained = partial(_explained, ridge=options.ridge)
    whole = explained(products.sum(axis=0))
    middle = surface_mm - surface_mm.mean(axis=0)
    found = []
    for axis in np.linalg.eigh(middle.T @ middle)[1].T:
        height = feet_mm @ axis
        order = np.argsort(height)
        below = np.cumsum(products[order], axis=0)
        cuts = [
            Cut(
                (explained(below[i - 1]) + explained(below[-1] - below[i - 1]) - whole)
                / sigma_mm**2,
                axis,
                float(height[order[i]]),
            )
            for i in (options.cut_shares * len(height)).astype(int)
        ]
        found.append(max(cuts, key=lambda cut: cut.gain))
    return sorted(found, key=lambda cut: -cut.gain)


def _explained(sums: Float[np.ndarray, " 42"], ridge: float) -> float:
    """What the best motion takes from the sum of squares, from the sums of a side."""
    matrix, right = sums[:36].reshape(6, 6), sums[36:]
    matrix = matrix + ridge * max(float(np.trace(matrix)), 1e-12) * np.eye(6)
    return float(right @ np.linalg.solve(matrix, right))
