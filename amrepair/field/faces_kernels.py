# mypy: disable-error-code="no-untyped-def"
"""Points moved onto the planes through their neighbours; compiled, for `faces`."""

from __future__ import annotations

import numpy as np

from amrepair.eigen_kernels import least_axis
from gcode.compiled import njit, prange

# Planes less askew to each other than this (37°) are of one surface.
ONE_SURFACE = 0.8


@njit(inner=True, cache=True, nogil=True)
def plane_through(points, index, weight, mean, normal):
    """Mean of some points by weight, and normal of the plane through them, into the last two."""
    total = 0.0
    mean[:] = 0.0
    for k in range(len(index)):
        total += weight[k]
        for a in range(3):
            mean[a] += weight[k] * points[index[k], a]
    for a in range(3):
        mean[a] /= total
    xx = xy = xz = yy = yz = zz = 0.0
    for k in range(len(index)):
        at = points[index[k]]
        x, y, z = at[0] - mean[0], at[1] - mean[1], at[2] - mean[2]
        xx += weight[k] * x * x
        xy += weight[k] * x * y
        xz += weight[k] * x * z
        yy += weight[k] * y * y
        yz += weight[k] * y * z
        zz += weight[k] * z * z
    least_axis(xx, xy, xz, yy, yz, zz, normal)


@njit(cache=True, nogil=True, parallel=True)
def smoothed(points, index, rounds, spread, least_spread):
    """(n, 3) points on the planes through their neighbours, (n, 3) those planes' normals.

    At an edge one of two planes wins: in each round what lies far from the plane counts less.
    `index` (n, k) are the neighbours. In a hollow a plane through neighbours lies too high, and on
    a hump too low: by as much as neighbours were moved on average each is moved back (twicing,
    Tukey 1977), which leaves noise a little less smoothed.
    """
    place, normals = np.empty_like(points), np.empty_like(points)
    moved, last = np.empty(len(points)), max(spread / 2**rounds, least_spread)
    for i in prange(len(points)):
        weight, mean = np.ones(index.shape[1]), np.zeros(3)
        normal = np.zeros(3)
        width = spread
        above = 0.0
        for _ in range(rounds):
            plane_through(points, index[i], weight, mean, normal)
            above = 0.0
            for a in range(3):
                above += (points[i, a] - mean[a]) * normal[a]
            width = max(width / 2, least_spread)
            for k in range(len(weight)):
                height = -above
                for a in range(3):
                    height += (points[index[i, k], a] - mean[a]) * normal[a]
                weight[k] = np.exp(-((height / width) ** 2)) + 1e-6
        moved[i] = -above
        for a in range(3):
            place[i, a] = points[i, a] - above * normal[a]
            normals[i, a] = normal[a]
    back = np.zeros(len(points))
    for i in prange(len(points)):
        weights = 0.0
        for k in range(index.shape[1]):
            j = index[i, k]
            along = height = 0.0
            for a in range(3):
                along += normals[i, a] * normals[j, a]
                height += (points[j, a] - place[i, a]) * normals[i, a]
            if abs(along) > ONE_SURFACE:
                weight = np.exp(-((height / last) ** 2)) + 1e-9
                back[i] += weight * moved[j] * np.sign(along)
                weights += weight
        back[i] /= weights
    return place - back.reshape(-1, 1) * normals, normals


@njit(cache=True, nogil=True, parallel=True)
def plane_values(points, f, distance, index, place, deviation, off, normal, blur):
    """(n,) signed distance by the nearest places, weighted, and how high above the nearest alone.

    `distance` and `index` (n, k) are of the nearest places, those `off` the template planes.
    """
    value, height = np.empty(len(points)), np.empty(len(points))
    for i in prange(len(points)):
        total = weights = 0.0
        for k in range(index.shape[1]):
            j = index[i, k]
            if off[j]:
                told = 0.0
                for a in range(3):
                    told += (points[i, a] - place[j, a]) * normal[j, a]
            else:
                told = f[i] - deviation[j]
            if k == 0:
                height[i] = abs(told)
            weight = np.exp(-(distance[i, k] ** 2 - distance[i, 0] ** 2) / blur**2)
            total += weight * told
            weights += weight
        value[i] = total / weights
    return value, height
