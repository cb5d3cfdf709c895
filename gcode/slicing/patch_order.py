"""In which order a patch is laid: region by region where the nozzle allows, floor up in each.

A region that is finished stands in the way of the next ones. One of which the nozzle could then not
lay every bead is laid together with those that hinder it, pass by pass.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from gcode.profiles import PrintSetup
from gcode.slicing.beads import divided
from gcode.slicing.patch_beads import Chain
from gcode.slicing.patch_free import surely_free
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.patch_passes import Pass
from gcode.slicing.patch_state import PatchState
from gcode.slicing.reach import Reach
from gcode.surfaces.standing import with_beads


@dataclass(frozen=True, slots=True)
class Stage:
    """Passes laid one after the other, and where the nozzle may be meanwhile."""

    passes: tuple[Pass, ...]
    reach: Reach


def stages_of(
    passes: list[Pass],
    state: PatchState,
    model: PatchModel,
    setup: PrintSetup,
    start_mm: Float[np.ndarray, " 2"],
) -> list[Stage]:
    """Split passes into stages, the regions' lowest tops first, and then what is nearest.

    Parameters
    ----------
    state
        After all passes.
    start_mm
        (2,) where the nozzle comes from.
    """
    regions = _by_region(passes, _regions(state, model), model)
    if len(regions) <= 1:
        return [Stage(tuple(passes), model.reach)] if passes else []
    groups: list[set[int]] = []
    fields: list[Reach] = [model.reach]  # before each group
    for region in _sorted(regions, start_mm):
        # back to the last group after which it can be laid by itself
        at = len(groups)
        while at > 0 and not _all_free(regions[region], fields[at]):
            at -= 1
        groups[at:] = [set().union({region}, *groups[at:])]
        laid = [chain for done in set().union(*groups) for _, chain in regions[done]]
        fields[at + 1 :] = [_reach_over(laid, model, setup, fields[at])]
    return [
        Stage(_of_regions(passes, group, regions, reach), reach)
        for group, reach in zip(groups, fields[:-1], strict=True)
    ]


def _reach_over(laid: list[Chain], model: PatchModel, setup: PrintSetup, before: Reach) -> Reach:
    """Where the nozzle may be once beads are laid, as the checker will have them stand."""
    start, end = (
        np.concatenate([np.column_stack([c.xy_mm, c.z_mm])[cut] for c in laid])
        for cut in (slice(None, -1), slice(1, None))
    )
    section_mm2 = np.concatenate([chain.section_mm2 for chain in laid])
    bore_mm = setup.printer.nozzle_diameter_mm
    return model.reach_of(with_beads(model.as_built, start, end, section_mm2, bore_mm), before)


def _regions(state: PatchState, model: PatchModel) -> Int[np.ndarray, "ny nx"]:
    """Which connected region columns belong to, from 1; those close together are one."""
    near = (
        ndimage.distance_transform_edt(state.laid_mm <= 0) * model.cell_mm
        <= 0.5 * model.options.columns.no_lift_mm
    )
    return np.asarray(ndimage.label(near)[0], dtype=np.int64)


def _by_region(
    passes: list[Pass], label: Int[np.ndarray, "ny nx"], model: PatchModel
) -> dict[int, list[tuple[Pass, Chain]]]:
    found: dict[int, list[tuple[Pass, Chain]]] = {}
    for one in passes:
        for chain in one.chains:
            region = int(model.at(label, chain.middle_mm[None], 0)[0])
            found.setdefault(region, []).append((one, chain))
    return found


def _sorted(
    regions: dict[int, list[tuple[Pass, Chain]]], start_mm: Float[np.ndarray, " 2"]
) -> list[int]:
    """By the height of their last pass; where that is the same, nearest next."""
    tops = {k: round(max(one.z_mm for one, _ in laid), 2) for k, laid in regions.items()}
    places = {k: laid[0][1].xy_mm[0] for k, laid in regions.items()}
    here, out = np.asarray(start_mm, dtype=np.float64), []
    left = set(regions)
    while left:
        lowest = min(tops[k] for k in left)
        level = (k for k in sorted(left) if tops[k] == lowest)
        chosen = min(level, key=lambda k: float(np.hypot(*(places[k] - here))))
        left.remove(chosen)
        out.append(chosen)
        here = regions[chosen][-1][1].xy_mm[-1]
    return out


def _all_free(laid: list[tuple[Pass, Chain]], reach: Reach) -> bool:
    """Whether the nozzle may be all along every bead."""
    free: dict[int, Bool[np.ndarray, "ny nx"]] = {}
    for one, chain in laid:
        if one.index not in free:
            free[one.index] = reach.at(one.tip_mm)
        if not surely_free(_along(chain, reach), free[one.index], reach).all():
            return False
    return True


def _along(chain: Chain, reach: Reach) -> Float[np.ndarray, "n 2"]:
    """Points along a chain, closer than half a cell."""
    lengths = np.hypot(*np.diff(chain.xy_mm, axis=0).T)
    count = 1 + np.ceil(3 * lengths / reach.field.cell_mm).astype(np.int64)
    return divided(chain.xy_mm, count)[0]


def _of_regions(
    passes: list[Pass],
    group: set[int],
    regions: dict[int, list[tuple[Pass, Chain]]],
    reach: Reach,
) -> tuple[Pass, ...]:
    own = {id(chain) for region in group for _, chain in regions[region]}
    out = []
    for one in passes:
        chains = tuple(chain for chain in one.chains if id(chain) in own)
        if chains:
            out.append(replace(one, chains=chains, reach=one.reach & reach.at(one.tip_mm)))
    return tuple(out)
