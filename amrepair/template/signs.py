"""Inside or outside of many nodes of a grid from few rays.

A ball about a node, as large as its distance, holds no surface: neighbours within it lie on the
node's own side. So a side is asked where the surface passes between nodes, and a few times for
each region that it does not reach. It measures no distances.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from amrepair.arrays import Mask, Points, Vector, Voxels
from amrepair.template.signs_kernels import spread

ASKED = 9  # of a region, evenly: rays that graze edges are outvoted
SLACK = 1.0 + 1e-5  # distances are single precision

Inside = Callable[[Points], Mask]


def signed_grid(size_mm: Voxels, origin_mm: Vector, cell_mm: float, inside: Inside) -> Voxels:
    """(x, y, z) distances of a grid's nodes, negative inside.

    Parameters
    ----------
    size_mm
        (x, y, z) their sizes.
    inside
        Whether points lie inside, template frame.
    """
    free = size_mm > SLACK * cell_mm
    region, count = ndimage.label(free)
    side = np.zeros(count + 1, dtype=np.int8)
    if count:
        side[1:] = _sides(region, count, origin_mm, cell_mm, inside)
    known = side[region]
    for axis in range(3):
        for way in (1, -1):
            beside = np.roll(known * free, way, axis=axis)
            edge: list[slice | int] = [slice(None)] * 3
            edge[axis] = 0 if way == 1 else -1
            beside[tuple(edge)] = 0
            known = np.where(known == 0, beside, known)
    rest = np.argwhere(known == 0)
    known[tuple(rest.T)] = np.where(inside(origin_mm + cell_mm * rest), -1, 1)
    return np.asarray(size_mm * known)


def _sides(
    region: Int[np.ndarray, "x y z"], count: int, origin_mm: Vector, cell_mm: float, inside: Inside
) -> Int[np.ndarray, " k"]:
    """(k,) −1 or 1 for each region, by the majority of a few of its nodes."""
    flat = region.ravel()
    nodes = np.flatnonzero(flat)
    nodes = nodes[np.argsort(flat[nodes], kind="stable")]
    many = np.bincount(flat[nodes], minlength=count + 1)[1:]
    first = np.concatenate([[0], np.cumsum(many)[:-1]])
    share = (np.arange(ASKED) + 0.5) / ASKED
    pick = nodes[first[:, None] + (share * many[:, None]).astype(np.int64)]
    index = np.stack(np.unravel_index(pick.ravel(), region.shape), axis=1)
    votes = inside(origin_mm + cell_mm * index).reshape(count, ASKED)
    return np.where(votes.mean(axis=1) > 0.5, -1, 1).astype(np.int8)


def signs_in_blocks(
    size_mm: Float[np.ndarray, "b r r r"],
    corner_sign: Int[np.ndarray, "b 2 2 2"],
    step_mm: float,
) -> Int[np.ndarray, "b r r r"]:
    """(b, r, r, r) −1 or 1 as far as the corners' signs reach, 0 where a side must be asked."""
    last = size_mm.shape[1] - 1
    known = np.zeros(size_mm.shape, dtype=np.int8)
    known[:, ::last, ::last, ::last] = corner_sign
    spread(np.ascontiguousarray(size_mm, dtype=np.float32), known, np.float32(SLACK * step_mm))
    return known
