"""A defect as it is asked for, what it goes on, and what it becomes once it has a place."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import MappingProxyType

import manifold3d
import numpy as np
from jaxtyping import Float

from amrepair.arrays import Box, Values
from gcode.reader.job import Beads


@dataclass(frozen=True, slots=True)
class Option:
    """One key of a defect: its default, range and meaning."""

    default: float
    low: float
    high: float
    meaning: str


@dataclass(frozen=True, slots=True)
class Defect:
    """A defect as asked for, without a place.

    Attributes
    ----------
    kind
        What goes wrong: a name in `defects.DEFECT_KINDS`.
    values
        Every option of that kind, defaults filled in.
    """

    kind: str
    values: MappingProxyType[str, float] = field(default_factory=lambda: MappingProxyType({}))

    def __str__(self) -> str:
        options = ",".join(f"{key}={value:g}" for key, value in self.values.items())
        return f"{self.kind}:{options}" if options else self.kind


@dataclass(frozen=True, slots=True)
class Printed:
    """The print on which a defect is to be placed.

    Attributes
    ----------
    part
        The solid that is printed, build frame.
    tops_mm
        (n,) heights of the layers' tops, rising.
    beads
        The job's beads, for defects that skip some of them.
    """

    part: manifold3d.Manifold
    tops_mm: Values
    beads: Beads | None = None


@dataclass(frozen=True, slots=True)
class PlacedDefect:
    """A defect with a place on a part.

    Attributes
    ----------
    kind
        What goes wrong.
    layers
        Indices of the layers whose flow it changes, rising; none for a defect of the whole part.
    flow_regions
        (n, 9) ellipses where the flow changes: x, y, cos, sin, half-axes, z above, z up to,
        factor; build frame, mm. The world reads them.
    removed, added
        Solids of the build frame that break off, or are added to, the finished part.
    box_mm
        (2, 3) box around it, build frame.
    """

    kind: str
    layers: tuple[int, ...]
    flow_regions: Float[np.ndarray, "n 9"]
    removed: manifold3d.Manifold | None
    added: manifold3d.Manifold | None
    box_mm: Box

    @property
    def last_layer(self) -> int | None:
        """The layer after which it is scanned and repaired; None: once the part is finished."""
        return self.layers[-1] if self.layers else None
