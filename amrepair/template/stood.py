"""A template as a job lays it on the bed: in whatever way it lies, and as often as it is printed.

What is cut at a layer's height must have its Z upright, and a scan of the bed shows every copy. The
copies' field is the least of theirs: exact outside and inside, since they do not overlap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import manifold3d
import numpy as np
from jaxtyping import Float

from amrepair.arrays import Box, Numbers, Points, Values
from amrepair.frames import Transform, box_of
from amrepair.template.port import Template
from gcode.meshes import mesh_of


@dataclass(frozen=True, slots=True)
class StoodTemplate:
    """Copies of a part as they stand (`Template`); its frame is the bed's.

    Attributes
    ----------
    part
        The template of one, in its own frame.
    placed
        Where each copy stands (build from template).
    boxes_mm
        (2, 3) box of each as it stands.
    """

    part: Template
    placed: tuple[Transform, ...]
    boxes_mm: tuple[Box, ...]

    @classmethod
    def of(cls, part: Template, placed: tuple[Transform, ...]) -> StoodTemplate:
        """From the poses; boxes are measured on the part's solid."""
        vertices = np.asarray(mesh_of(part.solid())[0], dtype=np.float64)
        return cls(part, placed, tuple(box_of(pose.apply(vertices)) for pose in placed))

    @property
    def bounds_mm(self) -> Box:
        """(2, 3) box of all of them."""
        return box_of(np.concatenate(self.boxes_mm))

    @property
    def bias_mm(self) -> float:
        """That of one."""
        return self.part.bias_mm

    def distance(self, points_mm: Points) -> Values:
        """(n,) signed distance to the nearest copy."""
        return self._nearest(points_mm)[0]

    def distance_and_gradient(self, points_mm: Points) -> tuple[Values, Points]:
        """(n,) signed distance to the nearest copy, and (n, 3) its gradient."""
        distance, copy = self._nearest(points_mm)
        gradient = np.zeros((len(points_mm), 3))
        for k, pose in enumerate(self.placed):
            mine = np.flatnonzero(copy == k)
            if len(mine):
                own = pose.inverse().apply(points_mm[mine])
                gradient[mine] = pose.rotate(self.part.distance_and_gradient(own)[1])
        return distance, gradient

    def spread_mm(self, points_mm: Points) -> Values:
        """(n,) standard deviation between normal parts at the nearest copy, where it is known."""
        spread = np.zeros(len(points_mm))
        known = getattr(self.part, "spread_mm", None)
        if known is None:
            return spread
        copy = self._nearest(points_mm)[1]
        for k, pose in enumerate(self.placed):
            mine = np.flatnonzero(copy == k)
            spread[mine] = known(pose.inverse().apply(points_mm[mine]))
        return spread

    def _nearest(self, points_mm: Points) -> tuple[Values, Numbers]:
        """(n,) signed distance to the nearest copy, and which it is.

        A copy is asked about only where its box is nearer than what was found.
        """
        distance = np.full(len(points_mm), np.inf)
        copy = np.zeros(len(points_mm), np.int64)
        for k, (pose, (low, high)) in enumerate(zip(self.placed, self.boxes_mm, strict=True)):
            off_mm = np.maximum(np.maximum(low - points_mm, points_mm - high), 0.0)
            ask = np.flatnonzero((off_mm**2).sum(axis=1) < np.maximum(distance, 0.0) ** 2)
            if len(ask) == 0:
                continue
            found = self.part.distance(pose.inverse().apply(points_mm[ask]))
            nearer = found < distance[ask]
            distance[ask[nearer]], copy[ask[nearer]] = found[nearer], k
        return distance, copy

    def surface_points(
        self, spacing_mm: float
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """Points of every copy's surface, and their normals."""
        points, normals = self.part.surface_points(spacing_mm)
        return (
            np.concatenate([pose.apply(points) for pose in self.placed]),
            np.concatenate([pose.rotate(normals) for pose in self.placed]),
        )

    def solid(self) -> Any:
        """All copies as one `manifold3d.Manifold`."""
        one: Any = self.part.solid()
        return manifold3d.Manifold.batch_boolean(
            [pose.solid(one) for pose in self.placed], manifold3d.OpType.Add
        )
