# mypy: disable-error-code="no-untyped-def"
"""Places held against a range image; compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Vector
from gcode.compiled import njit


class Camera(NamedTuple):
    """Of a range image: where its sensor stood, its axes (rows: across, down, along), its focal
    length in pixels, how far off the part is, and whether it is a moving sheet of light.
    """

    sensor: Vector
    axes: Float[np.ndarray, "3 3"]
    scale: float
    distance: float
    sheet: int


@njit(inner=True, cache=True, nogil=True, error_model="numpy")
def _pixel(point, camera):
    """Of a place: its pixel, how deep it lies along the middle ray, and its own ray.

    Within a moving sheet of light rays do not spread along its way, axis 1.
    """
    sensor, axes, scale, distance, sheet = camera
    x, y, z = point[0] - sensor[0], point[1] - sensor[1], point[2] - sensor[2]
    depth = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
    down = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
    u = int(np.floor((axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z) / depth * scale))
    v = int(np.floor(down / (distance if sheet else depth) * scale))
    if sheet:
        x, y, z = x - down * axes[1, 0], y - down * axes[1, 1], z - down * axes[1, 2]
    return u, v, depth, x, y, z


@njit(cache=True, nogil=True, error_model="numpy")
def pixels(points, camera):
    """(n,) columns and rows of places in a sensor's image, and how far off they are."""
    n = len(points)
    u, v, reach = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n)
    for k in range(n):
        u[k], v[k], _, x, y, z = _pixel(points[k], camera)
        reach[k] = np.sqrt(x * x + y * y + z * z)
    return u, v, reach


@njit(cache=True, nogil=True, error_model="numpy")
def seen_through(points, normals, asked, camera, first, least, outside, within, edge_on,
                 silhouette, found):  # fmt: skip
    """Say of the places asked about whether the sensor saw through them; in `found`.

    Beside the silhouette it saw through, too, where that is believed (`silhouette`).

    `normals` is empty, or of surface there: what stands edge-on to the rays may be there unseen.
    """
    rows, columns = least.shape
    has_normals = len(normals) > 0
    for q in range(len(asked)):
        k = asked[q]
        u, v, depth, x, y, z = _pixel(points[k], camera)
        reach = np.sqrt(x * x + y * y + z * z)
        if has_normals:
            along = abs(x * normals[k, 0] + y * normals[k, 1] + z * normals[k, 2])
            if along <= edge_on * reach:
                found[k] = False
                continue
        if depth <= 1e-6 * camera.distance:
            found[k] = False  # behind the sensor nobody looked
            continue
        u -= first[0]
        v -= first[1]
        i, j = min(max(u, 0), rows - 1), min(max(v, 0), columns - 1)
        beyond = max(abs(u - i), abs(v - j))
        beside = (outside[i + 1, j + 1] + beyond) * reach / camera.scale
        found[k] = (silhouette and beside > within) or (
            beyond == 0 and np.isfinite(least[i, j]) and reach < least[i, j] - within
        )


@njit(cache=True, nogil=True, error_model="numpy")
def behind_edge_on(points, asked, veil, normals, camera, first, last, edge_on, within, hidden):
    """Say which places lie behind surface that is edge-on to the sensor's rays; in `hidden[asked]`.

    Pixels from `first` to `last` are looked at, as far as there are places in them.
    """
    count = len(points)
    pixel = np.empty((count, 2), dtype=np.int64)
    inside = np.empty(count, dtype=np.bool_)
    far = np.empty(count)
    low, high = last.copy(), first - 1
    for k in range(count):
        pixel[k, 0], pixel[k, 1], _, x, y, z = _pixel(points[k], camera)
        far[k] = np.sqrt(x * x + y * y + z * z)
        inside[k] = np.all(pixel[k] >= first) and np.all(pixel[k] <= last)
        if inside[k]:
            low, high = np.minimum(low, pixel[k]), np.maximum(high, pixel[k])
    if np.any(high < low):
        return
    low, high = low - 1, high + 1  # between its points a surface is closed: over the next pixels
    rows, columns = high[0] - low[0] + 1, high[1] - low[1] + 1
    least = np.full((rows, columns), np.inf)
    limit = edge_on * edge_on
    sensor, way = camera.sensor, camera.axes[1]
    for q in range(len(veil)):
        # most of a surface is not edge-on: that is told before its pixel is
        x, y, z = veil[q, 0] - sensor[0], veil[q, 1] - sensor[1], veil[q, 2] - sensor[2]
        down = camera.sheet * (way[0] * x + way[1] * y + way[2] * z)
        x, y, z = x - down * way[0], y - down * way[1], z - down * way[2]
        square = x * x + y * y + z * z
        along = x * normals[q, 0] + y * normals[q, 1] + z * normals[q, 2]
        if along * along > limit * square:
            continue
        u, v, depth, _, _, _ = _pixel(veil[q], camera)
        u, v = u - low[0], v - low[1]
        if depth > 0.0 and 0 <= u < rows and 0 <= v < columns:
            least[u, v] = min(least[u, v], np.sqrt(square))
    for k in range(count):
        if not inside[k]:
            continue
        u, v, before = pixel[k, 0] - low[0], pixel[k, 1] - low[1], np.inf
        for i in range(u - 1, u + 2):
            for j in range(v - 1, v + 2):
                before = min(before, least[i, j])
        hidden[asked[k]] = far[k] > before + within
