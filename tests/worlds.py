"""What one simulated world lacks against another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.simulate.columns import IntervalMap, Window
from amrepair.simulate.world import World


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
        return Difference(*(_thicker(one, length_mm) for one in (self.missing, self.excess)))

    def filled_mm3(self, world: World) -> float:
        """Volume that was missing then and is solid in `world` now."""
        return self.missing.common(world.snapshot(self.missing.window)).volume_mm3


def _thicker(solid: IntervalMap, length_mm: float) -> IntervalMap:
    """Only the intervals longer than `length_mm`."""
    keep = solid.spans_mm[:, 1] - solid.spans_mm[:, 0] > length_mm
    before = np.concatenate([[0], np.cumsum(keep)])
    return IntervalMap(solid.window, before[solid.offsets], solid.spans_mm[keep])


def missing_versus(world: World, reference: World) -> Difference:
    """What a world lacks, and has too much, against a reference without defects on its grid."""
    a, b = world.window(), reference.window()
    assert (a.origin_mm, a.cell_mm) == (b.origin_mm, b.cell_mm)
    window = Window(
        a.origin_mm, a.cell_mm, min(a.y0, b.y0), max(a.y1, b.y1), min(a.x0, b.x0), max(a.x1, b.x1)
    )
    mine, other = world.snapshot(window), reference.snapshot(window)
    return Difference(missing=other.minus(mine), excess=mine.minus(other))
