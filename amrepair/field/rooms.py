"""Rooms: space around broken faces, cut into what the scanned surface separates.

A room that holds a corner of the outside is empty; one that holds places just under the template's
present surface is solid; one that holds both says that the scan leaks, and tells nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from amrepair.template.port import Template

# Rooms that the scan's surface separates: voxels, the space around the faces, their number.
VOXEL_MM, ROOM_MM, MOST_VOXELS = 0.3, 3.0, 600_000
UNDER_MM = 0.8
# A room is what its many seeds say if the others are fewer than this share.
LEAK_RATIO = 0.02
# It leaks if it holds a larger share of all seeds of the other kind, however few those are.
LEAK_OF_ALL = 0.1
# A face looks this far ahead and behind: beyond the thickness of the wall of voxels.
LOOK_VOXELS = (2.5, 3.5)


@dataclass(frozen=True, slots=True)
class Rooms:
    """Voxels of a box, template frame: the room of each, and what each room is.

    Attributes
    ----------
    number
        (x, y, z) room of each voxel, 0 where scanned surface is.
    value
        1 empty, -1 solid, 0 unknown, by room.
    """

    low_mm: Float[np.ndarray, " 3"]
    voxel_mm: float
    number: Int[np.ndarray, "x y z"]
    value: Float[np.ndarray, " r"]

    def value_at(self, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """1 in an empty room, -1 in a solid one, 0 where nothing is known."""
        out = np.zeros(len(points_mm))
        if self.number.size:
            index, ok = _cells(points_mm, self.low_mm, self.voxel_mm, self.number.shape)
            out[ok] = self.value[self.number[tuple(index[ok].T)]]
        return out

    def open_side(
        self, face_mm: Float[np.ndarray, "q 3"], plane: Float[np.ndarray, "q 3"]
    ) -> Float[np.ndarray, " q"]:
        """Positive where space ahead of a face's plane is open, negative behind, 0 unknown."""
        side = np.zeros(len(face_mm))
        for step in LOOK_VOXELS:
            for sign in (-1.0, 1.0):
                side += sign * self.value_at(face_mm + sign * step * self.voxel_mm * plane)
        return side


def find_rooms(
    template: Template,
    points_mm: Float[np.ndarray, "n 3"],
    face_mm: Float[np.ndarray, "q 3"],
    present_mm: Float[np.ndarray, "m 3"],
    present_normals: Float[np.ndarray, "m 3"],
    *,
    foot: tuple[Float[np.ndarray, " 3"], float] | None,
) -> Rooms:
    """Rooms around broken faces.

    Parameters
    ----------
    points_mm
        The scan.
    present_mm, present_normals
        Places on the template's surface where it was seen, and outward unit normals.
    foot
        The way up, and the height of the part's foot that way: it closes rooms, though nobody saw
        it. None where it was seen.
    """
    if len(face_mm) == 0:
        return Rooms(np.zeros(3), VOXEL_MM, np.zeros((0, 0, 0), np.int64), np.zeros(1))
    low, high = face_mm.min(axis=0) - ROOM_MM, face_mm.max(axis=0) + ROOM_MM
    voxel_mm = max(VOXEL_MM, float(np.cbrt(np.prod(high - low) / MOST_VOXELS)))
    size = np.ceil((high - low) / voxel_mm).astype(np.int64)
    shape = (int(size[0]), int(size[1]), int(size[2]))
    wall = np.zeros(shape, bool)
    for points in (points_mm, present_mm):
        index, ok = _cells(points, low, voxel_mm, shape)
        wall[tuple(index[ok].T)] = True
    wall = ndimage.binary_dilation(wall)  # a sheet of points has gaps of chance
    if foot is not None:
        wall |= _slab(template, low, voxel_mm, shape, *foot)
    number, count = ndimage.label(~wall)
    edge = np.ones(shape, bool)
    edge[1:-1, 1:-1, 1:-1] = False
    edge_index = np.argwhere(edge & ~wall)
    centres = low + (edge_index + 0.5) * voxel_mm
    outside = edge_index[template.distance(centres) > voxel_mm]
    under = present_mm - UNDER_MM * present_normals
    index, ok = _cells(under, low, voxel_mm, shape)
    inside = index[ok][template.distance(under[ok]) < -0.8 * UNDER_MM]
    empties = np.bincount(number[tuple(outside.T)], minlength=count + 1)
    solids = np.bincount(number[tuple(inside.T)], minlength=count + 1)
    value = np.zeros(count + 1)
    for mine, other, said in ((empties, solids, 1.0), (solids, empties, -1.0)):
        sure = (other < LEAK_RATIO * mine) & (other <= LEAK_OF_ALL * other.sum())
        value[(mine > 0) & sure] = said
    value[0] = 0.0
    return Rooms(low, voxel_mm, np.asarray(number, np.int64), value)


def _slab(
    template: Template,
    low_mm: Float[np.ndarray, " 3"],
    voxel_mm: float,
    shape: tuple[int, ...],
    up: Float[np.ndarray, " 3"],
    height_mm: float,
) -> Bool[np.ndarray, "x y z"]:
    """Voxels along the plane that the part stands on, under the part."""
    x, y, z = (low_mm[k] + (np.arange(shape[k]) + 0.5) * voxel_mm for k in range(3))
    over_mm = (up[0] * x)[:, None, None] + (up[1] * y)[:, None] + up[2] * z - height_mm
    slab = np.abs(over_mm) <= voxel_mm
    slab[slab] = template.distance(low_mm + (np.argwhere(slab) + 0.5) * voxel_mm) < voxel_mm
    return np.asarray(slab)


def _cells(
    points_mm: Float[np.ndarray, "n 3"],
    low_mm: Float[np.ndarray, " 3"],
    voxel_mm: float,
    shape: tuple[int, ...],
) -> tuple[Int[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Voxel of each point, and whether it lies in the box."""
    index = np.floor((points_mm - low_mm) / voxel_mm).astype(np.int64)
    return index, np.asarray(((index >= 0) & (index < np.array(shape))).all(axis=1))
