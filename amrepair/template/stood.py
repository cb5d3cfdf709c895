"""Templates as a job lays them on the bed: in whatever way they lie, as often as it prints them.

What is cut at a layer's height must have its Z upright, and a scan of the bed shows all that stands
there. Their field is the least of theirs: exact outside and inside, since they do not overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    """Parts as they stand (`Template`), copies of one or several; its frame is the bed's.

    Attributes
    ----------
    parts
        The template of each that stands there, in its own frame; copies have the same one.
    placed
        Where each stands (build from template).
    boxes_mm
        (2, 3) box of each as it stands.
    """

    parts: tuple[Template, ...]
    placed: tuple[Transform, ...]
    boxes_mm: tuple[Box, ...]

    @classmethod
    def of(cls, part: Template, placed: tuple[Transform, ...]) -> StoodTemplate:
        """Copies of one part, from their poses."""
        return cls.of_parts((part,) * len(placed), placed)

    @classmethod
    def of_parts(cls, parts: tuple[Template, ...], placed: tuple[Transform, ...]) -> StoodTemplate:
        """From the poses; boxes are measured on the parts' solids."""
        vertices = {
            id(part): np.asarray(mesh_of(part.solid())[0], dtype=np.float64) for part in parts
        }
        boxes = (
            box_of(pose.apply(vertices[id(part)])) for part, pose in zip(parts, placed, strict=True)
        )
        return cls(parts, placed, tuple(boxes))

    def some(self, which: Sequence[int]) -> StoodTemplate:
        """Only those."""
        return StoodTemplate(
            tuple(self.parts[k] for k in which),
            tuple(self.placed[k] for k in which),
            tuple(self.boxes_mm[k] for k in which),
        )

    @property
    def bounds_mm(self) -> Box:
        """(2, 3) box of all of them."""
        return box_of(np.concatenate(self.boxes_mm))

    @property
    def bias_mm(self) -> float:
        """The largest of theirs."""
        return max(part.bias_mm for part in self.parts)

    def distance(self, points_mm: Points) -> Values:
        """(n,) signed distance to the nearest copy."""
        return self._nearest(points_mm)[0]

    def distance_and_gradient(self, points_mm: Points) -> tuple[Values, Points]:
        """(n,) signed distance to the nearest copy, and (n, 3) its gradient."""
        distance, copy = self._nearest(points_mm)
        gradient = np.zeros((len(points_mm), 3))
        for k, (part, pose) in enumerate(zip(self.parts, self.placed, strict=True)):
            mine = np.flatnonzero(copy == k)
            if len(mine):
                own = pose.inverse().apply(points_mm[mine])
                gradient[mine] = pose.rotate(part.distance_and_gradient(own)[1])
        return distance, gradient

    def spread_mm(self, points_mm: Points) -> Values:
        """(n,) standard deviation between normal parts at the nearest copy, where it is known."""
        spread = np.zeros(len(points_mm))
        known = [getattr(part, "spread_mm", None) for part in self.parts]
        if not any(known):
            return spread
        copy = self._nearest(points_mm)[1]
        for k, (of_part, pose) in enumerate(zip(known, self.placed, strict=True)):
            mine = np.flatnonzero(copy == k)
            if of_part is not None:
                spread[mine] = of_part(pose.inverse().apply(points_mm[mine]))
        return spread

    def _nearest(self, points_mm: Points) -> tuple[Values, Numbers]:
        """(n,) signed distance to the nearest copy, and which it is.

        A copy is asked about only where its box is nearer than what was found.
        """
        distance = np.full(len(points_mm), np.inf)
        copy = np.zeros(len(points_mm), np.int64)
        for k, (part, pose, (low, high)) in enumerate(
            zip(self.parts, self.placed, self.boxes_mm, strict=True)
        ):
            off_mm = np.maximum(np.maximum(low - points_mm, points_mm - high), 0.0)
            ask = np.flatnonzero((off_mm**2).sum(axis=1) < np.maximum(distance, 0.0) ** 2)
            if len(ask) == 0:
                continue
            found = part.distance(pose.inverse().apply(points_mm[ask]))
            nearer = found < distance[ask]
            distance[ask[nearer]], copy[ask[nearer]] = found[nearer], k
        return distance, copy

    def surface_points(
        self, spacing_mm: float
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """Points of every one's surface, and their normals."""
        own = {id(part): part.surface_points(spacing_mm) for part in self.parts}
        each = [(*own[id(k)], pose) for k, pose in zip(self.parts, self.placed, strict=True)]
        return (
            np.concatenate([pose.apply(points) for points, _, pose in each]),
            np.concatenate([pose.rotate(normals) for _, normals, pose in each]),
        )

    def solid(self) -> Any:
        """All of them as one `manifold3d.Manifold`."""
        own: dict[int, Any] = {id(part): part.solid() for part in self.parts}
        return manifold3d.Manifold.batch_boolean(
            [pose.solid(own[id(k)]) for k, pose in zip(self.parts, self.placed, strict=True)],
            manifold3d.OpType.Add,
        )
