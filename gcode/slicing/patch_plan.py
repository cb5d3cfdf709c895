"""The plan of a patch: several ways to lay its passes are tried, and the best one is kept."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gcode.profiles import PrintSetup
from gcode.progress import Progress
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch_heights import Heights, Openings
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.patch_passes import Pass, plan_pass, plan_skin, skin_served
from gcode.slicing.patch_skin import skin_of
from gcode.slicing.patch_state import PatchState


@dataclass(frozen=True, slots=True)
class PatchPasses:
    """The passes of one way, from the floor up, and the state of the columns after them."""

    passes: tuple[Pass, ...]
    state: PatchState

    @property
    def beads_mm3(self) -> float:
        """Volume of plastic in all beads."""
        return float(sum(chain.volume_mm3 for one in self.passes for chain in one.chains))

    def hem_mm3(self, model: PatchModel) -> float:
        """Volume of what was laid over air beside rims, as hems."""
        return float(self.state.laid_mm[self.state.hem].sum()) * model.cell_mm**2

    def filled_mm3(self, model: PatchModel) -> float:
        """Volume laid where something is missing."""
        filled_mm = np.minimum(self.state.laid_mm, model.wanted_below(np.inf))
        return float(filled_mm.sum()) * model.cell_mm**2 * model.weight

    def spilt_mm3(self, model: PatchModel) -> float:
        """Volume laid where nothing is missing, or nothing more."""
        too_much_mm = np.maximum(self.state.laid_mm - model.wanted_below(np.inf), 0.0)
        return float(too_much_mm.sum()) * model.cell_mm**2 * model.weight

    def worth_mm3(self, model: PatchModel, setup: PrintSetup) -> float:
        """How good this way is: volume filled, less volume spilt, less time, all in mm³.

        The process profile has the weights: `repair_spill_weight`, and `repair_worth_mm3_s` for
        each second.
        """
        filled, spilt = self.filled_mm3(model), self.spilt_mm3(model)
        length_mm = sum(
            float(np.hypot(*np.diff(chain.xy_mm, axis=0).T).sum())
            for one in self.passes
            for chain in one.chains
        )
        process = setup.process
        seconds = length_mm / process.repair_speed_mm_s
        return filled - process.repair_spill_weight * spilt - process.repair_worth_mm3_s * seconds


def best_plan(
    model: PatchModel, grid: LayerGrid, setup: PrintSetup, progress: Progress
) -> PatchPasses:
    """The best of several ways to lay a patch.

    The ways differ in the heights at which hollows get extra passes (`Openings`). The next one is
    tried only where the last leaves something open that the head could reach. A way that lays much
    of its plastic over air beside rims is planned again without that.
    """
    options = model.options.due
    open_mm3 = model.open_mm3(grid.layer_height_mm)
    tried: list[PatchPasses] = []
    for openings in Openings:
        heights = Heights.of(model, grid, setup, openings=openings)
        if tried and not heights.alone.any():
            continue  # the same again
        found = plan(model, heights, setup, progress, hems=True)
        if found.hem_mm3(model) > options.most_hem * found.beads_mm3:
            found = plan(model, heights, setup, progress, hems=False)
        tried.append(found)
        if found.filled_mm3(model) >= options.filled_enough * open_mm3:
            break
    return max(tried, key=lambda found: found.worth_mm3(model, setup))


def plan(
    model: PatchModel, heights: Heights, setup: PrintSetup, progress: Progress, *, hems: bool
) -> PatchPasses:
    """Plan the passes of one way; with `hems`, beads may begin over air beside a rim."""
    state = PatchState.begun(model)
    skin = None
    if setup.process.nonplanar_top:
        skin = skin_served(model, state, skin_of(model, ~np.isfinite(heights.ends_mm)), setup)
    if skin is not None:
        state = replace(state, planar_top_mm=skin.planar_top_mm(model, heights.tops_mm))
    passes: list[Pass] = []
    count = len(heights.all_mm)
    for k in range(count):
        one, state = plan_pass(model, state, heights.at(k, state, model), setup, hems=hems)
        passes += [one] if one is not None else []
        progress("slice patch", float(k + 1), float(count))
    if skin is not None:
        one, state = plan_skin(model, state, skin, heights.most_mm, count, setup)
        passes += [one] if one is not None else []
    return PatchPasses(tuple(passes), state)
