"""The template as a part was made and laid: in its own size, its bow, and the pose it is in.

What a test takes out of the deviations as the whole part's must not come back where a defect is
measured: of a ball 1 % too large, against its nominal size, each dent would lose 0.2 mm of depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Box, Points, Values
from amrepair.frames import box_corners, box_of
from amrepair.observe.nuisance import Nuisance
from amrepair.template.port import Template

# A flat face of a solid is cut into so many pieces along the part to bend it.
BENT_PIECES = 16


def as_made(template: Template, nuisance: Nuisance | None) -> Template:
    """The template itself where the observations asked for no other size, bow or offset."""
    if nuisance is None or not nuisance.reshapes:
        return template
    return AsMade(template, nuisance)


@dataclass(frozen=True, slots=True)
class AsMade:
    """A template moved by what belongs to the whole part (`Template`), in the template's frame.

    To first order: moves of 1 % are right to 1 % of themselves. An offset that all views have is
    in its distances, and not in its solid, which stands where the part does.

    Attributes
    ----------
    nominal
        The part as it should be.
    nuisance
        What it was told to have moved by.
    """

    nominal: Template
    nuisance: Nuisance

    @property
    def bounds_mm(self) -> Box:
        """(2, 3) box of the part where it lies."""
        corners_mm = box_corners(self.nominal.bounds_mm)
        return box_of(corners_mm + self.nuisance.moves_mm(corners_mm))

    @property
    def bias_mm(self) -> float:
        """That of the template as it should be."""
        return self.nominal.bias_mm

    @property
    def voxel_mm(self) -> float:
        """The finest that the template tells apart; infinite where it does not say."""
        return float(getattr(self.nominal, "voxel_mm", np.inf))

    def distance(self, points_mm: Points) -> Values:
        """(n,) signed distance."""
        nominal_mm = self.nominal.distance(points_mm - self.nuisance.moves_mm(points_mm))
        return nominal_mm - self.nuisance.common_offset_mm

    def distance_and_gradient(self, points_mm: Points) -> tuple[Values, Points]:
        """(n,) signed distance, and (n, 3) its gradient."""
        own_mm = points_mm - self.nuisance.moves_mm(points_mm)
        nominal_mm, gradient = self.nominal.distance_and_gradient(own_mm)
        return nominal_mm - self.nuisance.common_offset_mm, gradient

    def surface_points(
        self, spacing_mm: float
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """Points of the surface, and their normals."""
        points_mm, normals = self.nominal.surface_points(spacing_mm)
        moves_mm = self.nuisance.moves_mm(points_mm)
        return points_mm + moves_mm + self.nuisance.common_offset_mm * normals, normals

    def solid(self) -> Any:
        """The interior; bent where the part is."""
        solid: Any = self.nominal.solid()
        if self.nuisance.bow_mm.any():
            solid = solid.refine_to_length(np.ptp(self.bounds_mm, axis=0).max() / BENT_PIECES)
        return solid.warp_batch(lambda at_mm: at_mm + self.nuisance.moves_mm(at_mm))
