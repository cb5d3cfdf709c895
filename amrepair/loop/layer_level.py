"""Whether a layer's top lies off by more than its own scatter explains: a test, with its options.

A flat layer is looked at in patches of several beads; how much their means differ is what this
layer, this print and this scanner do by themselves. A region changes the next layer's flow where
the mean of its patches is beyond the tolerance by more than that. Walls do not count: what bulges
beside a layer leaves its top where it is. Nothing is decided here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import stdtrit

from amrepair.arrays import Box, Points, Values
from amrepair.field.groups import cell_numbers
from amrepair.frames import cells_of
from amrepair.observe.robust import sigma_by_median
from amrepair.policy import DEFAULT_POLICY
from amrepair.repair import RepairPlan


@dataclass(frozen=True, slots=True)
class FlowOptions:
    """What it takes to change a layer's flow.

    Attributes
    ----------
    false_alarm
        Probability that a look at a clean layer changes anything: shared out over as many places
        as the layer has for a region of that size.
    patch_mm
        Edge of a patch: four beads, beyond which neither a bead's own waver nor a scanner's
        errors hang together.
    tolerance_layers
        Of the layer height: within this a layer's beads differ by themselves.
    band_layers
        So far over and under its plane a point can be of the layer's top.
    least_points, least_patches
        Of a patch, and of a layer whose scatter can be told.
    """

    false_alarm: float = 1e-3
    patch_mm: float = 2.0
    tolerance_layers: float = DEFAULT_POLICY.least_layers
    band_layers: float = 2.0
    least_points: int = 5
    least_patches: int = 6


FLOW_TEST = FlowOptions()
"""What the loop goes by."""


@dataclass(frozen=True, slots=True)
class LayerLevel:
    """How far a layer's top lies off its plane, by patches.

    Attributes
    ----------
    cell
        (p, 2) number of each patch.
    mean_mm
        (p,) mean height over the plane.
    spread_mm
        Robust standard deviation between patches.
    """

    cell: Int[np.ndarray, "p 2"]
    mean_mm: Float[np.ndarray, " p"]
    spread_mm: float
    layer_mm: float
    options: FlowOptions

    @classmethod
    def of(cls, plan: RepairPlan, z_mm: float) -> LayerLevel | None:
        """Of the layer whose top is at z, build frame; None where too little of it was seen."""
        place_mm = plan.build_from_template.apply(plan.anomaly.points_mm)
        return cls.of_points(place_mm, plan.anomaly.deviation_mm, z_mm, plan.layer_height_mm)

    @classmethod
    def of_points(
        cls,
        place_mm: Points,
        deviation_mm: Values,
        z_mm: float,
        layer_mm: float,
        options: FlowOptions = FLOW_TEST,
    ) -> LayerLevel | None:
        """Of a scan's points, build frame, and how far out of what is expected they lie."""
        over = place_mm[:, 2] - z_mm
        # over a flat top the distance from what is expected is the height over its plane
        top = (np.abs(over) < options.band_layers * layer_mm) & (
            np.abs(over - deviation_mm) < options.tolerance_layers * layer_mm
        )
        if not top.any():
            return None
        patch = cells_of(place_mm[top, :2], 0.0, options.patch_mm)
        of = cell_numbers(patch)
        count = np.bincount(of)
        mean = np.bincount(of, weights=over[top]) / count
        cell = np.empty((len(count), 2), np.int64)
        cell[of] = patch
        many = count >= options.least_points
        if many.sum() < options.least_patches:
            return None
        spread_mm = sigma_by_median(mean[many])
        return cls(cell[many], mean[many], spread_mm, layer_mm, options)

    def is_off(self, box_mm: Box) -> bool:
        """Whether the layer lies off over a box by more than tolerance and scatter explain."""
        mine = self._within(box_mm)
        count, layer = int(mine.sum()), len(self.cell)
        if not count:
            return False
        places = layer / count
        quantile = -float(stdtrit(layer - 1, 0.5 * self.options.false_alarm / places))
        limit_mm = self.options.tolerance_layers * self.layer_mm
        limit_mm += quantile * self.spread_mm / np.sqrt(count)
        return bool(abs(self.mean_mm[mine].mean()) > limit_mm)

    def _within(self, box_mm: Box) -> Bool[np.ndarray, " p"]:
        """Patches whose middles lie in a box; the one around its middle where none does."""
        middle = (self.cell + 0.5) * self.options.patch_mm
        inside = ((middle >= box_mm[0, :2]) & (middle <= box_mm[1, :2])).all(axis=1)
        if not inside.any():
            centre = np.floor(0.5 * (box_mm[0, :2] + box_mm[1, :2]) / self.options.patch_mm)
            inside = (self.cell == centre.astype(np.int64)).all(axis=1)
        return np.asarray(inside)
