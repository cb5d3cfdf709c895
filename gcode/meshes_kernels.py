"""Corners to shared vertices, half-edges to pairs, faces to bodies, planes to contours; compiled.

The loops under `meshes`. Half-edge 3·f + k runs from corner k of face f to the next corner.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


@njit(inner=True, cache=True, nogil=True)
def _slot_of(x: Any, y: Any, z: Any, slots: Any) -> Any:
    """Where a place of whole numbers belongs in a table of 2ⁿ slots."""
    # odd numbers without pattern: products spread over all bits of a key
    key = np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)
    key ^= np.uint64(y) * np.uint64(0xC2B2AE3D27D4EB4F)
    key ^= key >> np.uint64(29)
    key ^= np.uint64(z) * np.uint64(0x165667B19E3779F9)
    key *= np.uint64(0x9E3779B97F4A7C15)
    return np.int64(key >> np.uint64(32)) & (slots - 1)


@njit(cache=True, nogil=True)
def index_of_corners(
    corners: Any, vertices: Any, count: int, table: Any, per_mm: float, index: Any
) -> int:
    """Vertices of more corners, equal ones shared with those so far; how many there are then.

    Parameters
    ----------
    corners
        (k, 3) single precision.
    vertices, count
        (n, 3) with room for all that may come, and how many are in it.
    table
        2ⁿ slots, -1 where free, of which less than half are taken in the end.
    per_mm
        Places are equal where they are when counted in such parts.
    index
        (k,) filled in: the vertex of each corner.
    """
    for i in range(corners.shape[0]):
        x, y, z = np.float64(corners[i, 0]), np.float64(corners[i, 1]), np.float64(corners[i, 2])
        u, v, w = np.rint(x * per_mm), np.rint(y * per_mm), np.rint(z * per_mm)
        slot = _slot_of(np.int64(u), np.int64(v), np.int64(w), table.shape[0])
        while True:
            k = table[slot]
            if k < 0:
                table[slot] = count
                vertices[count, 0], vertices[count, 1], vertices[count, 2] = x, y, z
                index[i] = count
                count += 1
                break
            if (
                np.rint(vertices[k, 0] * per_mm) == u
                and np.rint(vertices[k, 1] * per_mm) == v
                and np.rint(vertices[k, 2] * per_mm) == w
            ):
                index[i] = k
                break
            slot = (slot + 1) & (table.shape[0] - 1)
    return count


@njit(cache=True, nogil=True)
def put_in_table(vertices: Any, count: int, table: Any, per_mm: float) -> None:
    """Put the vertices so far into an empty, larger table."""
    for i in range(count):
        u = np.int64(np.rint(vertices[i, 0] * per_mm))
        v = np.int64(np.rint(vertices[i, 1] * per_mm))
        w = np.int64(np.rint(vertices[i, 2] * per_mm))
        slot = _slot_of(u, v, w, table.shape[0])
        while table[slot] >= 0:
            slot = (slot + 1) & (table.shape[0] - 1)
        table[slot] = i


@njit(inner=True, cache=True, nogil=True)
def _first_of(faces: Any, a: int, b: int, first: Any, after: Any, take: bool) -> int:
    """The first half-edge in its chain that runs from a to b; -1 where there is none left."""
    slot = _slot_of(a, b, 0, first.shape[0])
    before, half = -1, first[slot]
    while half >= 0:
        if faces[half // 3, half % 3] == a and faces[half // 3, (half % 3 + 1) % 3] == b:
            if take and before < 0:
                first[slot] = after[half]
            elif take:
                after[before] = after[half]
            return int(half)
        before, half = half, after[half]
    return -1


@njit(cache=True, nogil=True)
def _paired_in_order(faces: Any) -> tuple[Any, int]:
    """As `paired`, where an edge may have several faces: through chains of half-edges."""
    halves = 3 * faces.shape[0]
    slots = 8
    while slots < halves:
        slots *= 2
    across = np.full(halves, -1, np.int32)
    after = np.full(halves, -1, np.int32)  # chains of half-edges that hash alike
    first = np.full(slots, -1, np.int32)
    for half in range(halves - 1, -1, -1):
        a, b = faces[half // 3, half % 3], faces[half // 3, (half % 3 + 1) % 3]
        if a == b:
            return across, -1
        slot = _slot_of(a, b, 0, slots)
        after[half] = first[slot]
        first[slot] = half
    shared = 0
    for half in range(halves):
        if across[half] >= 0:
            continue
        a, b = faces[half // 3, half % 3], faces[half // 3, (half % 3 + 1) % 3]
        other = _first_of(faces, b, a, first, after, True)
        if other < 0:
            return across, -1
        _first_of(faces, a, b, first, after, True)  # itself: the earlier ones have theirs
        across[half], across[other] = other, half
        if (
            _first_of(faces, a, b, first, after, False) >= 0
            or _first_of(faces, b, a, first, after, False) >= 0
        ):
            shared += 1
    return across, shared


@njit(cache=True, nogil=True)
def paired(faces: Any) -> tuple[Any, int]:
    """(3m,) the half-edge across from each, and at how many pairs an edge had more faces.

    -1 edges where the faces close no oriented surface: a half-edge without another that runs the
    other way, or a face with a corner twice. Edges of several faces are paired in their order. The
    time grows as the faces do, however many share an edge.
    """
    slots = 8
    while slots < 3 * faces.shape[0]:
        slots *= 2
    across = np.full(3 * faces.shape[0], -1, np.int32)
    first = np.full(slots, -1, np.int32)  # the first half-edge of each edge, open addressing
    open_halves = 0
    for face in range(faces.shape[0]):
        for k in range(3):
            a, b = faces[face, k], faces[face, (k + 1) % 3]
            if a == b:
                return across, -1
            slot = _slot_of(min(a, b), max(a, b), 0, slots)
            while True:
                other = first[slot]
                if other < 0:
                    first[slot] = 3 * face + k
                    open_halves += 1
                    break
                c, d = faces[other // 3, other % 3], faces[other // 3, (other % 3 + 1) % 3]
                if c == b and d == a and across[other] < 0:
                    across[3 * face + k], across[other] = other, 3 * face + k
                    open_halves -= 1
                    break
                if min(c, d) == min(a, b) and max(c, d) == max(a, b):
                    return _paired_in_order(faces)
                slot = (slot + 1) & (slots - 1)
    return across, -1 if open_halves else 0


@njit(cache=True, nogil=True)
def bodies_of(vertices: Any, faces: Any, across: Any) -> tuple[Any, Any]:
    """(b,) signed volumes and (b, 6) boxes (low, then high) of what edges hold together."""
    body = np.full(faces.shape[0], -1, np.int32)
    stack = np.empty(faces.shape[0], np.int32)
    volumes = np.empty(8)
    boxes = np.empty((8, 6))
    count = 0
    for seed in range(faces.shape[0]):
        if body[seed] >= 0:
            continue
        if count == volumes.shape[0]:
            volumes = np.concatenate((volumes, np.empty(count)))
            boxes = np.concatenate((boxes, np.empty((count, 6))))
        volumes[count] = 0.0
        boxes[count, :3], boxes[count, 3:] = np.inf, -np.inf
        body[seed] = count
        stack[0] = seed
        depth = 1
        while depth > 0:
            depth -= 1
            face = stack[depth]
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            p, q, r = vertices[a], vertices[b], vertices[c]
            volumes[count] += (
                p[0] * (q[1] * r[2] - q[2] * r[1])
                - p[1] * (q[0] * r[2] - q[2] * r[0])
                + p[2] * (q[0] * r[1] - q[1] * r[0])
            ) / 6.0
            for k in range(3):
                at = vertices[faces[face, k]]
                for axis in range(3):
                    boxes[count, axis] = min(boxes[count, axis], at[axis])
                    boxes[count, 3 + axis] = max(boxes[count, 3 + axis], at[axis])
                beyond = across[3 * face + k] // 3
                if body[beyond] < 0:
                    body[beyond] = count
                    stack[depth] = beyond
                    depth += 1
        count += 1
    return volumes[:count], boxes[:count]


@njit(cache=True, nogil=True)
def level_faces(vertices: Any, faces: Any, same_mm: float) -> tuple[Any, Any]:
    """(l,) heights and (l,) areas of the faces that lie level."""
    count = 0
    heights, areas = np.empty(64), np.empty(64)
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        z0, z1, z2 = vertices[a, 2], vertices[b, 2], vertices[c, 2]
        if max(z0, z1, z2) - min(z0, z1, z2) >= same_mm:
            continue
        if count == heights.shape[0]:
            heights = np.concatenate((heights, np.empty(count)))
            areas = np.concatenate((areas, np.empty(count)))
        ux, uy = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1]
        vx, vy = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1]
        heights[count] = z0
        areas[count] = 0.5 * abs(ux * vy - uy * vx)
        count += 1
    return heights[:count], areas[:count]


@njit(cache=True, nogil=True)
def crossing(vertices: Any, faces: Any, heights: Any) -> tuple[Any, Any]:
    """Which faces cross each of the ascending heights: those of height i are first[i]:first[i+1].

    A face crosses where its lowest corner is not above the height, and its highest is.
    """
    n = heights.shape[0]
    first = np.zeros(n + 1, np.int64)
    which = np.empty(0, np.int32)
    for turn in range(2):
        if turn == 1:
            total = 0
            for i in range(n + 1):
                step = first[i]
                first[i] = total
                total += step
            which = np.empty(total, np.int32)
        for face in range(faces.shape[0]):
            z0, z1 = vertices[faces[face, 0], 2], vertices[faces[face, 1], 2]
            z2 = vertices[faces[face, 2], 2]
            low, high = min(z0, z1, z2), max(z0, z1, z2)
            i = np.searchsorted(heights, low)
            while i < n and heights[i] < high:
                if turn == 1:
                    which[first[i]] = face
                first[i] += 1
                i += 1
    for i in range(n, 0, -1):
        first[i] = first[i - 1]
    first[0] = 0
    return first, which


@njit(cache=True, nogil=True)
def contours_at(
    vertices: Any, faces: Any, across: Any, which: Any, height: float, done: Any, turn: int
) -> tuple[Any, Any]:
    """Contours of a closed mesh at a height, matter on their left: points, and each one's start.

    Parameters
    ----------
    which
        The faces that cross the height.
    done
        (m,) the last turn in which each face was seen; `turn` is none of those yet.

    Returns
    -------
    tuple
        (p, 2) points, and (c + 1,) where each contour starts, with the end.
    """
    points = np.empty((which.shape[0], 2))
    starts = np.empty(which.shape[0] + 1, np.int64)
    n, contours = 0, 0
    for seed in which:
        if done[seed] == turn:
            continue
        starts[contours] = n
        contours += 1
        k = 0
        for j in range(3):
            if (
                vertices[faces[seed, j], 2] > height
                and vertices[faces[seed, (j + 1) % 3], 2] <= height
            ):
                k = (j + 1) % 3
                break
        face = seed
        while True:
            done[face] = turn
            if vertices[faces[face, (k + 1) % 3], 2] <= height:
                k = (k + 1) % 3
            below, above = faces[face, k], faces[face, (k + 1) % 3]
            t = (height - vertices[below, 2]) / (vertices[above, 2] - vertices[below, 2])
            for axis in range(2):
                points[n, axis] = vertices[below, axis] * (1.0 - t) + vertices[above, axis] * t
            n += 1
            half = across[3 * face + k]
            face, k = half // 3, (half % 3 + 1) % 3
            if face == seed:
                break
    starts[contours] = n
    return points[:n], starts[: contours + 1]
