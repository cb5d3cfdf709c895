"""The `Template` port: the part as it should be, as a signed distance field.

Distances are in mm, in the `template` frame, and negative inside. Every implementation answers the
same questions, so that callers need not know whether a field is learned, exact or planned from
G-code.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Box, Points, Values


@runtime_checkable
class Distances(Protocol):
    """A signed distance field: all that the refinement of a pose needs."""

    def distance(self, points_mm: Points) -> Values:
        """(n,) signed distance at (n, 3) points, mm, negative inside."""

    def distance_and_gradient(self, points_mm: Points) -> tuple[Values, Points]:
        """(n,) signed distance, mm, and its (n, 3) gradient (unit outward normal near f = 0)."""


@runtime_checkable
class Template(Distances, Protocol):
    """A signed distance field of the expected part."""

    @property
    def bounds_mm(self) -> Box:
        """(2, 3) lowest and highest corner of the part, template frame."""

    @property
    def bias_mm(self) -> float:
        """How far the field's zero level may lie from the true surface (99th percentile)."""

    def surface_points(
        self, spacing_mm: float
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """(m, 3) points on the zero level about `spacing_mm` apart, and (m, 3) unit normals."""

    def solid(self) -> Any:
        """The interior as a `manifold3d.Manifold`, template frame, checked watertight."""


@runtime_checkable
class OnGrid(Protocol):
    """A template on a grid that compiled code can read directly."""

    @property
    def grid_numbers(self) -> tuple[Any, ...]:
        """The arguments that `trilinear_kernels.field_at` takes after a point."""


def is_off_bed(template: Template) -> bool:
    """Whether its lowest plane is a cut in mid-air, as of planned beads, and not the bed."""
    return bool(getattr(template, "off_bed", False))
