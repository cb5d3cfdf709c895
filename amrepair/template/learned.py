"""`LearnedSdf`: a template as a file holds it: coarse grid, learned residual, the part's own mesh.

One safetensors file with JSON metadata (units, frame, recipe, hashes, versions); never pickle. It
answers without torch. Fitting is `fit`'s business.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from amrepair.errors import TemplateError
from amrepair.template import learned_kernels as kernels
from amrepair.template.cut import CutTemplate
from amrepair.template.file import (
    read_template,
    require_kind,
    stored_mesh,
    stored_metadata,
    write_template,
)
from amrepair.template.mesh_file import as_manifold
from amrepair.template.port import Template
from amrepair.template.surface import mesh_points

if TYPE_CHECKING:
    import trimesh

KIND = "grid"
# Central differences of the gradient, in coarse cells: wide enough for float32, within an edge.
GRADIENT_CELLS = 0.1
_ARRAYS = ("base", "active", "tables", "w1", "b1", "w2", "b2", "w3", "b3", "vertices_mm", "faces")


@dataclass(frozen=True, slots=True)
class Tables:
    """Numbers of a learned field.

    Attributes
    ----------
    origin_mm, cell_mm
        Corner and edge of the coarse grid, template frame.
    base
        (x, y, z) exact distances at its nodes, float32.
    active
        (x-1, y-1, z-1) cells that the network is asked in.
    level_cells_mm, level_shapes
        (l,) edges and (l, 3) nodes of the feature levels.
    tables
        (l, size, 2) features.
    w1, b1, w2, b2, w3, b3
        The network: 2·l → 32 → 32 → 1, ReLU; its answer is in coarse cells.
    """

    origin_mm: Float[np.ndarray, " 3"]
    cell_mm: float
    base: Float[np.ndarray, "x y z"]
    active: Bool[np.ndarray, "_x _y _z"]
    level_cells_mm: Float[np.ndarray, " l"]
    level_shapes: np.ndarray
    tables: Float[np.ndarray, "l size 2"]
    w1: Float[np.ndarray, "h q"]
    b1: Float[np.ndarray, " h"]
    w2: Float[np.ndarray, "h h"]
    b2: Float[np.ndarray, " h"]
    w3: Float[np.ndarray, " h"]
    b3: float

    @classmethod
    def bare(
        cls,
        origin_mm: Float[np.ndarray, " 3"],
        cell_mm: float,
        base: Float[np.ndarray, "x y z"],
        ratios: tuple[float, ...],
        table_size: int,
    ) -> Tables:
        """The grid alone; nothing learned."""
        nodes = np.array(base.shape)
        cells = np.array(ratios) * cell_mm
        shapes = np.ceil((nodes - 1)[None] / np.array(ratios)[:, None]).astype(np.int64) + 1
        levels, hidden = len(ratios), kernels.HIDDEN
        return cls(
            origin_mm=np.array(origin_mm, dtype=np.float64),
            cell_mm=float(cell_mm),
            base=np.ascontiguousarray(base, dtype=np.float32),
            active=np.zeros(tuple(nodes - 1), dtype=bool),
            level_cells_mm=cells,
            level_shapes=shapes,
            tables=np.zeros((levels, table_size, kernels.FEATURES), dtype=np.float32),
            w1=np.zeros((hidden, levels * kernels.FEATURES), dtype=np.float32),
            b1=np.zeros(hidden, dtype=np.float32),
            w2=np.zeros((hidden, hidden), dtype=np.float32),
            b2=np.zeros(hidden, dtype=np.float32),
            w3=np.zeros(hidden, dtype=np.float32),
            b3=0.0,
        )

    def trained(self, tables: Any, w1: Any, b1: Any, w2: Any, b2: Any, w3: Any, b3: Any) -> Tables:
        """The same grid with a network; no cell asks it yet."""
        return Tables(
            self.origin_mm, self.cell_mm, self.base, self.active.copy(), self.level_cells_mm,
            self.level_shapes, tables, w1, b1, w2, b2, w3.reshape(-1), float(b3.reshape(-1)[0]),
        )  # fmt: skip

    def cell_of(self, points_mm: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n 3"]:
        """(n, 3) indices of the coarse cells that hold the points, or the nearest ones."""
        index = np.floor((points_mm - self.origin_mm) / self.cell_mm).astype(np.int64)
        return np.clip(index, 0, np.array(self.active.shape) - 1)

    def distance(self, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """(n,) signed distance, mm."""
        return np.asarray(
            kernels.evaluate(
                np.ascontiguousarray(points_mm, dtype=np.float64),
                self.origin_mm,
                self.cell_mm,
                self.base,
                self.active,
                self.level_cells_mm,
                self.level_shapes,
                self.tables,
                self.w1,
                self.b1,
                self.w2,
                self.b2,
                self.w3,
                self.b3,
            )
        )


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How far normal parts differ, where several scans of them disagreed.

    Attributes
    ----------
    origin_mm, cell_mm
        Corner and edge of the cells, template frame.
    spread_mm
        (x, y, z) standard deviation between normal parts; 0 away from the surface.
    """

    origin_mm: Float[np.ndarray, " 3"]
    cell_mm: float
    spread_mm: Float[np.ndarray, "x y z"]

    def at(self, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """(n,) spread at the points; beyond the cells that of the nearest."""
        index = np.floor((points_mm - self.origin_mm) / self.cell_mm).astype(np.int64)
        index = np.clip(index, 0, np.array(self.spread_mm.shape) - 1)
        return self.spread_mm[tuple(index.T)].astype(np.float64)


@dataclass(frozen=True, slots=True)
class LearnedSdf:
    """A fitted template (`Template`).

    Attributes
    ----------
    mesh
        The closed mesh that it was fitted to.
    bias_mm
        99th percentile of |f| on points of the surface that training never saw.
    metadata
        Recipe, hashes, seed, versions.
    tolerance
        Of templates that were learned from several scans.
    """

    tables: Tables
    mesh: trimesh.Trimesh
    bias_mm: float
    metadata: dict[str, str] = field(default_factory=dict)
    tolerance: Tolerance | None = None

    @property
    def bounds_mm(self) -> Float[np.ndarray, "2 3"]:
        """(2, 3) box of the part."""
        return np.array(self.mesh.bounds, dtype=np.float64)

    def distance(self, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """(n,) signed distance, mm, negative inside."""
        return self.tables.distance(points_mm)

    def distance_and_gradient(
        self, points_mm: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """(n,) signed distance and (n, 3) its gradient, by central differences."""
        step_mm = GRADIENT_CELLS * self.tables.cell_mm
        gradient = np.empty((len(points_mm), 3))
        for axis in range(3):
            offset = np.zeros(3)
            offset[axis] = step_mm
            ahead, behind = self.distance(points_mm + offset), self.distance(points_mm - offset)
            gradient[:, axis] = (ahead - behind) / (2.0 * step_mm)
        return self.distance(points_mm), gradient

    def spread_mm(self, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """(n,) standard deviation between normal parts, 0 where none is known."""
        return np.zeros(len(points_mm)) if self.tolerance is None else self.tolerance.at(points_mm)

    def below_z(self, z_mm: float) -> Template:
        """The part printed so far."""
        return CutTemplate(self, z_mm)

    def surface_points(
        self, spacing_mm: float
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """(m, 3) points of the part's surface, each for spacing² of area, and their normals."""
        return mesh_points(self.mesh, spacing_mm)

    def solid(self) -> Any:
        """The part as a `manifold3d.Manifold`."""
        return as_manifold(np.asarray(self.mesh.vertices), np.asarray(self.mesh.faces))

    def extracted(self, voxel_mm: float, *, level_mm: float = 0.0) -> trimesh.Trimesh:
        """A level set as a closed mesh (`extract.extract_mesh`)."""
        from amrepair.template.extract import extract_mesh

        return extract_mesh(self, voxel_mm, level_mm=level_mm)

    def save(self, path: Path) -> None:
        """Write the template's file, whole or not at all."""
        t = self.tables
        arrays = {
            "base": t.base,
            "active": np.packbits(t.active),
            "tables": t.tables,
            "w1": t.w1, "b1": t.b1, "w2": t.w2, "b2": t.b2, "w3": t.w3,
            "b3": np.array([t.b3], dtype=np.float32),
            "vertices_mm": np.asarray(self.mesh.vertices, dtype=np.float64),
            "faces": np.asarray(self.mesh.faces, dtype=np.int32),
        }  # fmt: skip
        head = {
            "kind": KIND,
            "origin_mm": t.origin_mm.tolist(),
            "cell_mm": t.cell_mm,
            "level_cells_mm": t.level_cells_mm.tolist(),
            "bias_mm": self.bias_mm,
            **self.metadata,
        }
        if self.tolerance is not None:
            arrays["spread_mm"] = self.tolerance.spread_mm.astype(np.float32)
            head["spread_origin_mm"] = self.tolerance.origin_mm.tolist()
            head["spread_cell_mm"] = self.tolerance.cell_mm
        write_template(path, arrays, head)

    @classmethod
    def load(cls, path: Path) -> LearnedSdf:
        """Read a template's file.

        Raises
        ------
        TemplateError
            If it is missing, truncated, or no template of ours.
        """
        return cls.unpacked(Path(path), *read_template(Path(path)))

    @classmethod
    def unpacked(
        cls, path: Path, arrays: dict[str, np.ndarray], head: dict[str, Any]
    ) -> LearnedSdf:
        """The template in a file's arrays and head."""
        require_kind(path, head.get("kind", KIND), KIND)
        if not set(_ARRAYS) <= set(arrays):
            raise TemplateError(f"{path} lacks parts of a template; fit it again")
        base = arrays["base"]
        cells = np.array(head["level_cells_mm"], dtype=np.float64)
        cell_mm = float(head["cell_mm"])
        bare = Tables.bare(
            np.array(head["origin_mm"], dtype=np.float64),
            cell_mm,
            base,
            tuple(float(c) / cell_mm for c in cells),
            arrays["tables"].shape[1],
        )
        tables = bare.trained(*(arrays[name] for name in _ARRAYS[2:9]))
        bits = np.unpackbits(arrays["active"])[: tables.active.size]
        tables.active[...] = bits.reshape(tables.active.shape).astype(bool)
        return cls(
            tables=tables,
            mesh=stored_mesh(path, arrays),
            bias_mm=float(head["bias_mm"]),
            metadata=stored_metadata(head),
            tolerance=_stored_tolerance(arrays, head),
        )


def _stored_tolerance(arrays: dict[str, np.ndarray], head: dict[str, Any]) -> Tolerance | None:
    if "spread_mm" not in arrays:
        return None
    return Tolerance(
        np.array(head["spread_origin_mm"], dtype=np.float64),
        float(head["spread_cell_mm"]),
        arrays["spread_mm"],
    )
