"""Beads in the middle of what they fill, as far as the nozzle may go there.

Lines are drawn at set distances from rims, and each column then goes to the nearest one. A line
that lies nearer to the rim than to the next line is given more to fill on one side than on the
other, but a bead spreads as far to both: over the rim, and not up to the next line.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from gcode.slicing.beads import Bead
from gcode.slicing.patch_free import ASIDE_MM, HALVINGS

PlanarPoints = Float[np.ndarray, "_m 2"]
FreeBetween = Callable[[PlanarPoints, PlanarPoints], Bool[np.ndarray, " _m"]]


def in_the_middle(
    run: Bead, off_mm: Float[np.ndarray, " m"], free: FreeBetween
) -> Float[np.ndarray, "n 2"]:
    """The points of a run, moved so that its pieces lie in the middle of what they fill.

    Parameters
    ----------
    off_mm
        How far to the left of each piece the middle of its columns lies: means over three pieces
        are taken, since which of two pieces a column goes to is chance.
    free
        Whether the nozzle may go straight from some points to others. Points stay where they are
        if it may not go past them once they are moved.
    """
    mode = "wrap" if run.closed else "nearest"
    by_mm = off_mm[:, None] * left_of(run.xy_mm)
    by_mm = ndimage.uniform_filter1d(by_mm, min(3, len(by_mm)), axis=0, mode=mode)
    # what is before the first point and after the last one
    ends = (by_mm[-1:], by_mm[:1]) if run.closed else (by_mm[:1], by_mm[-1:])
    by_mm = 0.5 * (np.concatenate([ends[0], by_mm]) + np.concatenate([by_mm, ends[1]]))
    by_mm *= np.minimum(1.0, ASIDE_MM / np.maximum(np.hypot(*by_mm.T), 1e-9))[:, None]
    for _ in range(HALVINGS):
        xy_mm = run.xy_mm + by_mm
        stuck = ~free(xy_mm[:-1], xy_mm[1:])
        if not stuck.any():
            return xy_mm
        held = np.append(stuck, False) | np.append(False, stuck)
        if run.closed:
            held[[0, -1]] = held[0] | held[-1]
        by_mm[held] = 0.0
    xy_mm = run.xy_mm + by_mm
    return xy_mm if free(xy_mm[:-1], xy_mm[1:]).all() else run.xy_mm


def left_of(xy_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """(n-1, 2) unit directions to the left of each piece of a line."""
    along = np.diff(xy_mm, axis=0)
    length_mm = np.maximum(np.hypot(*along.T), 1e-9)
    return np.stack([-along[:, 1], along[:, 0]], axis=1) / length_mm[:, None]


def turn_rad(run: Bead) -> Float[np.ndarray, " m"]:
    """How far to its left a line turns over each piece: by half of what it turns at both ends."""
    way = np.diff(run.xy_mm, axis=0)
    if run.closed:
        way = np.concatenate([way[-1:], way, way[:1]])
    (ax, ay), (bx, by) = way[:-1].T, way[1:].T
    at_points = np.arctan2(ax * by - ay * bx, ax * bx + ay * by)
    if not run.closed:
        at_points = np.concatenate([[0.0], at_points, [0.0]])
    return np.asarray(0.5 * (at_points[:-1] + at_points[1:]))
