"""`MeshSdf`: the exact signed distance of a closed mesh.

Distance is to the nearest triangle, sign by what rays cross (`nearest`). It holds no learned
state; `GridSdf` is faster.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from amrepair.arrays import Mask, Points, Values
from amrepair.template.mesh_file import require_mesh
from amrepair.template.nearest import Nearest, TriangleTree
from amrepair.template.shape import MeshShape

if TYPE_CHECKING:
    import trimesh

# Nearer than this the direction to the nearest point is rounding, and the face normal is used.
TOUCHING_MM = 1e-4


@dataclass(frozen=True, slots=True)
class MeshSdf(MeshShape):
    """Signed distance to a closed mesh (negative inside), mm.

    Attributes
    ----------
    mesh
        Closed, outward winding.
    """

    mesh: trimesh.Trimesh
    _tree: TriangleTree = field(repr=False, compare=False)

    @classmethod
    def from_mesh(cls, mesh: trimesh.Trimesh) -> MeshSdf:
        """Sort the triangles of a mesh (closed first if it is not).

        Raises
        ------
        TemplateError
            If the mesh bounds no volume.
        """
        closed = require_mesh(mesh, source=str(mesh.metadata.get("source", "mesh")))
        tree = TriangleTree.of(np.asarray(closed.vertices), np.asarray(closed.faces))
        return cls(mesh=closed, _tree=tree)

    @property
    def bias_mm(self) -> float:
        """None: it is exact."""
        return 0.0

    def distance(self, points_mm: Points) -> Values:
        """(n,) signed distance, mm."""
        found = self._tree.nearest(points_mm)
        return self._outward(points_mm, found) * found.size_mm

    def unsigned_distance(self, points_mm: Points) -> Values:
        """(n,) distance to the nearest triangle, mm; cheaper where the sign is not asked."""
        return self._tree.nearest(points_mm).size_mm

    def inside(self, points_mm: Points) -> Mask:
        """(n,) whether points lie inside."""
        return self._tree.inside(points_mm)

    def distance_and_gradient(self, points_mm: Points) -> tuple[Values, Points]:
        """(n,) signed distance and (n, 3) unit gradient, from the nearest points."""
        found = self._tree.nearest(points_mm)
        size, outward = found.size_mm, self._outward(points_mm, found)
        direction = (points_mm - found.place_mm) * (outward / np.maximum(size, 1e-30))[:, None]
        normal = np.asarray(self.mesh.face_normals)[found.face]
        gradient = np.where((size > TOUCHING_MM)[:, None], direction, normal)
        return outward * size, gradient

    def _outward(self, points_mm: Points, found: Nearest) -> Values:
        """(n,) 1 outside, −1 inside."""
        outward = found.side.astype(np.float64)
        unclear = np.flatnonzero(found.side == 0)
        outward[unclear] = np.where(self._tree.inside(points_mm[unclear]), -1.0, 1.0)
        return outward
