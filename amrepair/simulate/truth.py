"""Ground truth: what a world lacks against the same job printed without defects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from amrepair.simulate.columns import IntervalMap, Window


@runtime_checkable
class StandingWorld(Protocol):
    """Anything that stands on the bed and can be looked into: a `World`."""

    def snapshot(self, window: Window | None = None) -> IntervalMap:
        """The intervals of a window as they are now."""
        ...


@dataclass(frozen=True, slots=True)
class Difference:
    """What a world lacked, and had too much, at one moment.

    Attributes
    ----------
    missing, excess
        Intervals of the reference that were not there, and the other way about.
    """

    missing: IntervalMap
    excess: IntervalMap

    @property
    def missing_mm3(self) -> float:
        """Volume missing."""
        return self.missing.volume_mm3

    @property
    def excess_mm3(self) -> float:
        """Volume too much."""
        return self.excess.volume_mm3

    def within(self, box_mm: Float[np.ndarray, "2 3"]) -> Difference:
        """The difference within a box of the build frame."""
        return Difference(self.missing.clipped(box_mm), self.excess.clipped(box_mm))

    def thicker_than(self, length_mm: float) -> Difference:
        """Only where it is taller than `length_mm`: what a bead could fill."""
        return Difference(self.missing.thicker_than(length_mm), self.excess.thicker_than(length_mm))

    def filled_mm3(self, world: StandingWorld) -> float:
        """Volume that was missing then and is solid in `world` now."""
        return self.missing.common(world.snapshot(self.missing.window)).volume_mm3
