# mypy: disable-error-code="no-untyped-def"
"""Solids as voxels: parity of crossings along the column through each voxel's centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numba import njit

FILM_MM = 0.02
# Columns do not run through vertices of a model whose coordinates are round.
SHIFT_MM = (1.3e-5, 2.1e-5)


@dataclass
class Voxels:
    """A box of voxels: its low corner, mm, their size, mm, and how many by axis."""

    low_mm: np.ndarray
    size_mm: np.ndarray
    shape: tuple[int, int, int]

    @classmethod
    def around(
        cls, low_mm: np.ndarray, high_mm: np.ndarray, size_mm: tuple[float, float, float]
    ) -> Voxels:
        """Voxels that cover a box."""
        size = np.array(size_mm)
        shape = np.ceil((high_mm - low_mm) / size - 1e-9).astype(int)
        return cls(np.array(low_mm, float), size, (int(shape[0]), int(shape[1]), int(shape[2])))

    @property
    def volume_mm3(self) -> float:
        """Of one voxel."""
        return float(np.prod(self.size_mm))


def occupancy(mesh: trimesh.Trimesh, box: Voxels) -> np.ndarray:
    """Boolean (nx, ny, nz): voxels whose centre lies in the mesh."""
    triangles = np.ascontiguousarray(mesh.triangles, float)
    origin = box.low_mm[:2] + 0.5 * box.size_mm[:2] + np.array(SHIFT_MM)
    flips = _flips(triangles, origin, box.size_mm, box.low_mm[2], box.shape)
    return np.bitwise_xor.accumulate(flips, axis=2).astype(bool)


def column_tops(mesh: trimesh.Trimesh, box: Voxels) -> np.ndarray:
    """(nx, ny) height of the mesh's top over each column, 0 where there is none."""
    origin = box.low_mm[:2] + 0.5 * box.size_mm[:2] + np.array(SHIFT_MM)
    return _highest(np.ascontiguousarray(mesh.triangles, float), origin, box.size_mm, box.shape[:2])


@njit(cache=True)
def _crossings(triangles, origin, size, shape):
    """Heights at which the columns cross triangles, and where those of each column start."""
    starts = np.zeros(shape[0] * shape[1] + 1, np.int64)
    heights = np.zeros(0)
    cursor = starts[:-1].copy()
    for phase in range(2):
        if phase == 1:
            starts[1:] = np.cumsum(starts[1:])
            heights = np.zeros(starts[-1])
            cursor = starts[:-1].copy()
        for t in range(len(triangles)):
            a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
            i0 = max(0, int(np.ceil((min(a[0], b[0], c[0]) - origin[0]) / size[0])))
            i1 = min(shape[0] - 1, int(np.floor((max(a[0], b[0], c[0]) - origin[0]) / size[0])))
            j0 = max(0, int(np.ceil((min(a[1], b[1], c[1]) - origin[1]) / size[1])))
            j1 = min(shape[1] - 1, int(np.floor((max(a[1], b[1], c[1]) - origin[1]) / size[1])))
            area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
            if area == 0.0:
                continue
            for i in range(i0, i1 + 1):
                x = origin[0] + i * size[0]
                for j in range(j0, j1 + 1):
                    y = origin[1] + j * size[1]
                    u = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / area
                    v = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / area
                    w = 1.0 - u - v
                    if u < 0 or v < 0 or w < 0:
                        continue
                    k = i * shape[1] + j
                    if phase == 0:
                        starts[k + 1] += 1
                    else:
                        heights[cursor[k]] = u * a[2] + v * b[2] + w * c[2]
                        cursor[k] += 1
    return starts, heights


@njit(cache=True)
def _highest(triangles, origin, size, shape):
    """Top of each column; films, which a boolean leaves on faces that coincide, are nothing."""
    starts, heights = _crossings(triangles, origin, size, shape)
    tops = np.zeros(shape)
    for i in range(shape[0]):
        for j in range(shape[1]):
            k = i * shape[1] + j
            z = np.sort(heights[starts[k] : starts[k + 1]])
            last = len(z) - 1
            while last > 0 and z[last] - z[last - 1] < FILM_MM:
                last -= 2
            if last >= 0:
                tops[i, j] = max(0.0, z[last])
    return tops


@njit(cache=True)
def _flips(triangles, origin, size, low_z, shape):
    """1 at the first voxel over each crossing of a triangle with a column, summed by parity."""
    starts, heights = _crossings(triangles, origin, size, shape[:2])
    flips = np.zeros(shape, np.uint8)
    for i in range(shape[0]):
        for j in range(shape[1]):
            column = i * shape[1] + j
            for z in heights[starts[column] : starts[column + 1]]:
                k = max(0, int(np.ceil((z - low_z) / size[2] - 0.5)))
                if k < shape[2]:
                    flips[i, j, k] ^= 1
    return flips
