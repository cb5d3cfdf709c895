"""A template cut by a horizontal plane: the part printed so far.

f_k(x) = max(f(x), z − z_k): exact inside and on the surface, a lower bound outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Box, Points, Values
from amrepair.errors import TemplateError
from amrepair.template.port import Template


@dataclass(frozen=True, slots=True)
class CutTemplate:
    """`whole` below z = `z_mm`.

    Attributes
    ----------
    whole
        The finished part.
    z_mm
        Height of the cut, template frame.
    """

    whole: Template
    z_mm: float

    def __post_init__(self) -> None:
        low_mm = float(self.whole.bounds_mm[0, 2])
        if not self.z_mm > low_mm:
            raise TemplateError(
                f"a cut at z = {self.z_mm:.3f} mm leaves nothing of a part that starts at "
                f"{low_mm:.3f} mm; cut higher"
            )

    @property
    def bounds_mm(self) -> Box:
        """(2, 3) box of what is left."""
        bounds = self.whole.bounds_mm.copy()
        bounds[1, 2] = min(bounds[1, 2], self.z_mm)
        return bounds

    @property
    def bias_mm(self) -> float:
        """That of the whole: the plane itself is exact."""
        return self.whole.bias_mm

    def distance(self, points_mm: Points) -> Values:
        """(n,) max(f, z − z_k)."""
        return np.maximum(self.whole.distance(points_mm), points_mm[:, 2] - self.z_mm)

    def distance_and_gradient(self, points_mm: Points) -> tuple[Values, Points]:
        """(n,) signed distance and the gradient of whichever term is the larger."""
        distance, gradient = self.whole.distance_and_gradient(points_mm)
        above = points_mm[:, 2] - self.z_mm
        cut = above > distance
        gradient = np.where(cut[:, None], np.array([0.0, 0.0, 1.0]), gradient)
        return np.maximum(distance, above), gradient

    def spread_mm(self, points_mm: Points) -> Values:
        """(n,) that of the whole: standard deviation between normal parts, where it is known."""
        spread = getattr(self.whole, "spread_mm", None)
        return np.zeros(len(points_mm)) if spread is None else np.asarray(spread(points_mm))

    def surface_points(
        self, spacing_mm: float
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """Points of the whole's surface below the cut, and of the cut face."""
        points, normals = self.whole.surface_points(spacing_mm)
        below = points[:, 2] <= self.z_mm
        cap = self._cap_points(spacing_mm)
        up = np.tile([0.0, 0.0, 1.0], (len(cap), 1))
        return np.concatenate([points[below], cap]), np.concatenate([normals[below], up])

    def _cap_points(self, spacing_mm: float) -> Float[np.ndarray, "m 3"]:
        """(m, 3) a square lattice of the cut face's interior."""
        low, high = self.bounds_mm
        if self.z_mm >= float(self.whole.bounds_mm[1, 2]):
            return np.empty((0, 3))
        axes = [np.arange(low[i] + spacing_mm / 2, high[i], spacing_mm) for i in (0, 1)]
        x, y = (grid.ravel() for grid in np.meshgrid(*axes, indexing="ij"))
        lattice = np.column_stack([x, y, np.full(len(x), self.z_mm)])
        return lattice[self.whole.distance(lattice) < 0]

    def solid(self) -> Any:
        """The whole's solid, trimmed by the plane exactly."""
        # manifold3d keeps the side that the normal points to
        return self.whole.solid().trim_by_plane((0.0, 0.0, -1.0), -self.z_mm)
