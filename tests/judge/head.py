"""The judge's own tool head: discs and boxes at heights over the tip, and where it can go."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import ndimage


@dataclass(frozen=True)
class HeadSlice:
    """What the head covers from a height over the tip upward: a disc, or a box around the bore.

    Or a cone, from `radius_mm` to `radius_to_mm` at `to_mm` above the tip.
    """

    above_mm: float
    radius_mm: float = 0.0
    box_mm: tuple[float, float, float, float] | None = None
    radius_to_mm: float = 0.0
    to_mm: float = 0.0


# An E3D V6 nozzle of 0.4 mm (1 mm flat, cone, 7 mm hexagon across the flats), its block, and the
# fan duct of a Prusa MK3S, off the published drawings; the extruder over them as Cura's definition
# of the machine has it, from the height on that PrusaSlicer keeps clear of other parts.
MK3S_HEAD = (
    HeadSlice(0.0, radius_mm=0.5),
    HeadSlice(0.0, radius_mm=0.5, radius_to_mm=2.5, to_mm=2.0),
    HeadSlice(2.0, radius_mm=4.2),
    HeadSlice(4.5, box_mm=(-9.0, -18.0, 14.0, 9.0)),
    HeadSlice(6.0, box_mm=(-24.0, -32.0, 24.0, 22.0)),
    HeadSlice(20.0, box_mm=(-31.0, -40.0, 34.0, 31.0)),
)
_V6 = MK3S_HEAD[:3]
# The same nozzle under other bodies: a heater block of 20×16 mm in its sock, ducts that end 6 mm
# over the tip, and carriages about as large as slicers have them. Not checked against drawings:
# they tell whether a body decides, not what these machines exactly reach.
_BLOCK = (
    HeadSlice(4.5, box_mm=(-12.0, -18.0, 16.0, 12.0)),
    HeadSlice(6.0, box_mm=(-26.0, -32.0, 30.0, 30.0)),
)
ENDER_HEAD = (*_V6, *_BLOCK, HeadSlice(25.0, box_mm=(-26.0, -32.0, 32.0, 34.0)))
VORON_HEAD = (*_V6, *_BLOCK, HeadSlice(30.0, box_mm=(-40.0, -70.0, 40.0, 80.0)))
HEADS = {
    "prusa_mk3s": MK3S_HEAD,
    "ender_3": ENDER_HEAD,
    "creality_k1": ENDER_HEAD,
    "voron_2_4": VORON_HEAD,
}


def grown(tops_mm: np.ndarray, cell_mm: float, part: HeadSlice) -> np.ndarray:
    """Highest thing under a slice of the head, by the column that the bore is over.

    What is under a cone counts as much lower as the cone is higher there.
    """
    if part.box_mm is not None:
        x0, y0, x1, y1 = (v / cell_mm for v in part.box_mm)
        size = (int(x1 - x0) | 1, int(y1 - y0) | 1)
        middle = (round((x0 + x1) / 2), round((y0 + y1) / 2))
        wide = ndimage.maximum_filter(tops_mm, size, mode="constant")
        return np.asarray(ndimage.shift(wide, (-middle[0], -middle[1]), order=0, cval=0.0))
    radius_mm = max(part.radius_mm, part.radius_to_mm)
    n = int(np.ceil(radius_mm / cell_mm))
    apart = np.hypot(*np.mgrid[-n : n + 1, -n : n + 1]) * cell_mm
    half, less = ((apart < radius_mm).sum(axis=1) - 1) // 2, np.zeros(apart.shape)
    if part.radius_to_mm > 0:
        rise = (part.to_mm - part.above_mm) / (part.radius_to_mm - part.radius_mm)
        less = rise * np.maximum(apart - part.radius_mm, 0.0)
    # what no neighbour is lower than lies behind one of them, seen from anywhere
    edges = np.argwhere(tops_mm > ndimage.minimum_filter(tops_mm, 3, mode="nearest"))
    return _spread(tops_mm, edges, half, less)


@njit(cache=True)
def _spread(tops, edges, half, less):  # type: ignore[no-untyped-def]
    """Row by row of the disc, which is `half` cells to either side there: no branch within."""
    out, n = tops.copy(), len(half) // 2
    for e in range(len(edges)):
        i, j = edges[e]
        for row in range(max(n - i, 0), min(n - i + out.shape[0], len(half))):
            a, shift = i - n + row, n - j
            for b in range(max(j - half[row], 0), min(j + half[row] + 1, out.shape[1])):
                here, over = tops[i, j] - less[row, b + shift], out[a, b]
                out[a, b] = here if here > over else over
    return out


def least_tip(
    tops_mm: np.ndarray, window: tuple[slice, slice], cell_mm: float, head: tuple[HeadSlice, ...]
) -> np.ndarray:
    """How high the tip must at least be, by column of a window."""
    return tip_under(tuple(grown(tops_mm, cell_mm, part) for part in head), head, window)


def tip_under(
    over_mm: tuple[np.ndarray, ...], head: tuple[HeadSlice, ...], window: tuple[slice, slice]
) -> np.ndarray:
    """The same, of what is highest under each slice of the head."""
    pairs = zip(over_mm, head, strict=True)
    return np.asarray(np.max([over[window] - part.above_mm for over, part in pairs], axis=0))


@dataclass(frozen=True)
class Reaching:
    """How a tip fills: where it may be, and how far its beads go.

    `least_mm` is what `least_tip` says, on cells of `cell_mm`; voxels are `size_z_mm` high from
    `low_z_mm` up. A tip may be `allowed_mm` lower than what it would touch.
    """

    least_mm: np.ndarray
    cell_mm: float
    low_z_mm: float
    size_z_mm: float
    bead_mm: float
    layer_mm: float
    allowed_mm: float


def reachable(
    missing: np.ndarray,
    stands: np.ndarray,
    by: Reaching,
    *,
    tip_layers: float = 0.5,
    held: bool = True,
) -> np.ndarray:
    """Missing voxels that a bead gets to: half its width from a free tip, and not over air.

    A layer down, what stands or is filled must lie within a bead's width; without `held` that is
    not asked, and what the head alone reaches is told. The tip is looked for `tip_layers` layers
    over what it covers: half of one on average, a whole one at most.
    """
    reach = np.zeros(missing.shape, bool)
    below = max(1, round(by.layer_mm / by.size_z_mm))
    for k in range(missing.shape[2]):
        if not missing[:, :, k].any():
            continue
        # a bead lies below its tip
        tip_mm = by.low_z_mm + (k + 1) * by.size_z_mm + tip_layers * by.layer_mm
        free = tip_mm >= by.least_mm - by.allowed_mm
        near = _within(0.5 * by.bead_mm, free, by.cell_mm)
        if held and by.low_z_mm + (k - below) * by.size_z_mm > 0 and k >= below:
            floor = stands[:, :, k - below] | reach[:, :, k - below]
            near &= _within(by.bead_mm, floor, by.cell_mm)
        reach[:, :, k] = missing[:, :, k] & near
    return reach


def _within(reach_mm: float, of: np.ndarray, cell_mm: float) -> np.ndarray:
    """Cells that lie within a reach of some."""
    if of.all():
        return of
    return np.asarray(ndimage.distance_transform_edt(~of) * cell_mm <= reach_mm)
