# mypy: disable-error-code="no-untyped-def"
"""Areas and normals of triangles, and points spread over them; compiled, for `surface`."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit

LEAST_NORMAL = 1e-300  # of a triangle with an area


@njit(cache=True, nogil=True)
def areas_normals(vertices, faces):
    """(f,) areas and (f, 3) unit normals (zero where a triangle has no area)."""
    areas, normals = np.empty(len(faces)), np.empty((len(faces), 3))
    for i in range(len(faces)):
        a, b, c = faces[i, 0], faces[i, 1], faces[i, 2]
        ux, vx = vertices[b, 0] - vertices[a, 0], vertices[c, 0] - vertices[a, 0]
        uy, vy = vertices[b, 1] - vertices[a, 1], vertices[c, 1] - vertices[a, 1]
        uz, vz = vertices[b, 2] - vertices[a, 2], vertices[c, 2] - vertices[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        long = np.sqrt(x * x + y * y + z * z)
        areas[i], least = 0.5 * long, max(long, LEAST_NORMAL)
        normals[i, 0], normals[i, 1], normals[i, 2] = x / least, y / least, z / least
    return areas, normals


@njit(cache=True, nogil=True)
def spread_over(vertices, faces, cumulative, shift, pace, count):
    """(m, 3) points that stand for as much area each, and (m,) their triangles.

    `cumulative` is the area of the triangles up to each; where in its triangle a point lies a
    sequence of low discrepancy says, that starts at `shift` and goes on by `pace`.
    """
    points, triangle = np.empty((count, 3)), np.empty(count, np.int64)
    each, t = cumulative[-1] / count, 0
    for i in range(count):
        while t < len(faces) - 1 and cumulative[t] <= (i + shift) * each:
            t += 1
        triangle[i] = t
        root = np.sqrt((shift + (i + 1) * pace[0]) % 1.0)
        along = (shift + (i + 1) * pace[1]) % 1.0
        for a in range(3):
            points[i, a] = (
                (1.0 - root) * vertices[faces[t, 0], a]
                + root * (1.0 - along) * vertices[faces[t, 1], a]
                + root * along * vertices[faces[t, 2], a]
            )
    return points, triangle
