"""The top of a patch along the wanted surface itself: gentle slopes without steps.

Planar passes end under the slope, and one bead on top follows it, as thick as what they left
(Ahlers et al., "3D Printing of Nonplanar Layers for Smooth Surface Generation", CASE 2019). How
steep that may be, the head itself says: its flat must not dig into what is uphill.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from gcode.slicing.patch_free import GAP_STEP_MM, ROUNDED_CORNERS_MM, ROUNDING_MM, shares_of_step
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.reach import Reach
from gcode.surfaces import HeightField

GIVE_MM = 0.015  # closer than this the checker's limits and the planner's are not


@dataclass(frozen=True, slots=True)
class Skin:
    """Where a patch ends along the surface.

    Attributes
    ----------
    columns
        Columns of the patch that end so.
    surface_mm
        Where they end.
    tip
        Height of the tip, on the cells of `reach`.
    reach
        Over everything as it stands once the patch is finished.
    """

    columns: Bool[np.ndarray, "ny nx"]
    surface_mm: Float[np.ndarray, "ny nx"]
    tip: HeightField
    reach: Reach

    @property
    def across_rad(self) -> float:
        """Direction across its slope, level."""
        dy, dx = np.gradient(np.where(self.columns, self.surface_mm, np.nan))
        inside = np.isfinite(dx) & np.isfinite(dy)
        # slopes that face each other have one direction: the axis of most change
        uphill = np.stack([dx[inside], dy[inside]])
        axis = np.linalg.eigh(uphill @ uphill.T)[1][:, -1] if inside.any() else np.array([1.0, 0.0])
        return float(np.arctan2(axis[1], axis[0]) + 0.5 * np.pi)

    def planar_top_mm(
        self, model: PatchModel, tops_mm: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, "ny nx"]:
        """How high planar passes fill each column: under the skin, as high as a layer's top."""
        below = np.concatenate([[-np.inf], tops_mm])
        under = below[
            np.searchsorted(tops_mm, model.top_mm - model.options.skin.least_mm + ROUNDING_MM)
        ]
        return np.where(self.columns, under, model.top_mm)

    def free_between(
        self, start_mm: Float[np.ndarray, "m 2"], end_mm: Float[np.ndarray, "m 2"]
    ) -> Bool[np.ndarray, " m"]:
        """Whether the nozzle may go straight from one point on the surface to the next."""
        share = shares_of_step(self.reach)[:, None, None]
        way = (start_mm + (end_mm - start_mm) * share).reshape(-1, 2)
        low, high = (self.tip.sample(at, smooth=True) for at in (start_mm, end_mm))
        tip_mm = (low + (high - low) * share[:, :, 0]).reshape(-1)
        free = np.ones(len(way), dtype=bool)
        for little in ROUNDED_CORNERS_MM:
            cells, inside = self.reach.cells_of(way + little)
            free &= ~inside | (self.reach.need_mm[cells[:, 0], cells[:, 1]] <= tip_mm + GIVE_MM)
        return np.asarray(free.reshape(share.shape[0], -1).all(axis=0))


def skin_of(model: PatchModel, planar: Bool[np.ndarray, "ny nx"]) -> Skin | None:
    """Where the top of a patch may follow the surface, among the columns asked about.

    None: nowhere enough of it.
    """
    options = model.options.skin
    wanted = np.isfinite(model.top_mm)
    if not (wanted & planar).any():
        return None
    nearest = ndimage.distance_transform_edt(~wanted, return_distances=False, return_indices=True)
    surface = HeightField(
        model.origin_mm, model.cell_mm, model.top_mm[tuple(nearest)], np.ones_like(wanted)
    )
    reach = model.reach_of(model.raised(wanted, model.top_mm))
    cells = reach.centres_mm()
    surface_mm = surface.sample(cells, smooth=True).reshape(reach.shape)
    rise_mm = np.clip(reach.need_mm - surface_mm, 0.0, None)
    # between the points of a bead the tip goes straight
    rise_mm = ndimage.maximum_filter(rise_mm, round(GAP_STEP_MM / reach.cell_mm) + 1)
    slope = np.hypot(*np.gradient(np.asarray(surface.z_mm, np.float64), model.cell_mm))
    columns = (
        wanted
        & planar
        & (slope >= options.least_slope)
        & model.free_at(rise_mm <= options.most_rise_mm)
    )
    least = np.ones((round(options.wide_mm / model.cell_mm),) * 2)
    columns = ndimage.binary_opening(columns, least)
    label, count = ndimage.label(columns)
    for k in range(1, count + 1):
        one = label == k
        climb_mm = np.ptp(model.top_mm[one])
        if one.sum() * model.cell_mm**2 < options.mm2 or climb_mm < options.least_climb_mm:
            columns &= ~one
    if not columns.any():
        return None
    tip_mm = surface_mm + np.minimum(rise_mm, options.most_rise_mm)
    tip = HeightField(reach.field.origin_mm, reach.cell_mm, tip_mm, np.ones(reach.shape, bool))
    return Skin(columns, np.asarray(surface.z_mm, np.float64), tip, reach)
