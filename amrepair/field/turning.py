"""Which side of a broken face is out, where a scan has neither rays nor normals.

The way that surface was seen to face, where surface that faces the other way was not; else down
the winding number; where what comes of it does not close what was seen, whole faces are turned
until it does.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from amrepair.field import turning_kernels as kernels
from amrepair.field.winding import Shell

MOST_TURNS = 12
# Points of one face: their planes are less than 14° askew to each other.
ONE_FACE_COSINE = 0.97
# A crumb that noise tore off goes back to what beside it is askew by less than 45°.
CRUMB_COSINE, JOINING_ROUNDS = 0.7, 4
# Smaller faces than this share of all decide nothing; more than so many are not tried.
LEAST_FACE_RATIO, MOST_FACES = 0.01, 12
# Ways to turn them that close nearly as well, by this share of all area: the least turned is it.
AS_WELL_RATIO = 0.05

# So many directions, and the template's surface within 25° of each. One is the way that the scan
# looks if this share of it was seen, and less than that of what faces the other way.
DIRECTIONS, ALIKE_COSINE = 128, 0.9
LOOKED_AT, LOOKED_AWAY_FROM = 0.5, 0.1


def side_by_view(
    plane: Float[np.ndarray, "q 3"],
    patch_mm2: Float[np.ndarray, "m 3"],
    present: Bool[np.ndarray, " m"],
) -> Float[np.ndarray, " q"]:
    """1 where a plane's normal points to the side that it was seen from, -1 where away, else 0.

    A view shows what faces it: of two sides of a broken face it saw the one that faces as the
    template's seen surface does, not as its unseen.

    Parameters
    ----------
    plane
        Unit normals, either way round.
    patch_mm2, present
        The template's surface as outward normals times area, and which of it was seen.
    """
    k = np.arange(DIRECTIONS) + 0.5
    z, angle = 1.0 - 2.0 * k / DIRECTIONS, np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - z**2)
    way = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    all_mm2, seen_mm2 = kernels.area_by_way(
        np.ascontiguousarray(patch_mm2), present, way, ALIKE_COSINE
    ).T
    seen = np.where(all_mm2 > 0, seen_mm2 / np.maximum(all_mm2, 1e-12), 0.0)
    nearest = (plane @ way.T).argmax(axis=1), (plane @ way.T).argmin(axis=1)
    ahead, behind = seen[nearest[0]], seen[nearest[1]]
    toward = (ahead > LOOKED_AT) & (behind < LOOKED_AWAY_FROM)
    away = (behind > LOOKED_AT) & (ahead < LOOKED_AWAY_FROM)
    return np.asarray(toward.astype(np.float64) - away)


def turned_down(
    place_mm: Float[np.ndarray, "n 3"],
    which: Int[np.ndarray, " q"],
    plane: Float[np.ndarray, "n 3"],
    area_mm2: Float[np.ndarray, " n"],
    neighbours: Int[np.ndarray, "n k"],
    *,
    present_mm: Float[np.ndarray, "m 3"],
    present_mm2: Float[np.ndarray, "m 3"],
    step_mm: float,
    side: Float[np.ndarray, " q"],
) -> Float[np.ndarray, "q 3"]:
    """Planes of the broken faces turned to the side known to be open, or down the winding number.

    First the winding number of the template's surface where it is present, and of the faces whose
    side is known: it falls toward the hole. Then with all faces, until none turns any more.

    Parameters
    ----------
    place_mm, plane, area_mm2, neighbours
        Scanned points, the planes' normals there, either way round, their areas, and who is near.
    which
        Those on broken faces.
    present_mm, present_mm2
        The template's surface that was seen: places and vector areas.
    step_mm
        Before a face and behind it, where the winding number is asked.
    side
        Positive where the side that the plane's normal points to is known to be open, 0 unknown.
    """
    normal, place = np.where(side[:, None] < 0, -1.0, 1.0) * plane[which], place_mm[which]
    sure = side != 0
    known = np.concatenate([present_mm, place[sure]])
    known_vector = np.concatenate([present_mm2, normal[sure] * area_mm2[which[sure], None]])
    shell = Shell.of(known, known_vector)
    place, open_normal = place[~sure], normal[~sure]
    which_open, area_open = which[~sure], area_mm2[which[~sure], None]
    falls = np.zeros_like(place_mm)
    falls[which[sure]] = normal[sure]
    ahead, behind = place + step_mm * open_normal, place - step_mm * open_normal
    # winding numbers add up: what turns is asked for, alone
    drop = shell.winding(behind) - shell.winding(ahead)
    way, laid = np.ones(len(place)), np.zeros(len(place))
    for _ in range(MOST_TURNS if len(place) else 0):
        falls[which_open] = drop[:, None] * open_normal
        # a face is decided as a whole, not point by point
        vote = (falls[neighbours[which_open]].sum(axis=1) * open_normal).sum(axis=1) * way
        if laid.any() and (vote >= 0).all():
            break
        way = np.where(vote < 0, -way, way)
        new = np.flatnonzero(way != laid)
        turned = Shell.of(place[new], (way - laid)[new, None] * open_normal[new] * area_open[new])
        drop += turned.winding(behind) - turned.winding(ahead)
        laid = way
    normal[~sure] = way[:, None] * open_normal
    return np.asarray(normal)


def turned_to_close(
    outward: Float[np.ndarray, "q 3"],
    area_mm2: Float[np.ndarray, " q"],
    sure: Bool[np.ndarray, " q"],
    which: Int[np.ndarray, " q"],
    neighbours: Int[np.ndarray, "n k"],
    *,
    seen_mm2: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "q 3"]:
    """Whole faces turned so that all together close what was seen as nearly as they can.

    The floor over a thin film and the walls around it are faces of their own: either may be the
    wrong way round without the other. Vector areas of a closed surface add up to nothing.

    Parameters
    ----------
    outward, area_mm2
        Normals of broken faces and areas, point by point.
    sure
        Whose side is known: a face of which most is sure stays.
    which, neighbours
        As for `turned_down`.
    seen_mm2
        Vector area of the template's surface that stands for sure.
    """
    beside = _rank(which, len(neighbours))[neighbours[which]]
    links = _links(outward, beside)
    count, face = connected_components(links, directed=False)
    agreed = _agreeing(outward, area_mm2, links, face)
    face, agreed = _crumbs_joined(face, agreed, area_mm2, beside)
    vectors = agreed * area_mm2[:, None]
    by_face = np.stack([np.bincount(face, vectors[:, k], minlength=count) for k in range(3)], 1)
    size = np.bincount(face, area_mm2, minlength=count)
    fixed = np.bincount(face, area_mm2 * sure, minlength=count) > 0.5 * size
    order = np.argsort(-size)
    free = order[(size[order] >= LEAST_FACE_RATIO * size.sum()) & ~fixed[order]][:MOST_FACES]
    ways = (np.arange(2 ** len(free))[:, None] >> np.arange(len(free))) & 1
    left = seen_mm2 + by_face.sum(axis=0) - 2.0 * ways @ by_face[free]
    open_mm2 = np.linalg.norm(left, axis=1)
    as_well = open_mm2 <= open_mm2.min() + AS_WELL_RATIO * size.sum()
    way = np.flatnonzero(as_well)[np.argmin((ways @ size[free])[as_well])]
    turn = np.ones(count)
    turn[free[ways[way] == 1]] = -1.0
    return np.asarray(agreed * turn[face][:, None])


def _rank(which: Int[np.ndarray, " q"], count: int) -> Int[np.ndarray, " n"]:
    """Of each of `count` points its place in `which`, or -1."""
    rank = np.full(count, -1, np.int64)
    rank[which] = np.arange(len(which))
    return rank


def _links(normal: Float[np.ndarray, "q 3"], beside: Int[np.ndarray, "q k"]) -> csr_matrix:
    """Points that are near each other on one face."""
    one, other = np.repeat(np.arange(len(beside)), beside.shape[1]), beside.ravel()
    one, other = one[other >= 0], other[other >= 0]
    kept = np.abs((normal[one] * normal[other]).sum(axis=1)) > ONE_FACE_COSINE
    shape = (len(beside), len(beside))
    return csr_matrix((np.ones(kept.sum()), (one[kept], other[kept])), shape=shape)


def _crumbs_joined(
    face: Int[np.ndarray, " q"],
    normal: Float[np.ndarray, "q 3"],
    area_mm2: Float[np.ndarray, " q"],
    beside: Int[np.ndarray, "q k"],
) -> tuple[Int[np.ndarray, " q"], Float[np.ndarray, "q 3"]]:
    """What noise tore off a face goes back to it: to the point beside it that is most alike."""
    large = np.bincount(face, area_mm2) >= LEAST_FACE_RATIO * area_mm2.sum()
    face, normal, joined = face.copy(), normal.copy(), large[face]
    for _ in range(JOINING_ROUNDS):
        loose = np.flatnonzero(~joined)
        near = beside[loose]
        alike = np.einsum("qki,qi->qk", normal[near], normal[loose])
        alike = np.where((near >= 0) & joined[near], alike, 0.0)
        best = np.argmax(np.abs(alike), axis=1)
        rows = np.arange(len(loose))
        most = alike[rows, best]
        found = np.abs(most) > CRUMB_COSINE
        mine, to = loose[found], near[rows, best][found]
        face[mine] = face[to]
        normal[mine] *= np.sign(most[found])[:, None]
        joined[mine] = True
    return face, normal


def _agreeing(
    outward: Float[np.ndarray, "q 3"],
    area_mm2: Float[np.ndarray, " q"],
    links: csr_matrix,
    face: Int[np.ndarray, " q"],
) -> Float[np.ndarray, "q 3"]:
    """Normals turned alike from neighbour to neighbour, each face the way most of its area was."""
    both = (links + links.T).tocsr()
    sign = kernels.signs_from_neighbours(both.indptr, both.indices, outward)
    most = np.bincount(face, sign * area_mm2)
    return np.asarray(outward * (sign * np.where(most < 0, -1.0, 1.0)[face])[:, None])
