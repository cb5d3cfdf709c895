"""The medial axis from Delaunay triangles of boundary samples: the loops under `medial`.

A triangle's circumcentre is a node of the Voronoi diagram, so that a node has three links at most.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit
from gcode.slicing.delaunay_kernels import triangles
from gcode.slicing.infill_kernels import inside
from gcode.slicing.order_kernels import area_along

LEAF_RATIO = 1.2  # of a junction's radius: a shorter branch to a wall is its corner, not an axis
NO_CENTRE_MM = 1e9  # where a triangle without area has its centre


@njit(inner=True, cache=True, nogil=True)
def samples(points: Any, starts: Any, apart: float) -> tuple[Any, Any, Any]:
    """Points along closed contours, at most `apart` from each other, in mid-stretch.

    Contours come flattened: points (n, 2) and the start of each (m + 1,). Returns (s, 2) points,
    the contour of each, and its place along it.
    """
    number = np.empty(points.shape[0], np.int64)
    total = 0
    for c in range(starts.shape[0] - 1):
        for k in range(starts[c], starts[c + 1]):
            to = k + 1 if k + 1 < starts[c + 1] else starts[c]
            long = np.hypot(points[to, 0] - points[k, 0], points[to, 1] - points[k, 1])
            number[k] = max(1, int(np.ceil(long / apart)))
            total += number[k]
    found = np.empty((total, 2))
    owner = np.empty(total, np.int64)
    place = np.empty(total, np.int64)
    n = 0
    for c in range(starts.shape[0] - 1):
        first = n
        for k in range(starts[c], starts[c + 1]):
            to = k + 1 if k + 1 < starts[c + 1] else starts[c]
            for i in range(number[k]):
                t = (i + 0.5) / number[k]
                for axis in range(2):
                    found[n, axis] = points[k, axis] + t * (points[to, axis] - points[k, axis])
                owner[n] = c
                place[n] = n - first
                n += 1
    return found, owner, place


@njit(cache=True, nogil=True)
def move_aside(places: Any, most: float) -> None:
    """Move places by so much at most, each time alike: no four are left on one circle."""
    state = np.uint64(0x9E3779B97F4A7C15)
    for i in range(len(places)):
        for a in range(2):
            # xorshift64 (Marsaglia 2003)
            state ^= state << np.uint64(13)
            state ^= state >> np.uint64(7)
            state ^= state << np.uint64(17)
            places[i, a] += most * (2.0 * (np.float64(state >> np.uint64(11)) / 2.0**53) - 1.0)


@njit(cache=True, nogil=True)
def axis_of(points: Any, starts: Any, apart: float, aside: float, facing: float) -> Any:
    """`axis_paths` of contours, from samples so far apart that are moved aside by so little."""
    samples_mm, owner, place = samples(points, starts, apart)
    move_aside(samples_mm, aside)
    corners, across = triangles(samples_mm)
    return axis_paths(samples_mm, owner, place, corners, across, points, starts, facing)


@njit(inner=True, cache=True, nogil=True)
def axis_paths(
    samples_mm: Any,
    owner: Any,
    place: Any,
    corners: Any,
    across: Any,
    points: Any,
    starts: Any,
    facing: float,
) -> tuple[Any, Any, Any, Any]:
    """Runs of the axis between its ends and junctions.

    Parameters
    ----------
    samples_mm, owner, place
        As `samples` gives them.
    corners, across
        (t, 3) triangles, and which of them lies across from each corner; -1 is none.
    points, starts
        The contours, flattened.
    facing
        Two walls face each other where their feet lie this many radii apart.

    Returns
    -------
    tuple
        (t, 2) nodes, (t,) distances to the walls, the runs' nodes one after the other, and where
        each run starts (with the end). Spurs into corners are left out.
    """
    nodes, radius = _centres(samples_mm, corners)
    within = inside(nodes[:, 0].copy(), nodes[:, 1].copy(), points, starts)
    links, degree, order = _links(
        samples_mm, owner, place, corners, across, nodes, within, starts, facing
    )
    seen = np.zeros((len(corners), 3), np.bool_)
    runs = np.empty(2 * len(corners) + 2 * degree.sum() + 2, np.int64)
    begins = np.empty(degree.sum() + 2, np.int64)
    count, n = 0, 0
    begins[0] = 0
    for turn in range(2):
        for begin in order:
            if (degree[begin] != 2) != (turn == 0):
                continue
            for link in range(degree[begin]):
                if seen[begin, link]:
                    continue
                first = n
                runs[n] = begin
                n += 1
                here, way = begin, link
                while True:
                    there = links[here, way]
                    back = _link_to(links, degree, there, here)
                    seen[here, way] = True
                    seen[there, back] = True
                    runs[n] = there
                    n += 1
                    if degree[there] != 2 or seen[there, 1 - back]:
                        break
                    here, way = there, 1 - back
                if _is_spur(nodes, radius, degree, runs[first:n]):
                    n = first
                else:
                    count += 1
                    begins[count] = n
    return nodes, radius, runs[:n], begins[: count + 1]


@njit(inner=True, cache=True, nogil=True)
def _centres(samples_mm: Any, corners: Any) -> tuple[Any, Any]:
    """Circumcentres and circumradii."""
    nodes = np.empty((len(corners), 2))
    radius = np.empty(len(corners))
    for t in range(len(corners)):
        ax, ay = samples_mm[corners[t, 0]]
        ux, uy = samples_mm[corners[t, 1], 0] - ax, samples_mm[corners[t, 1], 1] - ay
        vx, vy = samples_mm[corners[t, 2], 0] - ax, samples_mm[corners[t, 2], 1] - ay
        twice = 2.0 * (ux * vy - uy * vx)
        uu, vv = ux * ux + uy * uy, vx * vx + vy * vy
        x, y = NO_CENTRE_MM, NO_CENTRE_MM
        if twice != 0.0:
            x, y = (vy * uu - uy * vv) / twice, (ux * vv - vx * uu) / twice
        if not (abs(x) < NO_CENTRE_MM and abs(y) < NO_CENTRE_MM):
            x, y = NO_CENTRE_MM, NO_CENTRE_MM
        nodes[t, 0], nodes[t, 1] = ax + x, ay + y
        radius[t] = np.hypot(x, y)
    return nodes, radius


@njit(inner=True, cache=True, nogil=True)
def _links(
    samples_mm: Any,
    owner: Any,
    place: Any,
    corners: Any,
    across: Any,
    nodes: Any,
    within: Any,
    starts: Any,
    facing: float,
) -> tuple[Any, Any, Any]:
    """Neighbours of each node along the axis, how many, and nodes in the order they came up."""
    links = np.empty((len(corners), 3), np.int64)
    degree = np.zeros(len(corners), np.int64)
    order = np.empty(len(corners), np.int64)
    ring = np.zeros(len(starts), np.int64)
    for k in range(len(owner)):
        ring[owner[k]] += 1
    n = 0
    for t in range(len(corners)):
        for k in range(3):
            to = np.int64(across[t, k])
            if to <= t or not within[t] or not within[to]:
                continue
            p, q = corners[t, (k + 1) % 3], corners[t, (k + 2) % 3]
            x = 0.5 * (nodes[t, 0] + nodes[to, 0]) - samples_mm[p, 0]
            y = 0.5 * (nodes[t, 1] + nodes[to, 1]) - samples_mm[p, 1]
            apart = np.hypot(
                samples_mm[p, 0] - samples_mm[q, 0], samples_mm[p, 1] - samples_mm[q, 1]
            )
            if apart < facing * np.hypot(x, y):
                continue
            if owner[p] == owner[q]:
                along = abs(place[p] - place[q])
                if min(along, ring[owner[p]] - along) <= 1:
                    continue  # next to each other on one wall
            for node in (t, to):
                if degree[node] == 0:
                    order[n] = node
                    n += 1
            links[t, degree[t]] = to
            links[to, degree[to]] = t
            degree[t] += 1
            degree[to] += 1
    return links, degree, order[:n]


@njit(inner=True, cache=True, nogil=True)
def _link_to(links: Any, degree: Any, node: int, other: int) -> int:
    for k in range(degree[node]):
        if links[node, k] == other:
            return k
    return -1


@njit(inner=True, cache=True, nogil=True)
def _is_spur(nodes: Any, radius: Any, degree: Any, run: Any) -> bool:
    """A branch that ends at a wall, hardly longer than the junction it leaves is wide."""
    junction = 0.0
    for node in (run[0], run[-1]):
        if degree[node] > 2:
            junction = max(junction, radius[node])
    if junction == 0.0 or (degree[run[0]] != 1 and degree[run[-1]] != 1):
        return False
    long = 0.0
    for k in range(len(run) - 1):
        long += np.hypot(
            nodes[run[k + 1], 0] - nodes[run[k], 0], nodes[run[k + 1], 1] - nodes[run[k], 1]
        )
    return bool(long < LEAF_RATIO * junction)


@njit(inner=True, cache=True, nogil=True)
def apart_by(points: Any, least: float) -> Any:
    """Which points of a chain to keep so that they lie at least so far apart; its ends stay."""
    keep = np.zeros(len(points), np.bool_)
    last = 0
    for k in range(1, len(points) - 1):
        if np.hypot(points[k, 0] - points[last, 0], points[k, 1] - points[last, 1]) >= least:
            keep[k] = True
            last = k
    keep[0] = keep[-1] = True
    return keep


@njit(cache=True, nogil=True)
def ends_meet(runs: Any, begins: Any, nodes: int) -> bool:
    """Whether an end of one run, of those that do not end where they begin, is another one's."""
    at = np.full(nodes, -1, np.int64)
    for run in range(len(begins) - 1):
        head, tail = runs[begins[run]], runs[begins[run + 1] - 1]
        if head == tail:
            continue
        for end in (head, tail):
            if at[end] >= 0 and at[end] != run:
                return True
            at[end] = run
    return False


@njit(inner=True, cache=True, nogil=True)
def wide_enough(along: Any, radius: Any, least: float) -> Any:
    """Where a wall along a chain is thick enough, and where it is taken for it.

    A wall that is thinner for less than such a length breaks no bead, and one that is thick enough
    for less holds none: a wall of just that thickness would be a row of dashes.
    """
    n = len(along)
    wide = np.empty(n, np.bool_)
    for i in range(n):
        wide[i] = 2 * radius[i] >= least * (1 - 1e-6)
    for holds in (False, True):  # short gaps are closed before short stretches go
        end = 0
        while end < n:
            first = end
            while end < n and wide[end] == holds:
                end += 1
            if end == first:
                end += 1
            elif along[end - 1] - along[first] < least and (holds or (first > 0 and end < n)):
                wide[first:end] = not holds
    return wide


@njit(inner=True, cache=True, nogil=True)
def put_bead(
    points: Any, radius: Any, most: float, inset: float, apart: float, xy: Any, share: Any
) -> tuple[int, bool]:
    """A smooth bead along a chain, its open ends drawn out to a part of a radius from the wall.

    Its points and shares go to the beginning of `xy` and `share`; returns how many points it has,
    and whether it is closed.
    """
    n = len(points)
    closed = (
        n > 3
        and abs(points[0, 0] - points[n - 1, 0]) < 1e-9
        and abs(points[0, 1] - points[n - 1, 1]) < 1e-9
    )
    line, width = points, radius
    if not closed:
        line, width = np.empty((n + 2, 2)), np.empty(n + 2)
        line[1 : n + 1], width[1 : n + 1] = points, radius
        for end, inner, out in ((0, min(2, n - 1), 0), (n - 1, n - min(3, n), n + 1)):
            x, y = points[end, 0] - points[inner, 0], points[end, 1] - points[inner, 1]
            long = max(np.hypot(x, y), 1e-12)
            line[out, 0] = points[end, 0] + x / long * inset * radius[end]
            line[out, 1] = points[end, 1] + y / long * inset * radius[end]
            width[out] = radius[end]
    keep = apart_by(line, apart)
    count, before = 0, 0.0
    for k in range(len(line)):
        if not keep[k]:
            continue
        xy[count, 0], xy[count, 1] = line[k, 0], line[k, 1]
        if count > 0:
            share[count - 1] = min(before + width[k], most)
        before = width[k]
        count += 1
    return count, closed


@njit(cache=True, nogil=True)
def beads_along(
    nodes: Any,
    radius: Any,
    runs: Any,
    begins: Any,
    least: float,
    most: float,
    inset: float,
    apart: float,
) -> tuple[Any, Any, Any, Any, float]:
    """Beads along chains of nodes, wherever these are far enough from the walls.

    Parameters
    ----------
    nodes, radius
        (n, 2) places and (n,) distances to the walls.
    runs, begins
        The chains' nodes one after the other, and where each chain begins (with the end).
    least, most
        Widths of a bead.
    inset
        Of the radius: so far from its wall an open bead ends.
    apart
        Of a bead's points.

    Returns
    -------
    tuple
        (p, 2) points of all beads, (p,) the share of the piece from each point on (none from a
        bead's last one), (b + 1,) where each bead begins (with the end), (b,) whether it is closed,
        and the area that all of them stand for.
    """
    most_points = 2 * len(runs)  # of two nodes at least an open bead has two points more
    xy, share = np.empty((most_points, 2)), np.zeros(most_points)
    first, closed = np.zeros(len(runs) + 1, np.int64), np.zeros(len(runs), np.bool_)
    beads, area = 0, 0.0
    for run in range(len(begins) - 1):
        chain = runs[begins[run] : begins[run + 1]]
        n = len(chain)
        points, to_wall, along = np.empty((n, 2)), np.empty(n), np.zeros(n)
        for k in range(n):
            points[k, 0], points[k, 1] = nodes[chain[k], 0], nodes[chain[k], 1]
            to_wall[k] = radius[chain[k]]
            if k > 0:
                step = np.hypot(points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1])
                along[k] = along[k - 1] + step
        wide = wide_enough(along, to_wall, least)
        a = 0
        while a < n:
            b = a
            while b < n and wide[b]:
                b += 1
            if b - a >= 2:
                at = first[beads]
                put, closed[beads] = put_bead(
                    points[a:b], to_wall[a:b], most, inset, apart, xy[at:], share[at:]
                )
                area += area_along(xy[at : at + put], share[at : at + put - 1])
                beads += 1
                first[beads] = at + put
            a = b + 1
    end = first[beads]
    return xy[:end], share[:end], first[: beads + 1], closed[:beads], area
