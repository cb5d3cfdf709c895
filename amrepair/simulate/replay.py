"""A recorded scanner's residuals laid over an ideal scan, in pieces as large as fit.

The scan's image plane is cut into blocks. A piece is a recorded view, shifted, and turned by
quarters or mirrored; every block that meets recorded cells of its kind (by an edge, or away from
it; a like angle of incidence) takes their residuals as they are. Piece after piece, each begun at a
block that has none yet, until all have one: over the width of a piece errors hang together as they
did (quilting of images, Efros and Freeman 2001, without blending, which would thin the tails).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from amrepair.arrays import Numbers, PlanePoints, Points, Values, Vector
from amrepair.field.groups import cell_numbers
from amrepair.frames import unit_vectors
from amrepair.simulate.options import DEFAULT_REPLAY
from amrepair.simulate.recording import Recording, edge_distance_mm


@dataclass(frozen=True, slots=True)
class _Kind:
    """The recorded cells by an edge, or those away from it.

    `nearest` (2, k, ny, nx) is the next such cell of any place in a view, `reach_mm` and `cosine`
    (k, ny, nx) what a block around it finds on average; `cells` (m, 3) are ordered by their cosine.
    """

    nearest: Int[np.ndarray, "2 k ny nx"]
    reach_mm: Float[np.ndarray, "k ny nx"]
    cosine: Float[np.ndarray, "k ny nx"]
    cells: Int[np.ndarray, "m 3"]
    ordered: Float[np.ndarray, " m"]


@dataclass(frozen=True, slots=True)
class _Blocks:
    """Blocks of a scan's image plane: middle (m, 2), mean cosine, share of points by an edge."""

    middle_mm: Float[np.ndarray, "m 2"]
    cosine: Float[np.ndarray, " m"]
    edge_share: Float[np.ndarray, " m"]


@dataclass(frozen=True, slots=True)
class _Piece:
    """A recorded view laid over the image plane: cell (view, row, column) at `origin_mm`."""

    turn: Int[np.ndarray, "2 2"]
    cell: Int[np.ndarray, " 3"]
    origin_mm: Float[np.ndarray, " 2"]


class Replay:
    """Draws residuals and shifts of a recorded scanner.

    Parameters
    ----------
    recording
        Of a real scanner.
    """

    def __init__(self, recording: Recording) -> None:
        self._pitch_mm = recording.pitch_mm
        self._offset_mm = recording.offset_mm
        self._residual_mm = recording.residual_mm
        known = np.isfinite(recording.residual_mm)
        by_edge = known & (recording.edge_mm < DEFAULT_REPLAY.spot_edge_mm)
        away = known & ~by_edge
        found = [_kind(recording, mask) for mask in (away, by_edge)]
        # A recording without edges says nothing about them.
        any_kind = next(kind for kind in found if kind is not None)
        self._kinds = [kind or any_kind for kind in found]

    def errors_mm(
        self,
        points_mm: Points,
        normals: Points,
        sensor_mm: Vector,
        *,
        spacing_mm: float,
        rng: np.random.Generator,
    ) -> Points:
        """(n, 3) errors of one view: residuals along the surface's normals, and one shift.

        Parameters
        ----------
        points_mm, normals
            What a sensor without error sees.
        sensor_mm
            Where it is.
        spacing_mm
            Distance of neighbouring points, at most.
        """
        if not len(points_mm):
            return np.zeros((0, 3))
        inward = points_mm.mean(axis=0) - sensor_mm
        inward /= np.linalg.norm(inward)
        aside = np.cross(inward, np.eye(3)[np.argmin(np.abs(inward))])
        aside /= np.linalg.norm(aside)
        frame = np.stack([aside, np.cross(aside, inward), -inward])  # the view's own axes
        seen = (points_mm - sensor_mm) @ frame.T
        rays = unit_vectors(points_mm - sensor_mm)
        cosine = np.clip(-np.einsum("ij,ij->i", rays, normals), 0.0, 1.0)
        cell_mm = 2.0 * max(self._pitch_mm, spacing_mm)
        edge_mm = edge_distance_mm(seen[:, :2], seen[:, 2], cell_mm)
        residual = self.residual_mm(seen[:, :2], cosine, edge_mm, rng)
        mirrored = np.array([rng.choice((-1.0, 1.0)), rng.choice((-1.0, 1.0)), 1.0])
        shift = mirrored * self._offset_mm[rng.integers(len(self._offset_mm))]
        return np.asarray(residual[:, None] * normals + shift @ frame)

    def residual_mm(
        self, plane_mm: PlanePoints, cosine: Values, edge_mm: Values, rng: np.random.Generator
    ) -> Values:
        """(n,) recorded residuals for points of an image plane, by incidence and edges."""
        by_edge = (edge_mm < DEFAULT_REPLAY.spot_edge_mm).astype(np.int64)
        shifted = (plane_mm - plane_mm.min(axis=0)) / DEFAULT_REPLAY.block_mm + rng.random(2)
        block = cell_numbers(np.floor(shifted).astype(np.int64))
        count = np.bincount(block)
        wanted = _Blocks(
            np.stack([np.bincount(block, plane_mm[:, k]) / count for k in range(2)], axis=1),
            np.bincount(block, cosine) / count,
            np.bincount(block, by_edge) / count,
        )
        # Points are sorted by block, so that a block's points lie together.
        order, ends = np.argsort(block, kind="stable"), np.cumsum(count)
        out, left = np.zeros(len(plane_mm)), np.ones(len(count), dtype=bool)
        while left.any():
            todo = np.flatnonzero(left)
            first = int(todo[rng.integers(len(todo))])
            kind = self._kinds[int(wanted.edge_share[first] > 0.5)]
            pieces = [
                _Piece(
                    _turned(rng), _like(kind, wanted.cosine[first], rng), wanted.middle_mm[first]
                )
                for _ in range(DEFAULT_REPLAY.tries)
            ]
            fits = [self._met(piece, wanted, todo) for piece in pieces]
            best = int(np.argmax([count[todo[fit]].sum() for fit in fits]))
            taken = np.union1d(todo[fits[best]], [first])
            left[taken] = False
            points = np.concatenate([order[ends[b] - count[b] : ends[b]] for b in taken])
            view, row, column = self._cells(pieces[best], plane_mm[points])
            for k, kind in enumerate(self._kinds):
                mine = by_edge[points] == k
                near = kind.nearest[:, view, row[mine], column[mine]]
                out[points[mine]] = self._residual_mm[view, *near]
        return out

    def _met(
        self, piece: _Piece, wanted: _Blocks, todo: Int[np.ndarray, " m"]
    ) -> Bool[np.ndarray, " m"]:
        """(m,) which blocks meet cells of their kinds and incidence."""
        view, row, column = self._cells(piece, wanted.middle_mm[todo])
        fits = np.ones(len(todo), dtype=bool)
        for k, kind in enumerate(self._kinds):
            share = wanted.edge_share[todo] if k else 1.0 - wanted.edge_share[todo]
            fits &= (kind.reach_mm[view, row, column] <= DEFAULT_REPLAY.near_mm[k]) | (
                share < DEFAULT_REPLAY.least_share
            )
        cosine = self._kinds[0].cosine[view, row, column]
        return np.asarray(
            fits & (np.abs(cosine - wanted.cosine[todo]) <= DEFAULT_REPLAY.similar_cosine)
        )

    def _cells(self, piece: _Piece, plane_mm: PlanePoints) -> tuple[int, Numbers, Numbers]:
        """View, rows and columns that places of the image plane lie on; at its border outside."""
        view, row, column = (int(value) for value in piece.cell)
        step = np.rint((plane_mm - piece.origin_mm) @ piece.turn.T / self._pitch_mm)
        ny, nx = self._residual_mm.shape[1:]
        rows = np.clip(step[:, 1].astype(np.int64) + row, 0, ny - 1)
        columns = np.clip(step[:, 0].astype(np.int64) + column, 0, nx - 1)
        return view, rows, columns


def _kind(recording: Recording, mask: Bool[np.ndarray, "k ny nx"]) -> _Kind | None:
    """Maps of a kind of cells; None where a recording has none."""
    if not mask.any():
        return None
    pitch = recording.pitch_mm
    size = max(1, round(DEFAULT_REPLAY.block_mm / pitch))
    nearest = np.zeros((2, *mask.shape), dtype=np.int32)
    reach = np.full(mask.shape, np.inf)
    cosine = np.zeros(mask.shape)
    for k, there in enumerate(mask):
        if not there.any():
            continue
        away, nearest[:, k] = ndimage.distance_transform_edt(~there, return_indices=True)
        # Beyond the raster there is nothing: places clipped to its border hit nothing.
        reach[k] = ndimage.uniform_filter(
            away * pitch, size, mode="constant", cval=DEFAULT_REPLAY.block_mm
        )
        reach[k][[0, -1]], reach[k][:, [0, -1]] = np.inf, np.inf
        value = recording.cosine[k][nearest[0, k], nearest[1, k]]
        cosine[k] = ndimage.uniform_filter(value.astype(np.float64), size, mode="nearest")
    cells = np.argwhere(mask)
    values = cosine[tuple(cells.T)]
    order = np.argsort(values, kind="stable")
    return _Kind(nearest, reach, cosine, cells[order], values[order])


def _like(kind: _Kind, cosine: float, rng: np.random.Generator) -> Int[np.ndarray, " 3"]:
    """A recorded cell of a like angle of incidence; of the next where there is none."""
    low, high = np.searchsorted(
        kind.ordered,
        [cosine - DEFAULT_REPLAY.similar_cosine, cosine + DEFAULT_REPLAY.similar_cosine],
    )
    if low == high:
        low = min(max(int(low) - 1, 0), len(kind.ordered) - 1)
        high = low + 1
    return np.asarray(kind.cells[rng.integers(low, high)])


def _turned(rng: np.random.Generator) -> Int[np.ndarray, "2 2"]:
    """One of the eight ways to lay a square on itself."""
    turn = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), int(rng.integers(4)))
    return np.asarray(turn @ np.diag([rng.choice((-1, 1)), 1]))
