"""What one simulated world lacks against another."""

from __future__ import annotations

from amrepair.simulate.columns import Window
from amrepair.simulate.truth import Difference
from amrepair.simulate.world import World


def missing_versus(world: World, reference: World) -> Difference:
    """What a world lacks, and has too much, against a reference without defects on its grid."""
    a, b = world.window(), reference.window()
    assert (a.origin_mm, a.cell_mm) == (b.origin_mm, b.cell_mm)
    window = Window(
        a.origin_mm, a.cell_mm, min(a.y0, b.y0), max(a.y1, b.y1), min(a.x0, b.x0), max(a.x1, b.x1)
    )
    mine, other = world.snapshot(window), reference.snapshot(window)
    return Difference(missing=other.minus(mine), excess=mine.minus(other))
