"""`PlannedSdf`: what a layer should look like, from the job's own beads.

Sparse infill is no defect, so what is expected of a layer is the union of the planned beads. It is
held as a distance field on voxels of about a layer's height, for the last millimetres below the
layer. Farther down everything was inspected before and is covered now: there the field says
"outside", so that nothing is ever missing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Box, Points, Values, Vector, VoxelMask, Voxels
from amrepair.errors import TemplateError
from amrepair.template import planned_kernels as kernels
from amrepair.template.options import DEFAULT_PLANNED, PlannedOptions
from gcode.compiled import read_only


@dataclass(frozen=True, slots=True)
class PlannedSdf:
    """The union of planned beads near the last layer (`Template`).

    Attributes
    ----------
    origin_mm, voxel_mm
        Corner of the grid and edge of a voxel.
    bounds_mm
        (2, 3) box of the beads within reach.
    off_bed
        Beads lie below them: its foot is not the bed's height.
    """

    origin_mm: Vector
    voxel_mm: float
    bounds_mm: Box
    _field: Voxels = field(repr=False)
    _solid: VoxelMask = field(repr=False)
    off_bed: bool = False

    @classmethod
    def from_beads(
        cls,
        start_mm: Points,
        end_mm: Points,
        section_mm2: Values,
        height_mm: Values,
        *,
        level_mm: float | None = None,
        options: PlannedOptions = DEFAULT_PLANNED,
    ) -> PlannedSdf:
        """Make the field of beads.

        Parameters
        ----------
        start_mm, end_mm
            (n, 3) nozzle positions; a bead hangs below them by its height.
        section_mm2, height_mm
            (n,) its plastic and its height: as wide as their ratio.
        level_mm
            A height on which faces of voxels lie; the highest bead's by default. Supports may have
            layers of their own, which end between two of the part's.

        Raises
        ------
        TemplateError
            If there is no bead, or the grid would be too large.
        """
        if len(start_mm) == 0:
            raise TemplateError("there are no beads to make a planned template of")
        top_mm = float(np.maximum(start_mm[:, 2], end_mm[:, 2]).max())
        near = np.minimum(start_mm[:, 2], end_mm[:, 2]) > top_mm - options.depth_mm - 1e-6
        start, end = start_mm[near], end_mm[near]
        height = np.ascontiguousarray(height_mm[near])
        width = section_mm2[near] / np.maximum(height, 1e-6)
        voxel_mm = float(np.clip(np.median(height), options.least_voxel_mm, options.most_voxel_mm))
        reach = 0.5 * float(width.max())
        low = np.minimum(start, end).min(axis=0) - [reach, reach, 0.0]
        low[2] = (np.minimum(start[:, 2], end[:, 2]) - height).min()
        high = np.maximum(start, end).max(axis=0) + np.array([reach, reach, 0.0])
        # The voxels are placed so that faces of theirs lie on the last layer's top.
        level_mm = top_mm if level_mm is None else level_mm
        face_mm = level_mm + voxel_mm * np.ceil((top_mm - level_mm) / voxel_mm - 1e-6)
        levels = int(np.ceil((face_mm - low[2]) / voxel_mm - 1e-6))
        margin_mm = options.margin_mm
        above = int(np.ceil(margin_mm / voxel_mm))
        below = int(np.ceil(options.below_beads_mm / voxel_mm))
        foot_mm = face_mm - levels * voxel_mm
        origin = np.array([low[0] - margin_mm, low[1] - margin_mm, foot_mm - below * voxel_mm])
        size = np.ceil((high[:2] + margin_mm - origin[:2]) / voxel_mm).astype(int)
        shape = (int(size[0]), int(size[1]), below + levels + above)
        if np.prod([float(n) for n in shape]) > options.most_voxels:
            raise TemplateError(
                f"a planned template of {shape[0]}×{shape[1]}×{shape[2]} voxels is over the limit "
                f"of {options.most_voxels:,}; look at fewer copies at once"
            )
        solid = np.zeros(shape, dtype=bool)
        kernels.fill(
            np.ascontiguousarray(start, dtype=np.float64),
            np.ascontiguousarray(end, dtype=np.float64),
            np.ascontiguousarray(width, dtype=np.float64),
            height.astype(np.float64),
            origin,
            voxel_mm,
            solid,
        )
        bounds = np.array([low, [high[0], high[1], top_mm]])
        return cls(
            origin, voxel_mm, bounds, _signed(solid, voxel_mm), solid, off_bed=not near.all()
        )

    @property
    def bias_mm(self) -> float:
        """A quarter of a voxel: what walls lose between voxel centres."""
        return 0.25 * self.voxel_mm

    def distance(self, points_mm: Points) -> Values:
        """(n,) signed distance, mm; beyond the grid a lower bound of it."""
        points = read_only(points_mm, np.float64)
        return np.asarray(kernels.interpolate(points, self.origin_mm, self.voxel_mm, self._field))

    def distance_and_gradient(self, points_mm: Points) -> tuple[Values, Points]:
        """(n,) signed distance and (n, 3) its gradient, by central differences over a voxel."""
        points = read_only(points_mm, np.float64)
        return kernels.interpolate_with_gradient(points, self.origin_mm, self.voxel_mm, self._field)

    def surface_points(
        self, spacing_mm: float
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """(m, 3) middles of voxel faces on the surface, thinned to the spacing, and normals."""
        every = max(1, round((spacing_mm / self.voxel_mm) ** 2))
        points, normals, count = [], [], 0
        room = np.empty((0, 3))
        for axis in range(3):
            for side in (-1, 1):
                found, kept = kernels.open_faces(self._solid, axis, side, every, count, room)
                if kept > len(room):
                    room = np.empty((kept, 3))
                    kernels.open_faces(self._solid, axis, side, every, count, room)
                normal = np.zeros(3)
                normal[axis] = side
                points.append(self.origin_mm + room[:kept] * self.voxel_mm)
                normals.append(np.tile(normal, (kept, 1)))
                count += found
        return np.concatenate(points), np.concatenate(normals)

    def solid(self) -> Any:
        """The level set f = 0 as a `manifold3d.Manifold`."""
        from amrepair.template.extract import extract_mesh
        from gcode.solids import as_manifold

        mesh = extract_mesh(self, self.voxel_mm)
        return as_manifold(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def _signed(solid: VoxelMask, voxel_mm: float) -> Voxels:
    """Signed distances at voxel centres; the surface lies midway between unlike ones."""
    to_solid = kernels.squared_distances(solid, True)
    return np.asarray(
        kernels.signed(solid, to_solid, kernels.squared_distances(solid, False), voxel_mm)
    )
