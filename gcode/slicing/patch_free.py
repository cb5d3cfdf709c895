"""Beads where the nozzle may be: moved aside a little, and cut where it may not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from gcode.slicing import reach_kernels
from gcode.slicing.beads import Bead, divided
from gcode.slicing.reach import Reach
from gcode.stretches import stretches_of

GAP_STEP_MM = 0.4  # along a bead, between two samples of the gap
LEAST_RUN_MM = 0.4
# A point that is not free is moved by no more than this; stretches between points that are free,
# and are not so themselves, are halved so often.
ASIDE_MM, HALVINGS = 0.15, 2
ROUNDING_MM = 2e-3  # more than the text's last digit
ROUNDED_CORNERS_MM = ROUNDING_MM * np.array(
    [[-1, -1], [-1, 1], [1, -1], [1, 1]]
)  # whichever way it goes


def eased(beads: list[Bead], free: Bool[np.ndarray, "ry rx"], reach: Reach) -> list[Bead]:
    """Beads moved a little aside wherever that brings them to where the nozzle may be.

    Lines are drawn along rounded outlines of cells; dropped where they leave the cells themselves,
    they would end at every corner.
    """
    if not beads:
        return beads
    walked = [divided(bead.xy_mm, steps_of(bead))[0] for bead in beads]
    starts, ends = (np.concatenate([xy[k] for xy in walked]) for k in (slice(-1), slice(1, None)))
    ok = np.split(
        free_between(starts, ends, free, reach), np.cumsum([len(xy) - 1 for xy in walked])[:-1]
    )
    if all(each.all() for each in ok):
        return beads
    nearest = _Nearest(np.concatenate(walked), free, reach)
    return [
        bead if each.all() else _eased(bead, nearest, free, reach)
        for bead, each in zip(beads, ok, strict=True)
    ]


def _eased(bead: Bead, nearest: _Nearest, free: Bool[np.ndarray, "ry rx"], reach: Reach) -> Bead:
    xy, owner = divided(bead.xy_mm, steps_of(bead))
    xy, share = nearest.moved(xy), bead.share_mm[owner]
    for _ in range(HALVINGS):
        stuck = np.flatnonzero(~free_between(xy[:-1], xy[1:], free, reach))
        if not len(stuck):
            break
        middles = nearest.moved(0.5 * (xy[stuck] + xy[stuck + 1]))
        xy, share = np.insert(xy, stuck + 1, middles, axis=0), np.insert(share, stuck, share[stuck])
    return Bead(xy, share, bead.role, bead.closed)


class _Nearest:
    """The cells where the tip may be that are nearest to places where it may not.

    Parameters
    ----------
    points_mm
        All that will be asked about lies in their box.
    """

    def __init__(
        self, points_mm: Float[np.ndarray, "n 2"], free: Bool[np.ndarray, "ry rx"], reach: Reach
    ) -> None:
        self._free, self._reach = free, reach
        margin = int(np.ceil(ASIDE_MM / reach.cell_mm)) + 1
        at = (points_mm - reach.field.origin_mm) / reach.cell_mm
        first = np.maximum(np.floor(at.min(axis=0)).astype(np.int64) - margin, 0)
        last = np.maximum(np.ceil(at.max(axis=0)).astype(np.int64) + margin, 0)
        near = free[first[1] : last[1], first[0] : last[0]]
        self._corner_mm = reach.field.origin_mm + first * reach.cell_mm
        self._index = None
        if near.any() and not near.all():
            self._index = ndimage.distance_transform_edt(
                ~near, return_distances=False, return_indices=True
            )

    def moved(self, points_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Points; those that are not free in the middle of the nearest free cell, if it is near."""
        stuck = np.flatnonzero(~surely_free(points_mm, self._free, self._reach))
        if self._index is None or not len(stuck):
            return points_mm
        cell_mm = self._reach.cell_mm
        cell = np.floor((points_mm[stuck] - self._corner_mm) / cell_mm).astype(np.int64)
        cell = np.clip(cell, 0, np.array(self._index.shape[:0:-1]) - 1)
        to = self._index[::-1, cell[:, 1], cell[:, 0]].T
        to_mm = (to + 0.5) * cell_mm + self._corner_mm
        near = np.hypot(*(to_mm - points_mm[stuck]).T) <= ASIDE_MM
        moved_mm = points_mm.copy()
        moved_mm[stuck[near]] = to_mm[near]
        return moved_mm


def free_runs(
    bead: Bead,
    is_free: Callable[[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]], Bool[np.ndarray, " m"]],
) -> list[Bead]:
    """The stretches of a bead along which the nozzle may be; asked from point to point."""
    lengths = np.hypot(*np.diff(bead.xy_mm, axis=0).T)
    count = steps_of(bead)
    points, owner = divided(bead.xy_mm, count)
    ok = is_free(points[:-1], points[1:])
    pieces_mm = (lengths / count)[owner]
    return [
        Bead(
            points[a : b + 1],
            np.ones(b - a),
            bead.role,
            closed=bool(bead.closed and b - a == len(owner)),
        )
        for a, b in stretches_of(ok)
        if pieces_mm[a:b].sum() >= LEAST_RUN_MM
    ]


def steps_of(bead: Bead) -> Int[np.ndarray, " m"]:
    """How many steps each of a bead's pieces takes."""
    lengths = np.hypot(*np.diff(bead.xy_mm, axis=0).T)
    return np.maximum(1, np.ceil(lengths / GAP_STEP_MM).astype(np.int64))


def free_between(
    start_mm: Float[np.ndarray, "m 2"],
    end_mm: Float[np.ndarray, "m 2"],
    free: Bool[np.ndarray, "_ry _rx"],
    reach: Reach,
) -> Bool[np.ndarray, " m"]:
    """Whether the nozzle may be all the way from one point to the next, at one height."""
    return _free_along(start_mm, end_mm, shares_of_step(reach), free, reach)


def _free_along(
    start_mm: Float[np.ndarray, "m 2"],
    end_mm: Float[np.ndarray, "m 2"],
    shares: Float[np.ndarray, " k"],
    free: Bool[np.ndarray, "_ry _rx"],
    reach: Reach,
) -> Bool[np.ndarray, " m"]:
    start_mm, end_mm = (np.ascontiguousarray(xy, dtype=np.float64) for xy in (start_mm, end_mm))
    corner_mm = np.asarray(reach.field.origin_mm, dtype=np.float64)
    return np.asarray(
        reach_kernels.free_along(
            start_mm, end_mm, shares, np.ascontiguousarray(free), corner_mm, reach.cell_mm,
            ROUNDING_MM,
        )
    )  # fmt: skip


def shares_of_step(reach: Reach) -> Float[np.ndarray, " k"]:
    """Where between two samples to look: closer than the checker's own steps of half a cell."""
    return np.linspace(0.0, 1.0, 2 + int(np.ceil(3 * GAP_STEP_MM / reach.field.cell_mm)))


def surely_free(
    points_mm: Float[np.ndarray, "n 2"], free: Bool[np.ndarray, "_ry _rx"], reach: Reach
) -> Bool[np.ndarray, " n"]:
    """Whether the nozzle may be there, whichever way the text's last digit is rounded."""
    return _free_along(points_mm, points_mm, np.zeros(1), free, reach)


def beside(
    what: Bool[np.ndarray, "ny nx"],
    asked: Bool[np.ndarray, "ny nx"],
    within_mm: float,
    cell_mm: float,
) -> Bool[np.ndarray, "ny nx"]:
    """Which columns lie within a distance of others; found for those asked about at least."""
    near = np.zeros_like(what)
    if not asked.any():
        return near
    margin = int(np.ceil(within_mm / cell_mm)) + 1
    rows, columns = (
        slice(max(int(at.min()) - margin, 0), int(at.max()) + margin + 1) for at in asked.nonzero()
    )
    apart = ndimage.distance_transform_edt(~what[rows, columns])
    near[rows, columns] = apart * cell_mm <= within_mm + 1e-9
    return near
