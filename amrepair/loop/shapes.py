"""Shapes of regions and ways of beads: how long, how wide, along what."""

from __future__ import annotations

import manifold3d
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from amrepair.arrays import Box, Mask, PlanePoints, Points
from gcode.reader import Job
from gcode.stretches import in_turn, places_along

CHAIN_MM = 4.0
"""Pieces nearer than this are one thing that noise has cut."""
BEAD_STEP_MM = 0.6
FINEST_STEP_MM = 0.05


def chain(
    piece: manifold3d.Manifold | None, pieces: list[manifold3d.Manifold]
) -> list[manifold3d.Manifold]:
    """A piece and all that lie near it, one after another: noise cuts a string to pieces."""
    if piece is None:
        return []
    boxes = np.array([one.bounding_box() for one in pieces]).reshape(-1, 2, 3)
    inside = np.array([one is piece for one in pieces])
    while True:
        gap = np.array([
            [np.maximum(np.maximum(a[0] - b[1], b[0] - a[1]), 0.0).max() for b in boxes[inside]]
            for a in boxes
        ]).min(axis=1)  # fmt: skip
        grown = gap < CHAIN_MM
        if (grown == inside).all():
            return [one for one, mine in zip(pieces, inside, strict=True) if mine]
        inside = grown


def tall_mm(pieces: list[manifold3d.Manifold]) -> float:
    """From the lowest to the highest point of some pieces."""
    boxes = np.array([piece.bounding_box() for piece in pieces]).reshape(-1, 2, 3)
    return float(boxes[:, 1, 2].max() - boxes[:, 0, 2].min()) if len(boxes) else 0.0


def spread(
    pieces: list[manifold3d.Manifold],
) -> tuple[float, float, Float[np.ndarray, " 2"]]:
    """Length and width of some pieces seen from above, mm, and their long direction."""
    if not pieces:
        return 1.0, 1.0, np.array([1.0, 0.0])
    areas = [piece.project() for piece in pieces]
    rings = [np.asarray(ring, dtype=np.float64) for area in areas for ring in area.to_polygons()]
    corners = np.concatenate([_dense(ring) for ring in rings])
    middle = corners.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((corners - middle).T))
    across, along = axes[:, 0], axes[:, 1]
    long_mm = float(np.ptp(corners @ along))
    # as wide as its area says: noise makes fringes
    area_mm2 = sum(float(area.area()) for area in areas)
    wide_mm = min(float(np.ptp(corners @ across)), 1.2 * area_mm2 / max(long_mm, 1e-6))
    return long_mm, max(wide_mm, 1e-6), along


def _dense(ring: PlanePoints) -> Float[np.ndarray, "m 2"]:
    """A ring's outline in even steps: corners alone would weigh fringes."""
    ends = np.roll(ring, -1, axis=0)
    length = np.linalg.norm(ends - ring, axis=1)
    count = np.maximum(1, np.ceil(length / 0.1).astype(np.int64))
    owner, step = in_turn(count)
    return np.asarray(ring[owner] + (ends - ring)[owner] * (step / count[owner])[:, None])


def bead_way(job: Job, line: int, box_mm: Box) -> Float[np.ndarray, " 2"] | None:
    """The direction of most of the last layer's beads over a box."""
    beads = job.beads
    done = beads.line < line
    if not done.any():
        return None
    pick = done & (beads.layer == beads.layer[done].max())
    step = (beads.end_mm - beads.start_mm)[pick, :2]
    middle = 0.5 * (beads.end_mm + beads.start_mm)[pick, :2]
    length = np.linalg.norm(step, axis=1)
    over = ((middle + 0.5 * np.abs(step) >= box_mm[0, :2])
            & (middle - 0.5 * np.abs(step) <= box_mm[1, :2])).all(axis=1)  # fmt: skip
    if not (over & (length > 0.5)).any():
        return None
    way, weight = step[over], length[over]
    angle = np.arctan2(way[:, 1], way[:, 0])
    mean = 0.5 * np.angle((weight * np.exp(2j * angle)).sum())
    return np.array([np.cos(mean), np.sin(mean)])


def last_beads(job: Job, line: int) -> Points:
    """Places along the beads of the last layer before a line, as printed."""
    pick = _of_last_layer(job, line)
    return places_along(job.beads.start_mm[pick], job.beads.end_mm[pick], BEAD_STEP_MM)[0]


def over_last_beads(
    points_mm: Points, job: Job, line: int, *, share: float
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Which points lie over the middle of the last layer's beads, and how far above their path.

    Parameters
    ----------
    points_mm
        (n, 3) in the build frame.
    share
        Of a bead's width, from its path to either side.
    """
    beads, pick = job.beads, _of_last_layer(job, line)
    width_mm = beads.width_mm[pick]
    if not pick.any() or not len(points_mm):
        return np.zeros(0, np.int64), np.zeros(0)
    within_mm = share * width_mm
    place_mm, owner = places_along(
        beads.start_mm[pick], beads.end_mm[pick], max(float(within_mm.min()), FINEST_STEP_MM)
    )
    away_mm, nearest = cKDTree(place_mm[:, :2]).query(
        points_mm[:, :2], distance_upper_bound=float(within_mm.max())
    )
    near = np.flatnonzero(np.isfinite(away_mm))
    near = near[away_mm[near] <= within_mm[owner[nearest[near]]]]
    return near, points_mm[near, 2] - place_mm[nearest[near], 2]


def _of_last_layer(job: Job, line: int) -> Mask:
    """The beads of the last layer before a line; none where none is of a layer yet."""
    beads = job.beads
    done = (beads.line < line) & (beads.layer >= 0)
    return done & (beads.layer == beads.layer[done].max(initial=-1))
