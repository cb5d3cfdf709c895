"""`GridSdf`: exact distances to a mesh on an adaptive grid: coarse, finer blocks where it bends.

Nothing in it is learned (`learned.LearnedSdf` is). One safetensors file with JSON metadata (units,
frame, recipe, hashes, versions); never pickle. It answers without torch. Fitting is `fit`'s
business.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from amrepair.arrays import Mask, Points, Values, Vector, Voxels
from amrepair.errors import TemplateError
from amrepair.frames import cells_of, diagonal, unit_vectors
from amrepair.template import trilinear_kernels as kernels
from amrepair.template.file import (
    read_template,
    require_kind,
    stored_mesh,
    stored_metadata,
    write_template,
)
from amrepair.template.shape import MeshShape
from gcode.compiled import read_only

if TYPE_CHECKING:
    import trimesh

GRID_KIND = "grid"
_ARRAYS = ("base", "cells", "blocks", "vertices_mm", "faces")


@dataclass(frozen=True, slots=True)
class Grid:
    """Numbers of a fast field: exact distances at the nodes of a grid, finer where it bends.

    Attributes
    ----------
    origin_mm, cell_mm
        Corner and edge of the coarse grid, template frame.
    base
        (x, y, z) distances at its nodes, float32.
    block_of
        (x-1, y-1, z-1) number of the block in each cell, −1 where the coarse grid is good enough.
    blocks
        (b, r+1, r+1, r+1) distances at the nodes that divide a cell into r³, float32.
    """

    origin_mm: Vector
    cell_mm: float
    base: Voxels
    block_of: Int[np.ndarray, "_x _y _z"]
    blocks: Float[np.ndarray, "b r r r"]

    @classmethod
    def bare(cls, origin_mm: Vector, cell_mm: float, base: Voxels) -> Grid:
        """The coarse grid alone."""
        return cls.refined(
            origin_mm, cell_mm, base, np.zeros((0, 3), np.int64), np.zeros((0, 2, 2, 2))
        )

    @classmethod
    def refined(
        cls,
        origin_mm: Vector,
        cell_mm: float,
        base: Voxels,
        cells: Int[np.ndarray, "b 3"],
        blocks: Float[np.ndarray, "b r r r"],
    ) -> Grid:
        """The coarse grid with blocks in the cells named."""
        block_of = np.full(tuple(n - 1 for n in base.shape), -1, dtype=np.int32)
        block_of[tuple(cells.T)] = np.arange(len(cells))
        return cls(
            np.array(origin_mm, dtype=np.float64),
            float(cell_mm),
            np.ascontiguousarray(base, dtype=np.float32),
            block_of,
            np.ascontiguousarray(blocks, dtype=np.float32),
        )

    @property
    def cells(self) -> Int[np.ndarray, "b 3"]:
        """(b, 3) cells that have blocks, in the blocks' order."""
        which = np.argwhere(self.block_of >= 0)
        found = np.empty_like(which)
        found[self.block_of[tuple(which.T)]] = which
        return found

    def cell_of(self, points_mm: Points) -> Int[np.ndarray, "n 3"]:
        """(n, 3) indices of the coarse cells that hold the points, or the nearest ones."""
        index = cells_of(points_mm, self.origin_mm, self.cell_mm)
        return np.clip(index, 0, np.array(self.block_of.shape) - 1)

    def distance(self, points_mm: Points) -> Values:
        """(n,) signed distance, mm."""
        points = read_only(points_mm, np.float64)
        return np.asarray(kernels.evaluate(points, *self.numbers))

    def distance_and_gradient(self, points_mm: Points) -> tuple[Values, Points]:
        """(n,) signed distance, mm, and (n, 3) its gradient within the cell."""
        points = read_only(points_mm, np.float64)
        distance, gradient = kernels.evaluate_with_gradient(points, *self.numbers)
        return np.asarray(distance), np.asarray(gradient)

    @property
    def numbers(self) -> tuple[Any, ...]:
        """What compiled code asks the field with (`trilinear_kernels.field_at`)."""
        return self.origin_mm, self.cell_mm, self.base, self.block_of, self.blocks


@dataclass(frozen=True)
class Coverage:
    """Where nobody knows what the part's surface is like: no scan of it looked there.

    Pieces of the surface, each seen or not: a place is what the nearest piece is. The other side
    of a thin wall is another place: pieces that face apart count as so much farther apart.

    Attributes
    ----------
    place_mm, normal
        (k, 3) middles of pieces and (k, 3) outward unit normals, template frame: all that nobody
        saw, and those that were seen near them.
    unseen
        (k,) whether nobody saw it.
    reach_mm
        A place farther from a piece says nothing of it; so far apart are pieces of one place that
        face opposite ways, so that neither tells of the other.
    unseen_mm2
        Area that nobody saw.
    """

    place_mm: Float[np.ndarray, "k 3"]
    normal: Float[np.ndarray, "k 3"]
    unseen: Bool[np.ndarray, " k"]
    reach_mm: float
    unseen_mm2: float

    @classmethod
    def of(
        cls, places_mm: Points, normals: Points, area_mm2: Values, unseen: Mask, reach_mm: float
    ) -> Coverage:
        """Of all pieces of a surface: where, how each faces, how large it is, whether unseen.

        `reach_mm`: several times as far as pieces lie apart.
        """
        pieces = surface_elements(places_mm, normals, reach_mm)
        far = cKDTree(pieces[unseen]).query(pieces, distance_upper_bound=2.0 * reach_mm)[0]
        kept = np.isfinite(far)
        unseen_mm2 = float(area_mm2[unseen].sum())
        return cls(places_mm[kept], normals[kept], unseen[kept], reach_mm, unseen_mm2)

    @cached_property
    def _trees(self) -> tuple[cKDTree, cKDTree, cKDTree]:
        """Of pieces that were seen, of those that were not, and of the latter's places alone."""
        pieces = surface_elements(self.place_mm, self.normal, self.reach_mm)
        return (
            cKDTree(pieces[~self.unseen]),
            cKDTree(pieces[self.unseen]),
            cKDTree(self.place_mm[self.unseen]),
        )

    def unknown_at(self, points_mm: Points, f_mm: Values, outward: Points) -> Mask:
        """(n,) whether nobody knows the surface that places near it are told by.

        It is the piece at a place's foot; and where one that nobody saw, and that is a guess, lies
        nearer to that than the place does, the true surface may pass through the place.

        Parameters
        ----------
        f_mm, outward
            The template's distance there, and its unit gradient.
        """
        feet_mm = points_mm - f_mm[:, None] * outward
        seen, unseen, guess = self._trees
        asked = surface_elements(feet_mm, outward, self.reach_mm)
        to_unseen = unseen.query(asked, distance_upper_bound=self.reach_mm, workers=-1)[0]
        found = np.isfinite(to_unseen)
        to_seen = seen.query(asked[found], distance_upper_bound=self.reach_mm, workers=-1)[0]
        found[found] = to_unseen[found] <= to_seen
        rest = np.flatnonzero(~found)
        to_guess = guess.query(feet_mm[rest], workers=-1)[0]
        found[rest] = to_guess <= np.abs(f_mm[rest])
        return np.asarray(found)

    def to_guess_mm(self, points_mm: Points) -> Values:
        """(n,) how far it is to surface that nobody saw, and that is a guess; inf without any."""
        return np.asarray(self._trees[2].query(points_mm, workers=-1)[0], np.float64)


def surface_elements(
    places_mm: Points, normals: Points, reach_mm: float
) -> Float[np.ndarray, "n 6"]:
    """(n, 6) places with how they face: opposite ways they lie `reach_mm` apart at least."""
    return np.hstack([places_mm, 0.5 * reach_mm * normals])


@dataclass(frozen=True, slots=True)
class GridSdf(MeshShape):
    """The field of a mesh, as exact as its grid is fine (`Template`).

    Attributes
    ----------
    mesh
        The closed mesh that it was fitted to.
    bias_mm
        99th percentile of |f| on points of the surface that fitting never asked.
    metadata
        Recipe, hashes, seed, versions.
    coverage
        Of templates whose surface is not known everywhere.
    """

    grid: Grid
    mesh: trimesh.Trimesh
    bias_mm: float
    metadata: dict[str, str] = field(default_factory=dict)
    coverage: Coverage | None = None

    def distance(self, points_mm: Points) -> Values:
        """(n,) signed distance, mm, negative inside."""
        return self.grid.distance(points_mm)

    def distance_and_gradient(self, points_mm: Points) -> tuple[Values, Points]:
        """(n,) signed distance and (n, 3) its gradient."""
        return self.grid.distance_and_gradient(points_mm)

    def spread_mm(self, points_mm: Points) -> Values:
        """(n,) standard deviation between normal parts: the part's size where nobody knows."""
        found = self._told_spread_mm(points_mm)
        if self.coverage is not None:
            f_mm, gradient = self.distance_and_gradient(points_mm)
            unknown = self.coverage.unknown_at(points_mm, f_mm, unit_vectors(gradient))
            found = np.where(unknown, diagonal(self.bounds_mm), found)
        return found

    def _told_spread_mm(self, points_mm: Points) -> Values:
        """(n,) what scans say of the spread: none was asked."""
        return np.zeros(len(points_mm))

    @property
    def grid_numbers(self) -> tuple[Any, ...]:
        """The field as compiled code asks it (`OnGrid`)."""
        return self.grid.numbers

    def save(self, path: Path) -> None:
        """Write the template's file, whole or not at all."""
        write_template(path, *self._packed())

    def _packed(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """What the file holds: arrays and head."""
        arrays = {
            "base": self.grid.base,
            "cells": self.grid.cells.astype(np.int32),
            "blocks": self.grid.blocks,
            "vertices_mm": np.asarray(self.mesh.vertices, dtype=np.float64),
            "faces": np.asarray(self.mesh.faces, dtype=np.int32),
        }
        head = {
            "kind": GRID_KIND,
            "origin_mm": self.grid.origin_mm.tolist(),
            "cell_mm": self.grid.cell_mm,
            "bias_mm": self.bias_mm,
            **self.metadata,
        }
        if self.coverage is not None:
            arrays["coverage_mm"] = self.coverage.place_mm.astype(np.float32)
            arrays["coverage_normal"] = self.coverage.normal.astype(np.float32)
            arrays["coverage_unseen"] = self.coverage.unseen.astype(np.uint8)
            head["coverage_reach_mm"] = self.coverage.reach_mm
            head["unseen_mm2"] = self.coverage.unseen_mm2
        return arrays, head

    @classmethod
    def load(cls, path: Path) -> GridSdf:
        """Read a template's file.

        Raises
        ------
        TemplateError
            If it is missing, truncated, or no template of ours.
        """
        return cls.unpacked(Path(path), *read_template(Path(path)))

    @classmethod
    def unpacked(cls, path: Path, arrays: dict[str, np.ndarray], head: dict[str, Any]) -> GridSdf:
        """The template in a file's arrays and head."""
        return cls(**stored_grid(path, arrays, head, GRID_KIND))


def stored_grid(
    path: Path, arrays: dict[str, np.ndarray], head: dict[str, Any], kind: str
) -> dict[str, Any]:
    """The attributes of a `GridSdf` in the arrays and head of a file of that kind."""
    require_kind(path, head.get("kind", GRID_KIND), kind)
    if not set(_ARRAYS) <= set(arrays):
        raise TemplateError(f"{path} lacks parts of a template; fit it again")
    grid = Grid.refined(
        np.array(head["origin_mm"], dtype=np.float64),
        float(head["cell_mm"]),
        arrays["base"],
        arrays["cells"].astype(np.int64),
        arrays["blocks"],
    )
    return {
        "grid": grid,
        "mesh": stored_mesh(path, arrays),
        "bias_mm": float(head["bias_mm"]),
        "metadata": stored_metadata(head),
        "coverage": _stored_coverage(arrays, head),
    }


def _stored_coverage(arrays: dict[str, np.ndarray], head: dict[str, Any]) -> Coverage | None:
    if "coverage_unseen" in arrays:
        place, normal = (
            arrays[name].astype(np.float64) for name in ("coverage_mm", "coverage_normal")
        )
        unseen, reach_mm = arrays["coverage_unseen"].astype(bool), head["coverage_reach_mm"]
    elif "unseen" in arrays:  # of earlier versions: cells, with a layer of cells around them
        around = arrays["unseen"].astype(bool)
        cells = np.argwhere(around)
        unseen = ndimage.binary_erosion(around, np.ones((3, 3, 3)))[around]
        reach_mm = 2.0 * float(head["unseen_cell_mm"])
        place = np.array(head["unseen_origin_mm"]) + 0.5 * reach_mm * (cells + 0.5)
        normal = np.zeros_like(place)
    else:
        return None
    return Coverage(place, normal, unseen, float(reach_mm), float(head["unseen_mm2"]))
