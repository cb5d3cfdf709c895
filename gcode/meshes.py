"""Closed meshes alone: as much of a solid as slicing needs, in a tenth of its memory.

A `manifold3d.Manifold` can do more, and holds half a gigabyte for what is read here in forty.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from manifold3d import CrossSection, FillRule

from gcode.compiled import read_only
from gcode.meshes_kernels import bodies_of, contours_at, crossing, paired


@dataclass(frozen=True)
class ClosedMesh:
    """Triangles that close a surface, outside to their left.

    Attributes
    ----------
    vertices_mm
        (n, 3).
    faces
        (m, 3) corners, anticlockwise seen from outside.
    across
        (3m,) half-edge across from each: 3·f + k runs from corner k of face f to the next.
    """

    vertices_mm: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    across: Int[np.ndarray, " h"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices_mm", read_only(self.vertices_mm))

    def is_empty(self) -> bool:
        """Whether it has no faces."""
        return len(self.faces) == 0

    @cached_property
    def _bodies(self) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, "b 6"]]:
        """Volumes and boxes of what edges hold together: asked for again and again."""
        volumes, boxes = bodies_of(self.vertices_mm, self.faces, self.across)
        return volumes, boxes

    def volume(self) -> float:
        """Enclosed, mm³."""
        return float(self._bodies[0].sum())

    def bodies_mm(self) -> list[tuple[float, ...]]:
        """Boxes (as `bounding_box`) of what edges hold together; cavities have none."""
        volumes, boxes = self._bodies
        return [tuple(box) for box in boxes[volumes > 0].tolist()]

    @cached_property
    def _box(self) -> tuple[float, ...]:
        """Asked for again and again, too."""
        low, high = self.vertices_mm.min(axis=0), self.vertices_mm.max(axis=0)
        return tuple(float(v) for v in (*low, *high))

    def bounding_box(self) -> tuple[float, ...]:
        """(x_min, y_min, z_min, x_max, y_max, z_max)."""
        return self._box

    def translate(self, by_mm: tuple[float, float, float]) -> ClosedMesh:
        """The same mesh elsewhere."""
        return ClosedMesh(self.vertices_mm + np.asarray(by_mm, float), self.faces, self.across)


@dataclass(slots=True)
class Cuts:
    """A closed mesh at ascending heights, each cut when it is asked for."""

    mesh: ClosedMesh
    heights_mm: Float[np.ndarray, " k"]
    _first: Int[np.ndarray, " k1"]
    _which: Int[np.ndarray, " c"]
    _done: Int[np.ndarray, " m"]

    @classmethod
    def of(cls, mesh: ClosedMesh, heights_mm: Float[np.ndarray, " k"]) -> Cuts:
        """Ready to be asked: which faces cross which height is known."""
        first, which = crossing(mesh.vertices_mm, mesh.faces, heights_mm)
        return cls(mesh, heights_mm, first, which, np.full(len(mesh.faces), -1, np.int32))

    def at(self, index: int) -> Any:
        """What is inside at a height, as a `CrossSection`: once round or more, holes left out."""
        mesh, which = self.mesh, self._which[self._first[index] : self._first[index + 1]]
        self._done[which] = -1
        points, starts = contours_at(
            mesh.vertices_mm, mesh.faces, mesh.across, which,
            float(self.heights_mm[index]), self._done, index,
        )  # fmt: skip
        contours = [points[a:b] for a, b in pairwise(starts)]
        return CrossSection(contours, FillRule.Positive)


def mesh_of(solid: Any) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """(n, 3) vertices and (m, 3) faces of a `Manifold` or a `ClosedMesh`, in double precision."""
    if isinstance(solid, ClosedMesh):
        return solid.vertices_mm, solid.faces
    mesh = solid.to_mesh64() if hasattr(solid, "to_mesh64") else solid.to_mesh()
    vertices = np.asarray(mesh.vert_properties, np.float64)[:, :3]
    return read_only(vertices), np.ascontiguousarray(np.asarray(mesh.tri_verts, np.int64))


def box_of_solid(solid: Any) -> Float[np.ndarray, "2 3"]:
    """(2, 3) lowest and highest corner of a `Manifold` or a `ClosedMesh`."""
    return np.array(solid.bounding_box()).reshape(2, 3)


def middle_of_mass(solid: Any) -> Float[np.ndarray, " 3"]:
    """(3,) middle of mass of a solid, as full of plastic everywhere: of signed tetrahedra."""
    vertices, faces = mesh_of(solid)
    origin = vertices.mean(axis=0)
    corners = (vertices - origin)[faces]
    volume = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return np.asarray(origin + volume @ corners.sum(axis=1) / (4.0 * volume.sum()))


def closed_mesh(solid: Any) -> ClosedMesh:
    """The mesh of a `manifold3d.Manifold`."""
    if isinstance(solid, ClosedMesh):
        return solid
    vertices_mm, faces = mesh_of(solid)
    faces = faces.astype(np.int32)
    across, shared = paired(faces)
    if shared < 0:
        raise ValueError("a Manifold's faces close no surface")
    return ClosedMesh(vertices_mm, faces, across)


def bodies_apart(
    vertices_mm: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> ClosedMesh | None:
    """A mesh that is closed as it is, whose bodies cannot overlap; None where it may not be so.

    One body, or one with cavities, or several whose boxes lie apart; no edge has more than two
    faces. What else may be a solid takes more than a look at its edges.
    """
    faces = np.ascontiguousarray(faces, np.int32)
    across, shared = paired(faces)
    if shared != 0:
        return None
    mesh = ClosedMesh(np.ascontiguousarray(vertices_mm, np.float64), faces, across)
    volumes, boxes = mesh._bodies
    wholes = int((volumes > 0).sum())
    if wholes < 2 or wholes < len(volumes):  # which cavity belongs to which body is not told
        return mesh
    low, high = boxes[:, :3], boxes[:, 3:]
    meet = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2)
    return mesh if meet.sum() == len(boxes) else None
