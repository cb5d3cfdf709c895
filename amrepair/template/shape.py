"""What every template that is told by a closed mesh answers from that mesh."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Box
from amrepair.template.surface import mesh_points
from gcode.solids import as_manifold

if TYPE_CHECKING:
    import trimesh


_solids: dict[int, Any] = {}  # by the mesh's id, as long as the mesh lives


class MeshShape:
    """The part's surface and solid, for fields with a `mesh` (closed, outward winding)."""

    __slots__ = ()
    mesh: trimesh.Trimesh

    @property
    def bounds_mm(self) -> Box:
        """(2, 3) box of the part."""
        return np.array(self.mesh.bounds, dtype=np.float64)

    def surface_points(
        self, spacing_mm: float
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """(m, 3) points of the part's surface, each for spacing² of area, and their normals."""
        return mesh_points(self.mesh, spacing_mm)

    def solid(self) -> Any:
        """The part as a `manifold3d.Manifold`, made once: nobody changes a template's mesh."""
        key = id(self.mesh)
        if key not in _solids:
            mesh = self.mesh
            _solids[key] = as_manifold(np.asarray(mesh.vertices), np.asarray(mesh.faces))
            weakref.finalize(mesh, _solids.pop, key, None)
        return _solids[key]
