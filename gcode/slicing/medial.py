"""Beads of variable width along the medial axis of what is too thin for two rings.

The axis is the part of the Voronoi diagram of boundary samples whose two nearest walls face each
other. Widths follow the distance to them; what is narrower than the least bead is said, not lost.

References
----------
T. Kuipers et al., "A framework for adaptive width control of dense contour-parallel toolpaths in
fused deposition modeling", Computer-Aided Design 128 (2020): why width must vary along the axis.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import Delaunay, QhullError

from gcode.moves import Role
from gcode.slicing import infill_kernels as kernels
from gcode.slicing.beads import Bead
from gcode.slicing.regions import flattened

FACING_RATIO = 1.5  # feet further apart than 1.5 r: walls meeting at less than 97° face each other
END_INSET_RATIO = 0.5  # of r: an open bead ends r/2 short of the wall, its round cap fills the rest
_LEAST_SAMPLES = 8
ASIDE_MM = 1e-5
FAR_MM = 1e9  # where a triangle without area has its centre


@dataclass(frozen=True, slots=True)
class ThinFill:
    """Beads in a thin region, and the area that no bead can serve."""

    beads: tuple[Bead, ...]
    lost_mm2: float


def fill_thin(region: Any, *, least_mm: float, most_mm: float, sample_mm: float = 0.12) -> ThinFill:
    """Beads along the medial axis of one connected thin region.

    Parameters
    ----------
    region
        A connected cross-section nowhere wider than about `most_mm`.
    least_mm, most_mm
        Limits of a bead's share (half a nozzle to two of them).
    """
    area_mm2 = float(region.area())
    contours = [np.asarray(c, np.float64) for c in region.to_polygons()]
    chains = [
        piece
        for chain in _axis(region, contours, sample_mm)
        for piece in _long_enough(*chain, least_mm)
    ]
    if not chains:
        return _stroke(contours, area_mm2, least_mm=least_mm, most_mm=most_mm)
    beads = [_bead(points, radius, most_mm) for points, radius in chains]
    laid_mm2 = sum(bead.area_mm2 for bead in beads)
    # what narrower stretches hold cannot be told from rounding in the sum: measure it by the
    # bead's reach; a factor beyond a quarter means area without axis
    factor = area_mm2 / laid_mm2 if laid_mm2 > 0 else 1.0
    applied = min(max(factor, 0.75), 1.25)
    lost_mm2 = max(0.0, area_mm2 - laid_mm2 * applied)
    scaled = [_capped(bead.scaled(applied), most_mm) for bead in beads]
    return ThinFill(tuple(scaled), lost_mm2)


def _capped(bead: Bead, most_mm: float) -> Bead:
    return Bead(bead.xy_mm, np.minimum(bead.share_mm, most_mm), bead.role, bead.closed)


def _stroke(
    contours: list[Float[np.ndarray, "_n 2"]], area_mm2: float, *, least_mm: float, most_mm: float
) -> ThinFill:
    """One straight stroke through a region that is about as long as wide: a dot."""
    points = max(contours, key=len)
    centre = points.mean(axis=0)
    # direction of the longest chord through the corners
    _, _, axes = np.linalg.svd(points - centre, full_matrices=False)
    along = (points - centre) @ axes[0]
    across = (points - centre) @ axes[1]
    length_mm, breadth_mm = float(np.ptp(along)), float(np.ptp(across))
    if min(length_mm, breadth_mm) < least_mm or area_mm2 < least_mm * least_mm:
        return ThinFill((), area_mm2)
    middle = centre + axes[0] * 0.5 * (along.max() + along.min())
    middle = middle + axes[1] * 0.5 * (across.max() + across.min())
    run_mm = max(length_mm - 0.5 * breadth_mm, area_mm2 / most_mm)
    xy = middle + np.array([[-0.5], [0.5]]) * run_mm * axes[0]
    share_mm = area_mm2 / run_mm
    return ThinFill((Bead(xy, np.array([share_mm]), Role.GAP_FILL, closed=False),), 0.0)


def _samples(
    contours: list[Float[np.ndarray, "_n 2"]], sample_mm: float
) -> tuple[Float[np.ndarray, "n 2"], Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Boundary points, the contour of each, and its place along it."""
    points, owner, place = [], [], []
    for c, contour in enumerate(contours):
        edges = np.roll(contour, -1, axis=0) - contour
        n = np.maximum(1, np.ceil(np.hypot(*edges.T) / sample_mm).astype(np.int64))
        index = np.repeat(np.arange(len(contour)), n)
        step = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
        points.append(contour[index] + edges[index] * ((step + 0.5) / n[index])[:, None])
        owner.append(np.full(len(index), c))
        place.append(np.arange(len(index)))
    return np.concatenate(points), np.concatenate(owner), np.concatenate(place)


def _axis(
    region: Any, contours: list[Float[np.ndarray, "_n 2"]], sample_mm: float
) -> list[tuple[Float[np.ndarray, "_k 2"], Float[np.ndarray, " _k"]]]:
    """Chains of the medial axis: points and distances to the walls."""
    samples, owner, place = _samples(contours, sample_mm)
    if len(samples) < _LEAST_SAMPLES:
        return []
    found = _voronoi(samples)
    if found is None:
        return []
    nodes, ends, feet = found
    within = kernels.inside(nodes[:, 0], nodes[:, 1], *flattened(region))
    keep = within[ends[:, 0]] & within[ends[:, 1]]
    ends, feet = ends[keep], feet[keep]
    p, q = samples[feet[:, 0]], samples[feet[:, 1]]
    radius = np.full(len(nodes), np.nan)
    for k in range(2):
        radius[ends[:, k]] = np.hypot(*(nodes[ends[:, k]] - p).T)
    middle = 0.5 * (nodes[ends[:, 0]] + nodes[ends[:, 1]])
    facing = np.hypot(*(p - q).T) >= FACING_RATIO * np.hypot(*(middle - p).T)
    count = np.bincount(owner)
    apart = np.abs(place[feet[:, 0]] - place[feet[:, 1]])
    same = owner[feet[:, 0]] == owner[feet[:, 1]]
    ring = count[owner[feet[:, 0]]]
    beside = same & (np.minimum(apart, ring - apart) <= 1)
    ends = ends[facing & ~beside]
    return _chains(ends, nodes, radius)


def _voronoi(
    samples: Float[np.ndarray, "n 2"],
) -> tuple[Float[np.ndarray, "t 2"], Int[np.ndarray, "m 2"], Int[np.ndarray, "m 2"]] | None:
    """Vertices of the Voronoi diagram, its finite ridges, and the two samples beside each.

    From the Delaunay triangles: `scipy.spatial.Voronoi` takes two to five times as long. Samples
    on one circle, of which parallel walls have many, slow qhull down, so they are moved by far
    less than a contour is known.
    """
    moved = samples + np.random.default_rng(0).uniform(-ASIDE_MM, ASIDE_MM, samples.shape)
    try:
        triangles = Delaunay(moved)
    except (QhullError, ValueError):
        return None
    corners, across = triangles.simplices.astype(np.int64), triangles.neighbors.astype(np.int64)
    a, b, c = (moved[corners[:, k]] for k in range(3))
    u, v = b - a, c - a
    twice = 2.0 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    twice = np.where(twice == 0.0, np.finfo(float).tiny, twice)
    uu, vv = (u * u).sum(axis=1), (v * v).sum(axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        x = (v[:, 1] * uu - u[:, 1] * vv) / twice
        y = (u[:, 0] * vv - v[:, 0] * uu) / twice
    nodes = a + np.nan_to_num(np.column_stack([x, y]), nan=FAR_MM, posinf=FAR_MM, neginf=-FAR_MM)
    one, k = np.nonzero(across > np.arange(len(corners))[:, None])
    feet = np.column_stack([corners[one, (k + 1) % 3], corners[one, (k + 2) % 3]])
    return nodes, np.column_stack([one, across[one, k]]), feet


def _chains(
    edges: Int[np.ndarray, "m 2"], nodes: Float[np.ndarray, "n 2"], radius: Float[np.ndarray, " n"]
) -> list[tuple[Float[np.ndarray, "_k 2"], Float[np.ndarray, " _k"]]]:
    """Edges joined into chains, straight on through junctions, spurs pruned."""
    links: dict[int, list[int]] = defaultdict(list)
    for a, b in edges.tolist():
        if a != b:
            links[a].append(b)
            links[b].append(a)
    paths = _traced(links)
    length = [float(np.hypot(*np.diff(nodes[path], axis=0).T).sum()) for path in paths]
    kept = []
    for path, long_mm in zip(paths, length, strict=True):
        leaf = len(links[path[0]]) == 1 or len(links[path[-1]]) == 1
        junction = max((radius[k] for k in (path[0], path[-1]) if len(links[k]) > 2), default=0.0)
        if not (leaf and junction > 0 and long_mm < 1.2 * junction):
            kept.append(path)
    joined = _joined(kept, nodes)
    return [(nodes[path], radius[path]) for path in joined if len(path) > 1]


def _traced(links: dict[int, list[int]]) -> list[list[int]]:
    """Maximal runs through nodes of degree two."""
    seen: set[tuple[int, int]] = set()
    paths: list[list[int]] = []
    starts = [k for k in links if len(links[k]) != 2] + [k for k in links if len(links[k]) == 2]
    for start in starts:
        for step in links[start]:
            if (start, step) in seen:
                continue
            path = [start, step]
            seen |= {(start, step), (step, start)}
            while len(links[path[-1]]) == 2:
                a, b = links[path[-1]]
                nxt = b if a == path[-2] else a
                if (path[-1], nxt) in seen:
                    break
                seen |= {(path[-1], nxt), (nxt, path[-1])}
                path.append(nxt)
            paths.append(path)
    return paths


def _joined(paths: list[list[int]], nodes: Float[np.ndarray, "n 2"]) -> list[list[int]]:
    """Paths merged where they meet, the straightest pair first."""
    paths = [list(p) for p in paths]
    merged = True
    while merged and len(paths) > 1:
        merged = False
        at: dict[int, list[tuple[int, bool]]] = defaultdict(list)
        for i, path in enumerate(paths):
            if path[0] != path[-1]:
                at[path[0]].append((i, True))
                at[path[-1]].append((i, False))
        for members in at.values():
            best = None
            for a in range(len(members)):
                for b in range(a + 1, len(members)):
                    (i, i_head), (j, j_head) = members[a], members[b]
                    if i == j:
                        continue
                    u = _leaving(paths[i], nodes, i_head)
                    v = _leaving(paths[j], nodes, j_head)
                    score = float(u @ v)
                    if best is None or score < best[0]:
                        best = (score, i, i_head, j, j_head)
            if best is not None:
                _, i, i_head, j, j_head = best
                first = paths[i][::-1] if i_head else paths[i]
                second = paths[j] if j_head else paths[j][::-1]
                paths[i] = first + second[1:]
                del paths[j]
                merged = True
                break
    return paths


def _leaving(
    path: list[int], nodes: Float[np.ndarray, "n 2"], head: bool
) -> Float[np.ndarray, " 2"]:
    """Unit direction in which a path leaves its head or tail."""
    run = path if head else path[::-1]
    d = nodes[run[min(3, len(run) - 1)]] - nodes[run[0]]
    return d / max(float(np.hypot(*d)), 1e-12)


def _long_enough(
    points: Float[np.ndarray, "k 2"], radius: Float[np.ndarray, " k"], least_mm: float
) -> list[tuple[Float[np.ndarray, "_j 2"], Float[np.ndarray, " _j"]]]:
    """Stretches where the wall is at least `least_mm` thick."""
    wide = 2 * radius >= least_mm * (1 - 1e-6)
    out = []
    start = None
    for i in range(len(points) + 1):
        if i < len(points) and wide[i]:
            start = i if start is None else start
        elif start is not None:
            if i - start >= 2:
                out.append((points[start:i], radius[start:i]))
            start = None
    return out


def _bead(
    points: Float[np.ndarray, "k 2"], radius: Float[np.ndarray, " k"], most_mm: float
) -> Bead:
    """A smooth bead along a chain, its open ends drawn out to half a radius from the wall."""
    closed = bool(np.allclose(points[0], points[-1], atol=1e-9)) and len(points) > 3
    if not closed:
        head = points[0] - points[min(2, len(points) - 1)]
        tail = points[-1] - points[-min(3, len(points))]
        head = points[0] + head / max(np.hypot(*head), 1e-12) * END_INSET_RATIO * radius[0]
        tail = points[-1] + tail / max(np.hypot(*tail), 1e-12) * END_INSET_RATIO * radius[-1]
        points = np.concatenate([[head], points, [tail]])
        radius = np.concatenate([radius[:1], radius, radius[-1:]])
    points, radius = _thinned(points, radius)
    share = np.minimum(radius[:-1] + radius[1:], most_mm)
    return Bead(points, share, Role.GAP_FILL, closed)


def _thinned(
    points: Float[np.ndarray, "k 2"], radius: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "j 2"], Float[np.ndarray, " j"]]:
    """Points no closer than 0.15 mm, ends kept."""
    keep = [0]
    listed = points.tolist()
    for i in range(1, len(listed) - 1):
        if math.dist(listed[i], listed[keep[-1]]) >= 0.15:
            keep.append(i)
    keep.append(len(listed) - 1)
    return points[keep], radius[keep]
