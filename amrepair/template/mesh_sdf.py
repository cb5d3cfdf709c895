"""`MeshSdf`: the exact signed distance of a closed mesh, by Embree through open3d.

Distance is to the nearest triangle; sign by the majority of three rays. Open3D computes in
float32: about 1e-5 mm on a part of 100 mm. It holds no learned state; `LearnedSdf` is faster.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from amrepair.device import open3d
from amrepair.template.cut import CutTemplate
from amrepair.template.mesh_file import require_mesh
from amrepair.template.port import Template
from amrepair.template.surface import mesh_points
from gcode.solids import as_manifold

if TYPE_CHECKING:
    import trimesh

SIGN_RAYS = 3  # odd; one ray may graze an edge and miscount, two must to be wrong
CHUNK = 1 << 20  # bounds the memory of one query
# Nearer than this the direction to the nearest point is rounding, and the face normal is used.
TOUCHING_MM = 1e-4
FLOAT32_RATIO = 2e-7  # Embree's single precision, relative to the coordinates


@dataclass(frozen=True, slots=True)
class MeshSdf:
    """Signed distance to a closed mesh (negative inside), mm.

    Attributes
    ----------
    mesh
        Closed, outward winding.
    """

    mesh: trimesh.Trimesh
    _scene: Any = field(repr=False, compare=False)
    _centre_mm: Float[np.ndarray, " 3"] = field(repr=False, compare=False)

    @classmethod
    def from_mesh(cls, mesh: trimesh.Trimesh) -> MeshSdf:
        """Build the ray-casting scene of a mesh (closed first if it is not).

        Raises
        ------
        TemplateError
            If the mesh bounds no volume.
        """
        o3d = open3d()
        closed = require_mesh(mesh, source=str(mesh.metadata.get("source", "mesh")))
        # about its own centre float32 keeps the most digits
        centre = np.asarray(closed.bounds, dtype=np.float64).mean(axis=0)
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor((closed.vertices - centre).astype(np.float32)),
            o3d.core.Tensor(np.asarray(closed.faces).astype(np.uint32)),
        )
        return cls(mesh=closed, _scene=scene, _centre_mm=centre)

    @property
    def bounds_mm(self) -> Float[np.ndarray, "2 3"]:
        """(2, 3) box of the mesh."""
        return np.array(self.mesh.bounds, dtype=np.float64)

    @property
    def bias_mm(self) -> float:
        """Rounding of single precision."""
        return float(np.ptp(self.bounds_mm, axis=0).max()) * FLOAT32_RATIO

    def _local(self, points_mm: Float[np.ndarray, "n 3"]) -> Any:
        return open3d().core.Tensor((points_mm - self._centre_mm).astype(np.float32))

    def distance(self, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """(n,) signed distance, mm."""
        result = np.empty(len(points_mm))
        for start in range(0, len(points_mm), CHUNK):
            chunk = slice(start, start + CHUNK)
            signed = self._scene.compute_signed_distance(
                self._local(points_mm[chunk]), nsamples=SIGN_RAYS
            )
            result[chunk] = signed.numpy()
        return result

    def unsigned_distance(self, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """(n,) distance to the nearest triangle, mm; cheaper where the sign is not asked."""
        result = np.empty(len(points_mm))
        for start in range(0, len(points_mm), CHUNK):
            chunk = slice(start, start + CHUNK)
            result[chunk] = self._scene.compute_distance(self._local(points_mm[chunk])).numpy()
        return result

    def distance_and_gradient(
        self, points_mm: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """(n,) signed distance and (n, 3) unit gradient, from the nearest points."""
        distance = self.distance(points_mm)
        gradient = np.empty((len(points_mm), 3))
        for start in range(0, len(points_mm), CHUNK):
            chunk = slice(start, start + CHUNK)
            local = self._local(points_mm[chunk])
            answer = self._scene.compute_closest_points(local)
            away = local.numpy().astype(np.float64) - answer["points"].numpy()
            norm = np.linalg.norm(away, axis=1)
            outward = np.where(distance[chunk] < 0, -1.0, 1.0)
            direction = away * (outward / np.maximum(norm, 1e-30))[:, None]
            face = answer["primitive_normals"].numpy().astype(np.float64)
            face /= np.maximum(np.linalg.norm(face, axis=1), 1e-30)[:, None]
            gradient[chunk] = np.where((norm > TOUCHING_MM)[:, None], direction, face)
        return distance, gradient

    def below_z(self, z_mm: float) -> Template:
        """The part printed so far."""
        return CutTemplate(self, z_mm)

    def surface_points(
        self, spacing_mm: float
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """(m, 3) points on the mesh, each for spacing² of area, and (m, 3) face normals."""
        return mesh_points(self.mesh, spacing_mm)

    def solid(self) -> Any:
        """The mesh itself as a `manifold3d.Manifold`."""
        return as_manifold(np.asarray(self.mesh.vertices), np.asarray(self.mesh.faces))

    def extracted(self, voxel_mm: float, *, level_mm: float = 0.0) -> trimesh.Trimesh:
        """A level set as a closed mesh (`extract.extract_mesh`)."""
        from amrepair.template.extract import extract_mesh

        return extract_mesh(self, voxel_mm, level_mm=level_mm)
